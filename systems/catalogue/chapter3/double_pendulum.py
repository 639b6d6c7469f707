r"""Double pendulum: two bobs on two massless strings.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 4 (Fig. 3.9b, eqs. 3.65-3.73).

    ----o----
        |\
        | \ h1
        |  \
        |   O  m1
   theta1   |\
            | \ h2
            |  \
            |   O  m2
         theta2

Coordinates
    theta1, theta2   angles of the strings, BOTH from the downward vertical [rad],
                     positive counterclockwise (bob to the right)

Parameters
    m1, m2           masses of the bobs [kg]
    h1, h2           lengths of the strings [m]
    g                gravity [m/s^2]

    T = 1/2 m1 h1^2 theta1'^2 + 1/2 m2 [h1^2 theta1'^2 + h2^2 theta2'^2
        + 2 h1 h2 theta1' theta2' cos(theta1 - theta2)]
    V = -(m1 + m2) g h1 cos(theta1) - m2 g h2 cos(theta2)

Misprints: in 3.67 y1' lacks its square; from 3.72 through 3.73 the first term of the second
equation of motion is printed m2 h2 theta2'', where m2 h2^2 theta2'' is meant.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m1 v1^2 + 1/2 m2 v2^2 [J] with the speeds v1, v2 of the bobs."""
    h1, h2 = params["h1"], params["h2"]
    theta1, theta2 = q
    w1, w2 = v
    cross = 2 * h1 * h2 * w1 * w2 * jnp.cos(theta1 - theta2)
    v1_squared = (h1 * w1) ** 2
    v2_squared = (h1 * w1) ** 2 + (h2 * w2) ** 2 + cross
    return 0.5 * params["m1"] * v1_squared + 0.5 * params["m2"] * v2_squared


def potential(t, q, params):
    """V = -(m1 + m2) g h1 cos(theta1) - m2 g h2 cos(theta2) [J], zero at the pivot."""
    m1, m2, g = params["m1"], params["m2"], params["g"]
    theta1, theta2 = q
    return -(m1 + m2) * g * params["h1"] * jnp.cos(theta1) - m2 * g * params["h2"] * jnp.cos(theta2)


system = jl.System(coordinates=("theta1", "theta2"), kinetic=kinetic, potential=potential)

entry = Entry(
    name="double_pendulum",
    book="ch. 3, Example 4, Fig. 3.9b, eqs. 3.65-3.73",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={"m1": "kg", "m2": "kg", "h1": "m", "h2": "m", "g": "m/s^2"},
    example=Example(
        params={"m1": 1.0, "m2": 0.5, "h1": 1.0, "h2": 0.8, "g": 9.81},
        q0=(1.2, 0.4),
        v0=(0.0, 0.0),
        duration=8.0,
    ),
)
