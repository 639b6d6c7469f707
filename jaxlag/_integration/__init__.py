"""From a system to a motion: the vector field, one step, the loop over steps."""
