"""From programs of JAX to expressions of scalars."""
