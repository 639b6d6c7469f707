"""Attitude of a body by roll phi, pitch theta, yaw psi, in this order of coordinates."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxlag.rotation import direction_cosines, yaw_pitch_roll


def matrix(angles: Array) -> Array:
    """T_I/B = Rz(psi) Ry(theta) Rx(phi), body to inertial components, from (phi, theta, psi)."""
    return yaw_pitch_roll.matrix(angles[::-1])


def cosines(angles: Array) -> Array:
    """T_B/I, inertial to body components."""
    return direction_cosines(matrix(angles))


def body_rates(angles: Array, rates: Array) -> Array:
    """Components of the angular velocity along the body axes [rad/s]."""
    return yaw_pitch_roll.body_rates(angles[::-1], rates[::-1])


def space_rates(angles: Array, rates: Array) -> Array:
    """Components of the angular velocity along X, Y, Z [rad/s]."""
    return yaw_pitch_roll.space_rates(angles[::-1], rates[::-1])


def angular_velocity(t: Any, q: Array, v: Array, params: Any) -> Array:
    """(p, q, r) along the body axes [rad/s], from q = (X, Y, Z, phi, theta, psi)."""
    return body_rates(q[3:], v[3:])


def body_velocities(t: Any, q: Array, v: Array, params: Any) -> Array:
    """(u, v, w, p, q, r) along the body axes (m/s, rad/s), from the same coordinates."""
    return jnp.concatenate([cosines(q[3:]) @ v[:3], angular_velocity(t, q, v, params)])
