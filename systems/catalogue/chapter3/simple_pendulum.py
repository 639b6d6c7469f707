r"""Simple pendulum: a bob on a massless string or rod.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Examples 3 and 18 (Fig. 3.9a,
eqs. 3.60-3.64 and 3.209-3.211).

    ----o----
        |\
        | \
        |  \ h1
        |   \
        |    O  m1
     theta1

Coordinate
    theta1   angle of the string from the downward vertical [rad], positive
             counterclockwise (bob to the right)

Parameters
    m1       mass of the bob [kg]
    h1       length of the string [m]
    g        gravity [m/s^2]

    L = 1/2 m1 h1^2 theta1'^2 + m1 g h1 cos(theta1)
    theta1'' = -(g/h1) sin(theta1)                                        (3.64)
    p = m1 h1^2 theta1'
    H = p^2/(2 m1 h1^2) - m1 g h1 cos(theta1),  p' = -m1 g h1 sin(theta1)

Example 18 writes H in theta1' instead of p: right in value, but the canonical equations
(3.209-3.211) need it in p, as above.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m1 h1^2 theta1'^2 [J]."""
    return 0.5 * params["m1"] * (params["h1"] * v[0]) ** 2


def potential(t, q, params):
    """V = -m1 g h1 cos(theta1) [J], zero at the height of the pivot."""
    return -params["m1"] * params["g"] * params["h1"] * jnp.cos(q[0])


def tension(t, q, v, a, params):
    """Tension of the string, m1 (g cos(theta1) + h1 theta1'^2) [N]."""
    return params["m1"] * (params["g"] * jnp.cos(q[0]) + params["h1"] * v[0] ** 2)


system = jl.System(coordinates=("theta1",), kinetic=kinetic, potential=potential)


def exact(t, q0, v0, params):
    """The swing by Jacobi's functions, while the bob does not turn over."""
    return _exact.swinging(t, q0, v0, jnp.sqrt(params["g"] / params["h1"]))


entry = Entry(
    name="simple_pendulum",
    book="ch. 3, Examples 3 and 18, Fig. 3.9a, eqs. 3.60-3.64, 3.209-3.211",
    system=system,
    coordinate_units=("rad",),
    parameter_units={"m1": "kg", "h1": "m", "g": "m/s^2"},
    example=Example(params={"m1": 1.0, "h1": 0.8, "g": 9.81}, q0=(2.5,), v0=(0.0,), duration=8.0),
    extras={"tension": tension},
    exact=exact,
)
