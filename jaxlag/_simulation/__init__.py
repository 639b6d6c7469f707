"""`simulate`: its arguments, its initial-value problem, its solution."""
