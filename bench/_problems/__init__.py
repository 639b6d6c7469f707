"""Problems that several benchmarks solve, with hand-written equations and exact solutions."""
