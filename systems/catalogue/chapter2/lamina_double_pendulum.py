r"""Lamina hanging by one of its points from a string.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.5, Example 5, part 1 (Figs. 2.7(1)
and 2.8, eqs. 2.23-2.25).

    ----o----
        |\
        | \  r
        |  \
        |   O____      body origin, end of the string
        |   |\   \
     theta  | \   \    Y is 90 deg counterclockwise from X
            |  \ + \
           phi  \___\  + mass center (xb, yb); M, Iz
                 X

Coordinates
    theta   angle of the string from the downward vertical [rad], counterclockwise
    phi     angle of the body axis X from the downward vertical [rad], counterclockwise;
            both are absolute, so the lamina turns at phi' alone

Parameters
    M        mass of the lamina [kg]
    Iz       its inertia about O [kg m^2], more than M (xb^2 + yb^2)
    r        length of the string [m]
    xb, yb   mass center from O in body axes [m]
    g        gravity [m/s^2]

    T = 1/2 M r^2 theta'^2 + 1/2 Iz phi'^2
        + M r phi' theta' [xb cos(phi - theta) - yb sin(phi - theta)]
    V = -M g [r cos(theta) + xb cos(phi) - yb sin(phi)]

The code puts the inertial x axis downward and y to the right: then the string is along
(cos(theta), sin(theta)) and the body is turned by phi about z.

Misprint: item (d) says omega_z = phi' + theta' (presumably for "is not"); it is phi'.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def pose(t, q, params):
    """Rotation of the body axes and position of O, x downward and y to the right."""
    theta, phi = q
    string = params["r"] * jnp.array([jnp.cos(theta), jnp.sin(theta), 0.0])
    return jl.rotation.about_z(phi), string


def lamina(params):
    """The lamina by its inertia about O."""
    center = (params["xb"], params["yb"], 0.0)
    return jl.energy.RigidBody(params["M"], (0.0, 0.0, params["Iz"]), center)


def kinetic(t, q, v, params):
    """T of the lamina [J] (2.16)."""
    return lamina(params).kinetic(pose, t, q, v, params)


def potential(t, q, params):
    """V of the weight [J], zero with the mass center at the height of the support."""
    return lamina(params).gravity(pose, t, q, params, (params["g"], 0.0, 0.0))


system = jl.System(coordinates=("theta", "phi"), kinetic=kinetic, potential=potential)

entry = Entry(
    name="lamina_double_pendulum",
    book="ch. 2, sec. 2.5, Example 5, Figs. 2.7-2.8, eqs. 2.23-2.25",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={
        "M": "kg",
        "Iz": "kg m^2",
        "r": "m",
        "xb": "m",
        "yb": "m",
        "g": "m/s^2",
    },
    example=Example(
        params={"M": 1.5, "Iz": 0.12, "r": 0.6, "xb": 0.12, "yb": 0.05, "g": 9.81},
        q0=(0.9, -0.8),
        v0=(0.0, 0.0),
        duration=6.0,
    ),
)
