"""Problems that several benchmarks solve, with their equations by hand and their exact answers."""
