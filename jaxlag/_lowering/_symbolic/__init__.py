"""A system as expressions, and its equations derived from them."""
