"""Time integration: the vector field, one step, the loop over steps."""
