"""Conversion of expressions to JAX programs."""
