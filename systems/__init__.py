"""Systems of Pila, "Introduction to Lagrangian Dynamics", declared for jaxlag, and a few beyond.

One module per system, each with its sketch, its energies and its forces as the book has them;
`python -m systems` lists them, runs their examples and checks reference files against them.
"""
