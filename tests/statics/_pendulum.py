"""A pendulum given by two energies."""

import jax.numpy as jnp

import jaxlag as jl


def pendulum_kinetic(t, q, v, params):
    return 0.5 * params["m"] * (params["l"] * v[0]) ** 2


def pendulum_potential(t, q, params):
    return -params["m"] * params["g"] * params["l"] * jnp.cos(q[0])


PENDULUM = jl.System(coordinates=("theta",), kinetic=pendulum_kinetic, potential=pendulum_potential)
PARAMS = {"m": 1.2, "l": 0.7, "g": 9.81}
