"""Velocities of rolling bodies at the point of contact, along X, Y of the plane [m/s]."""

import jax.numpy as jnp
from jax import Array


def of_ball(v: Array, omega: Array, radius: Array) -> Array:
    """From the velocity (x', y') of the center and the angular velocity along X, Y, Z."""
    return v + radius * jnp.stack([-omega[1], omega[0]])


def of_upright_wheel(v: Array, heading: Array, roll: Array, radius: Array) -> Array:
    """From the velocity (x', y') of the center, the heading from X and the rate of the roll."""
    return v - radius * roll * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
