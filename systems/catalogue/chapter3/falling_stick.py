r"""Stick sliding down on smooth ground.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 17 (Fig. 3.31, eqs. 3.173-3.176).

    y ^              /
      |             /   uniform stick m, L
      |            /
      |           G   (x_c, (L/2) sin(theta))
      |          /
      |         /
      |        /  theta
      +=======O===============> x    smooth ground
              ^
              | N

Coordinates
    x_c     horizontal position of the mass center G [m]
    theta   angle of the stick from the ground [rad], 0 lying, pi/2 upright

Parameters
    m       mass [kg]
    L       length [m]; the central inertia is IG = m L^2/12
    g       gravity [m/s^2]

    T = 1/2 m (x_c'^2 + (L^2/4) cos^2(theta) theta'^2) + 1/2 IG theta'^2
    V = m g (L/2) sin(theta)
    m x_c'' = 0
    (IG + (m L^2/4) cos^2(theta)) theta'' - (m L^2/4) theta'^2 sin(theta) cos(theta)
        + (m g L/2) cos(theta) = 0
    N = m g + (m L/2) (theta'' cos(theta) - theta'^2 sin(theta))

The model holds until the stick lies, theta = 0, and while N > 0. Misprint: m x_c alone stands for
m x_c'' = 0.
"""

import jax.numpy as jnp

import jaxlag as jl
from jaxlag import energy
from systems.catalogue._entry import Entry, Example


def center(t, q, params):
    """Mass center, to the right and upward [m]."""
    x_c, theta = q
    return jnp.stack([x_c, 0.5 * params["L"] * jnp.sin(theta)])


def kinetic(t, q, v, params):
    """T of the mass center and of the turn about it [J]."""
    IG = params["m"] * params["L"] ** 2 / 12
    return energy.particles(center, params["m"], t, q, v, params) + 0.5 * IG * v[1] ** 2


def potential(t, q, params):
    """V = m g (L/2) sin(theta) [J], zero on the ground."""
    return energy.gravity(params["m"], center(t, q, params), jnp.array([0.0, -params["g"]]))


def normal_force(t, q, v, a, params):
    """N = m g + (m L/2) (theta'' cos(theta) - theta'^2 sin(theta)) [N]."""
    c, s = jnp.cos(q[1]), jnp.sin(q[1])
    rise = 0.5 * params["L"] * (a[1] * c - v[1] ** 2 * s)
    return params["m"] * (params["g"] + rise)


def horizontal_momentum(t, q, v, a, params):
    """p_x = m x_c' [kg m/s]."""
    return params["m"] * v[0]


system = jl.System(coordinates=("x_c", "theta"), kinetic=kinetic, potential=potential)

entry = Entry(
    name="falling_stick",
    book="ch. 3, Example 17, Fig. 3.31, eqs. 3.173-3.176",
    system=system,
    coordinate_units=("m", "rad"),
    parameter_units={"m": "kg", "L": "m", "g": "m/s^2"},
    example=Example(
        params={"m": 0.5, "L": 1.0, "g": 9.81}, q0=(0.0, 1.4), v0=(0.3, 0.0), duration=0.5
    ),
    extras={"N": normal_force},
    invariants={"p_x": horizontal_momentum},
)
