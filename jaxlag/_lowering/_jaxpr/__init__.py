"""Conversion of JAX programs to scalar expressions."""
