r"""Double pendulum whose bobs feel linear drag, by a Rayleigh function.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.7, applied to the pendulum of
Example 4 (Fig. 3.9b, velocities of eq. 3.66); this combination is not in the book.

    ----o----
        |\
        | \ h1
        |  \             force on bob i:
        |   O  m1          (-cix xi', -ciy yi')
   theta1   |\
            | \ h2       x to the right, y upward
            |  \
            |   O  m2
         theta2

Coordinates and the parameters m1, m2, h1, h2, g, with T and V: see `double_pendulum`.

Parameters of the drag
    c1x, c1y   coefficients on the horizontal, vertical velocity of bob 1 [N s/m]
    c2x, c2y   the same for bob 2 [N s/m]

    R = 1/2 (c1x x1'^2 + c1y y1'^2 + c2x x2'^2 + c2y y2'^2)
    Q = -dR/dv,  hence E' = -2 R

Two slips in the text of sec. 3.7: delta x_i = sum dx_i'/dv_k lacks the factor delta q_k, and
its last line prints dF/q_k' for dF/dq_k'.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example
from systems.catalogue.chapter3 import double_pendulum


def bob_velocities(q, v, params):
    """(x1', y1', x2', y2') [m/s], x to the right and y upward (3.66)."""
    theta1, theta2 = q
    w1, w2 = v
    x1 = params["h1"] * jnp.cos(theta1) * w1
    y1 = params["h1"] * jnp.sin(theta1) * w1
    x2 = x1 + params["h2"] * jnp.cos(theta2) * w2
    y2 = y1 + params["h2"] * jnp.sin(theta2) * w2
    return x1, y1, x2, y2


def dissipation(t, q, v, params):
    """R = 1/2 sum (cix xi'^2 + ciy yi'^2) [W]."""
    x1, y1, x2, y2 = bob_velocities(q, v, params)
    return 0.5 * (
        params["c1x"] * x1**2
        + params["c1y"] * y1**2
        + params["c2x"] * x2**2
        + params["c2y"] * y2**2
    )


def rayleigh(t, q, v, a, params):
    """Rayleigh function [W]; the energy falls at twice this rate."""
    return dissipation(t, q, v, params)


system = jl.System(
    coordinates=("theta1", "theta2"),
    kinetic=double_pendulum.kinetic,
    potential=double_pendulum.potential,
    forces=(jl.Rayleigh(dissipation, "drag"),),
)

entry = Entry(
    name="double_pendulum_rayleigh",
    book="ch. 3, sec. 3.7 applied to Example 4, Fig. 3.9b",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={
        **double_pendulum.entry.parameter_units,
        **dict.fromkeys(("c1x", "c1y", "c2x", "c2y"), "N s/m"),
    },
    example=Example(
        params={
            **double_pendulum.entry.example.params,
            "c1x": 0.1,
            "c1y": 0.3,
            "c2x": 0.2,
            "c2y": 0.05,
        },
        q0=(1.2, 0.4),
        v0=(0.0, 0.0),
        duration=12.0,
    ),
    extras={"rayleigh": rayleigh},
)
