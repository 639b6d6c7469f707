r"""Loop of n equal links that hang between two pins, closed by two constraints.

Not in the book; the constraints are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 3, eqs. 3.10-3.11 and 3.118.

     y ^
       |                 d
    ---O--------------------------------P----> x
        \                              /
         \  1                       6 /
          o                          o      uniform links m, l; here n = 6
           `.  2                5  .'
             `o____       _____. o'
                3  `--o--'  4

Coordinates
    theta1, theta2, theta3, theta4, theta5, theta6
            angles of the links from x [rad], counterclockwise

Parameters
    m, l    mass [kg] and length [m] of each link
    d       distance of the pins [m]
    g       gravity [m/s^2]

    T, V of n uniform links joined head to tail
    pin_x:  l (cos(theta1) + ... + cos(theta6)) - d = 0
    pin_y:  l (sin(theta1) + ... + sin(theta6)) = 0
    lambda = force of the pin P on the last link along x and y in N

The angles of the example are a guess, assembled with nothing held.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _links
from systems.catalogue._entry import Entry, Example


def lengths(q, params):
    """The length l of each link [m]."""
    return jnp.full(q.shape, params["l"])


def masses(q, params):
    """The mass m of each link [kg]."""
    return jnp.full(q.shape, params["m"])


def kinetic(t, q, v, params):
    """T of all links [J]."""
    return _links.kinetic(masses(q, params), lengths(q, params), q, v)


def potential(t, q, params):
    """V of their weights [J], zero at the height of the pins."""
    return _links.potential(masses(q, params), lengths(q, params), q, params["g"])


def gap(t, q, params):
    """End of the last link from the pin P, along x and y [m]."""
    x, y = _links.heads(lengths(q, params), q)[-1]
    return jnp.stack([x - params["d"], y])


def declare(n):
    """The loop of n links."""
    return jl.System(
        coordinates=tuple(f"theta{i}" for i in range(1, n + 1)),
        kinetic=kinetic,
        potential=potential,
        constraints=(jl.Holonomic(gap, ("pin_x", "pin_y")),),
    )


system = declare(6)

entry = Entry(
    name="n_link_loop",
    book="not in the book; ch. 3, eqs. 3.10-3.11 and 3.118",
    system=system,
    coordinate_units=("rad",) * 6,
    multiplier_units={"pin_x": "N", "pin_y": "N"},
    parameter_units={"m": "kg", "l": "m", "d": "m", "g": "m/s^2"},
    example=Example(
        params={"m": 0.2, "l": 0.25, "d": 0.9, "g": 9.81},
        q0=(-1.4, -1.0, -0.4, 0.1, 0.7, 1.1),
        v0=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        duration=3.0,
        hold=(),
    ),
)
