"""Motions that several tests share: systems of the book, and a driven pendulum with friction."""

from typing import Any, NamedTuple

import jax.numpy as jnp

import jaxlag as jl
from systems import (
    cart_pendulum,
    central_motion,
    double_pendulum,
    double_pendulum_rayleigh,
    rotating_slender_rod,
)


class Motion(NamedTuple):
    """A system with a start at which no derivative vanishes by symmetry."""

    system: jl.System
    q0: Any
    v0: Any
    params: Any
    t1: float
    inputs: Any = None


def _lagrangian(t, q, v, params):
    return 0.5 * params["J"] * v[0] ** 2 + params["mgl"] * jnp.cos(q[0])


def _friction(t, q, v, params):
    """Viscous, and Coulomb smoothed over a velocity of 0.05 rad/s."""
    return -params["c"] * v - params["F"] * jnp.tanh(v / 0.05)


def _torque(t, q, v, params, inputs):
    return jnp.reshape(inputs["tau"], (1,))


driven = jl.System(
    _lagrangian,
    ("theta",),
    forces=(jl.GeneralizedForce(_friction, "friction"), jl.GeneralizedForce(_torque, "motor")),
)


def steps(seed: int = 0) -> jl.ZeroOrderHold:
    """A torque that jumps nine times in 1.6 s, N m."""
    times = jnp.array([0.0, 0.13, 0.31, 0.4, 0.62, 0.77, 0.9, 1.11, 1.3, 1.6])
    return jl.ZeroOrderHold(times, jnp.sin(1.7 * jnp.arange(10.0) + seed))


MOTIONS = {
    "double_pendulum": Motion(
        double_pendulum.system,
        jnp.array([1.0, 0.5]),
        jnp.array([0.3, -0.4]),
        {"m1": 1.0, "m2": 0.6, "h1": 0.9, "h2": 0.7, "g": 9.81},
        1.5,
    ),
    "double_pendulum_rayleigh": Motion(
        double_pendulum_rayleigh.system,
        jnp.array([0.8, 0.3]),
        jnp.array([1.0, -0.8]),
        {"m1": 1.0, "m2": 0.6, "h1": 0.9, "h2": 0.7, "g": 9.81}
        | {"c1x": 0.3, "c1y": 0.5, "c2x": 0.8, "c2y": 0.2},
        1.5,
    ),
    "cart_pendulum": Motion(
        cart_pendulum.system,
        jnp.array([0.2, 0.6]),
        jnp.array([0.1, 0.4]),
        {"m1": 2.0, "m2": 0.8, "l": 0.9, "k": 30.0, "b": 0.7, "g": 9.81}
        | {"F0": 1.5, "F2": 0.6, "Omega": 2.0},
        1.5,
    ),
    "central_motion": Motion(
        central_motion.system,
        jnp.array([1.1, 0.2]),
        jnp.array([0.2, 1.3]),
        {"m": 1.2, "K": 3.0, "c": 0.2},
        2.0,
    ),
    "rotating_slender_rod": Motion(
        rotating_slender_rod.system,
        jnp.array([0.1, 2.2]),
        jnp.array([2.0, 0.5]),
        {"rho": 1.5, "L": 0.9, "R": 0.4, "g": 9.81, "tau0": 0.8, "Omega": 2.5},
        1.5,
    ),
    "driven_pendulum": Motion(
        driven,
        jnp.array([0.4]),
        jnp.array([0.9]),
        {"J": 0.15, "mgl": 3.0, "c": 0.02, "F": 0.1},
        1.5,
        {"tau": steps()},
    ),
}
