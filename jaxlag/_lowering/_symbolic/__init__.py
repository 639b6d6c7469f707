"""A system as expressions, and the equations derived from them."""
