r"""Symmetric plane body swinging about a pin, the pin two constraints.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 15 (Fig. 3.29, eqs. 3.169-3.171).

         Ry ^
            |
    --------A---> Rx      pin reaction R on the body
            |\
            | \  L
            |  \
         theta  G  M, IG, at (x, y)
            |    \
                  v  M g

Coordinates
    x, y    position of the mass center G from the pin, to the right and upward [m]
    theta   angle of the line A-G from the downward vertical [rad], positive
            counterclockwise (G to the right)

Parameters
    M       mass [kg]
    IG      inertia about G [kg m^2]
    L       distance from the pin A to G [m]
    g       gravity [m/s^2]

    T = 1/2 M (x'^2 + y'^2) + 1/2 IG theta'^2      V = M g y
    pin_x:  x - L sin(theta) = 0, lambda = Rx in N
    pin_y:  y + L cos(theta) = 0, lambda = Ry in N
"""

import math

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 M (x'^2 + y'^2) + 1/2 IG theta'^2 [J]."""
    x_rate, y_rate, w = v
    return 0.5 * params["M"] * (x_rate**2 + y_rate**2) + 0.5 * params["IG"] * w**2


def potential(t, q, params):
    """V = M g y [J], zero at the height of the pin."""
    return params["M"] * params["g"] * q[1]


def pinned_point(t, q, params):
    """Position of the body's point A from the pin, to the right and upward [m]."""
    x, y, theta = q
    return jnp.stack([x - params["L"] * jnp.sin(theta), y + params["L"] * jnp.cos(theta)])


system = jl.System(
    coordinates=("x", "y", "theta"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(pinned_point, ("pin_x", "pin_y")),),
)

entry = Entry(
    name="pinned_body_reactions",
    book="ch. 3, Example 15, Fig. 3.29, eqs. 3.169-3.171",
    system=system,
    coordinate_units=("m", "m", "rad"),
    multiplier_units={"pin_x": "N", "pin_y": "N"},
    parameter_units={"M": "kg", "IG": "kg m^2", "L": "m", "g": "m/s^2"},
    example=Example(
        params={"M": 1.5, "IG": 0.08, "L": 0.4, "g": 9.81},
        q0=(0.4, 0.0, 0.5 * math.pi),
        v0=(0.0, 0.0, 0.0),
        duration=6.0,
    ),
)
