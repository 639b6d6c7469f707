r"""Spherical pendulum by the Cartesian coordinates of its bob, the string a constraint.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.1 (Fig. 3.1, eq. 3.4).

           z ^
             |
             o----> y
            /|\
         x v | \  L
             |  \
             |   \
                  O  m   at (x, y, z)

Coordinates
    x, y, z   position of the bob from the pivot, z upward [m]

Parameters
    m         mass of the bob [kg]
    L         length of the string [m]
    g         gravity [m/s^2]

    T = 1/2 m (x'^2 + y'^2 + z'^2)      V = m g z
    string:  x^2 + y^2 + z^2 - L^2 = 0, lambda = -tension/(2 L) in N/m
    m (x y' - y x') is constant

These coordinates have no singular point, unlike the azimuth of a vertical string.
"""

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m (x'^2 + y'^2 + z'^2) [J]."""
    return 0.5 * params["m"] * v @ v


def potential(t, q, params):
    """V = m g z [J], zero at the height of the pivot."""
    return params["m"] * params["g"] * q[2]


def squared_length_excess(t, q, params):
    """x^2 + y^2 + z^2 - L^2 [m^2] (3.4)."""
    return q @ q - params["L"] ** 2


def tension(t, q, v, a, params):
    """Tension of the string, -2 lambda L [N]."""
    return -2 * params["L"] * system.multipliers(q, v, params, t=t)["string"]


def angular_momentum(t, q, v, a, params):
    """m (x y' - y x'), about the vertical [kg m^2/s]."""
    x, y, _ = q
    return params["m"] * (x * v[1] - y * v[0])


system = jl.System(
    coordinates=("x", "y", "z"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(squared_length_excess, "string"),),
)

entry = Entry(
    name="spherical_pendulum_cartesian",
    book="ch. 3, sec. 3.1, Fig. 3.1, eq. 3.4",
    system=system,
    coordinate_units=("m", "m", "m"),
    multiplier_units={"string": "N/m"},
    parameter_units={"m": "kg", "L": "m", "g": "m/s^2"},
    example=Example(
        params={"m": 0.5, "L": 1.0, "g": 9.81},
        q0=(0.96, 0.0, -0.28),
        v0=(0.0, 1.5, 0.0),
        duration=8.0,
    ),
    extras={"tension": tension},
    invariants={"L_z": angular_momentum},
)
