"""From expressions back to programs of JAX."""
