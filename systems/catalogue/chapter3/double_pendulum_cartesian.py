r"""Double pendulum by the Cartesian coordinates of its bobs, the strings constraints.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.1 (Fig. 3.4).

       y ^
         |
    -----o-----> x
          \
           \ h1
            \
             O  m1   at (x1, y1)
              \
               \ h2
                O  m2   at (x2, y2)

Coordinates
    x1, y1, x2, y2   positions of the bobs from the pivot, x to the right and y upward [m]

Parameters
    m1, m2           masses of the bobs [kg]
    h1, h2           lengths of the strings [m]
    g                gravity [m/s^2]

    T = 1/2 m1 (x1'^2 + y1'^2) + 1/2 m2 (x2'^2 + y2'^2)      V = m1 g y1 + m2 g y2
    string1:  x1^2 + y1^2 - h1^2 = 0
    string2:  (x2 - x1)^2 + (y2 - y1)^2 - h2^2 = 0
    lambda1 = -tension1/(2 h1), lambda2 = -tension2/(2 h2) in N/m

Four coordinates and two constraints leave two degrees of freedom.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m1 (x1'^2 + y1'^2) + 1/2 m2 (x2'^2 + y2'^2) [J]."""
    return 0.5 * params["m1"] * v[:2] @ v[:2] + 0.5 * params["m2"] * v[2:] @ v[2:]


def potential(t, q, params):
    """V = m1 g y1 + m2 g y2 [J], zero at the height of the pivot."""
    return params["g"] * (params["m1"] * q[1] + params["m2"] * q[3])


def squared_length_excesses(t, q, params):
    """Squared distances between the ends of the strings, minus their squared lengths [m^2]."""
    first, second = q[:2], q[2:] - q[:2]
    return jnp.stack([first @ first - params["h1"] ** 2, second @ second - params["h2"] ** 2])


def tensions(t, q, v, a, params):
    """Tensions of the strings, (-2 lambda1 h1, -2 lambda2 h2) [N]."""
    lam = system.multipliers(q, v, params, t=t)
    return -2 * jnp.stack([lam["string1"] * params["h1"], lam["string2"] * params["h2"]])


system = jl.System(
    coordinates=("x1", "y1", "x2", "y2"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(squared_length_excesses, ("string1", "string2")),),
)

entry = Entry(
    name="double_pendulum_cartesian",
    book="ch. 3, sec. 3.1, Fig. 3.4",
    system=system,
    coordinate_units=("m", "m", "m", "m"),
    multiplier_units={"string1": "N/m", "string2": "N/m"},
    parameter_units={"m1": "kg", "m2": "kg", "h1": "m", "h2": "m", "g": "m/s^2"},
    example=Example(
        params={"m1": 1.0, "m2": 0.5, "h1": 1.0, "h2": 0.5, "g": 9.81},
        q0=(0.8, -0.6, 0.94, -1.08),
        v0=(0.0, 0.0, 0.0, 0.0),
        duration=8.0,
    ),
    extras={"tensions": tensions},
)
