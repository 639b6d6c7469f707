"""Analysis of the equations: linearization."""
