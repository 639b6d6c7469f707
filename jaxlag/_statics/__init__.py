"""What needs no time stepping: assembly, equilibria, inverse dynamics."""
