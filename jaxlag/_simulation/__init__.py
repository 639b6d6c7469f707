"""`simulate`: its arguments, the problem that they pose, the solution."""
