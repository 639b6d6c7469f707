r"""Stick sliding down on smooth ground, the contact a constraint.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 17 (Fig. 3.31).

    y ^              /
      |             /   uniform stick m, L
      |            /
      |           G   (x_c, y_c)
      |          /
      |         /
      |        /  theta
      +=======O===============> x    smooth ground
              ^
              | N

Coordinates
    x_c, y_c   position of the mass center G, y upward [m]
    theta      angle of the stick from the ground [rad], 0 lying, pi/2 upright

Parameters
    m          mass [kg]
    L          length [m]; the central inertia is IG = m L^2/12
    g          gravity [m/s^2]

    T = 1/2 m (x_c'^2 + y_c'^2) + 1/2 IG theta'^2      V = m g y_c
    ground:  y_c - (L/2) sin(theta) = 0, lambda = N in N

The model holds until the stick lies, theta = 0, and while N > 0.
"""

import math

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T of the mass center and of the turn about it [J]."""
    x_rate, y_rate, w = v
    IG = params["m"] * params["L"] ** 2 / 12
    return 0.5 * params["m"] * (x_rate**2 + y_rate**2) + 0.5 * IG * w**2


def potential(t, q, params):
    """V = m g y_c [J], zero on the ground."""
    return params["m"] * params["g"] * q[1]


def contact_height(t, q, params):
    """y_c - (L/2) sin(theta), height of the stick's lower end [m]."""
    _, y_c, theta = q
    return y_c - 0.5 * params["L"] * jnp.sin(theta)


def horizontal_momentum(t, q, v, a, params):
    """p_x = m x_c' [kg m/s]."""
    return params["m"] * v[0]


system = jl.System(
    coordinates=("x_c", "y_c", "theta"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(contact_height, "ground"),),
)

entry = Entry(
    name="falling_stick_multiplier",
    book="ch. 3, Example 17, Fig. 3.31",
    system=system,
    coordinate_units=("m", "m", "rad"),
    multiplier_units={"ground": "N"},
    parameter_units={"m": "kg", "L": "m", "g": "m/s^2"},
    example=Example(
        params={"m": 0.5, "L": 1.0, "g": 9.81},
        q0=(0.0, 0.5 * math.sin(1.4), 1.4),
        v0=(0.3, 0.0, 0.0),
        duration=0.5,
    ),
    invariants={"p_x": horizontal_momentum},
)
