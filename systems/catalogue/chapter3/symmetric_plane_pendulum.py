r"""Symmetric plane body swinging about a pin.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 15 (Fig. 3.29, eqs. 3.169-3.171).

         Ry ^
            |
    --------A---> Rx      pin reaction R on the body
            |\
            | \  L
            |  \
         theta  G  M, IG
            |    \
                  v  M g

Coordinate
    theta   angle of the line A-G from the downward vertical [rad], positive
            counterclockwise (G to the right)

Parameters
    M       mass [kg]
    IG      inertia about the mass center G [kg m^2]
    L       distance from the pin A to G [m]
    g       gravity [m/s^2]

    IA = IG + M L^2
    T = 1/2 IA theta'^2      V = -M g L cos(theta)
    IA theta'' + M g L sin(theta) = 0
    Rx = M L (theta'' cos(theta) - theta'^2 sin(theta))
    Ry = M L (theta'' sin(theta) + theta'^2 cos(theta)) + M g

The pin does no work, so its reaction is found afterwards, from M a_G = R + weight.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 (IG + M L^2) theta'^2 [J]."""
    return 0.5 * (params["IG"] + params["M"] * params["L"] ** 2) * v[0] ** 2


def potential(t, q, params):
    """V = -M g L cos(theta) [J], zero at the height of the pin."""
    return -params["M"] * params["g"] * params["L"] * jnp.cos(q[0])


def pin_reaction(t, q, v, a, params):
    """(Rx, Ry) on the body, to the right and upward [N]."""
    c, s = jnp.cos(q[0]), jnp.sin(q[0])
    center_acceleration = params["L"] * jnp.stack(
        [a[0] * c - v[0] ** 2 * s, a[0] * s + v[0] ** 2 * c]
    )
    return params["M"] * (center_acceleration + jnp.array([0.0, params["g"]]))


system = jl.System(coordinates=("theta",), kinetic=kinetic, potential=potential)


def exact(t, q0, v0, params):
    """The swing by Jacobi's functions, while the body does not turn over."""
    moment = params["M"] * params["L"]
    inertia = params["IG"] + moment * params["L"]
    return _exact.swinging(t, q0, v0, jnp.sqrt(moment * params["g"] / inertia))


entry = Entry(
    name="symmetric_plane_pendulum",
    book="ch. 3, Example 15, Fig. 3.29, eqs. 3.169-3.171",
    system=system,
    coordinate_units=("rad",),
    parameter_units={"M": "kg", "IG": "kg m^2", "L": "m", "g": "m/s^2"},
    example=Example(
        params={"M": 1.5, "IG": 0.08, "L": 0.4, "g": 9.81}, q0=(2.0,), v0=(0.0,), duration=6.0
    ),
    extras={"R_pin": pin_reaction},
    exact=exact,
)
