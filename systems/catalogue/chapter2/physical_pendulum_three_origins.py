r"""Physical pendulum, its kinetic energy found from three different body origins.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.5, Example 3 (Fig. 2.5, eqs. 2.17-2.19).

    ----(1)---------
         |\ `-.
         | \   `-.  r
         |  \ l   `-.
         |   \       (3)     origin of the body axes X, Y
         |    \     .'
         |     (2)-'         mass center, at (xb, yb) in them; M, Ic
       theta

    The origins of the book: (1) the pivot, (2) the mass center, (3) any point of the body.

Coordinates
    theta   angle of the line from the pivot to the mass center from the downward
            vertical [rad], positive counterclockwise

Parameters
    M        mass [kg]
    Ic       inertia about the mass center [kg m^2]
    r        distance of origin (3) from the pivot [m]
    alpha    direction of that line: in the body axes (3) lies at
             -r (sin(alpha), cos(alpha)) from the pivot [rad]
    xb, yb   mass center from origin (3) in body axes [m]
    g        gravity [m/s^2]

    l^2 = xb^2 + yb^2 + r^2 - 2 r (xb sin(alpha) + yb cos(alpha)),   Iz = Ic + M (xb^2 + yb^2)
    T = 1/2 (Ic + M l^2) theta'^2                                             origin (1)
      = 1/2 M l^2 theta'^2 + 1/2 Ic theta'^2                                  origin (2)
      = 1/2 M r^2 theta'^2 + 1/2 Iz theta'^2
        - M r theta'^2 (xb sin(alpha) + yb cos(alpha))                        origin (3), used here
    V = -M g l cos(theta)

The three are one function, and so are the equations of motion. The book writes Iz for all three
inertias, about (1), (2) and (3). Misprint: 2.18 ends in "= 0", but L is not zero.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def overlap(params):
    """xb sin(alpha) + yb cos(alpha): mass center from (3), along the line to the pivot [m]."""
    return params["xb"] * jnp.sin(params["alpha"]) + params["yb"] * jnp.cos(params["alpha"])


def center_distance(params):
    """l, from the pivot to the mass center [m]."""
    r, xb, yb = params["r"], params["xb"], params["yb"]
    return jnp.sqrt(xb**2 + yb**2 + r**2 - 2 * r * overlap(params))


def pivot_inertia(params):
    """Ic + M l^2 [kg m^2]."""
    return params["Ic"] + params["M"] * center_distance(params) ** 2


def kinetic(t, q, v, params):
    """T from origin (3) [J] (2.19)."""
    M, r, xb, yb = params["M"], params["r"], params["xb"], params["yb"]
    Iz = params["Ic"] + M * (xb**2 + yb**2)
    return 0.5 * (M * r**2 + Iz) * v[0] ** 2 - M * r * v[0] ** 2 * overlap(params)


def potential(t, q, params):
    """V = -M g l cos(theta) [J], zero at the pivot."""
    return -params["M"] * params["g"] * center_distance(params) * jnp.cos(q[0])


def kinetic_from_center(t, q, v, a, params):
    """T from origin (2) [J] (2.18)."""
    speed = center_distance(params) * v[0]
    return 0.5 * params["M"] * speed**2 + 0.5 * params["Ic"] * v[0] ** 2


system = jl.System(coordinates=("theta",), kinetic=kinetic, potential=potential)


def exact(t, q0, v0, params):
    """The swing by Jacobi's functions, while the body does not turn over."""
    moment = params["M"] * params["g"] * center_distance(params)
    return _exact.swinging(t, q0, v0, jnp.sqrt(moment / pivot_inertia(params)))


entry = Entry(
    name="physical_pendulum_three_origins",
    book="ch. 2, sec. 2.5, Example 3, Fig. 2.5, eqs. 2.17-2.19",
    system=system,
    coordinate_units=("rad",),
    parameter_units={
        "M": "kg",
        "Ic": "kg m^2",
        "r": "m",
        "alpha": "rad",
        "xb": "m",
        "yb": "m",
        "g": "m/s^2",
    },
    example=Example(
        params={"M": 2.0, "Ic": 0.05, "r": 0.5, "alpha": 0.4, "xb": 0.2, "yb": -0.1, "g": 9.81},
        q0=(2.9,),
        v0=(0.0,),
        duration=6.0,
    ),
    extras={
        "l": lambda t, q, v, a, params: center_distance(params),
        "I_pivot": lambda t, q, v, a, params: pivot_inertia(params),
        "T_origin_cm": kinetic_from_center,
    },
    exact=exact,
)
