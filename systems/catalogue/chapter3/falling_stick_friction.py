r"""Stick sliding down on rough ground, the friction proportional to the reaction.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 17 (Fig. 3.31, eq. 3.177, with the
moment of the friction that the book leaves out).

    y ^              /
      |             /   uniform stick m, L
      |            /
      |           G   (x_c, y_c)
      |          /
      |         /
      |        /  theta
      +=======O===============> x    rough ground
       <--  N ^ --> mu N
    slides    |

Coordinates
    x_c, y_c   position of the mass center G, y upward [m]
    theta      angle of the stick from the ground [rad], 0 lying, pi/2 upright

Parameters
    m          mass [kg]
    L          length [m]; the central inertia is IG = m L^2/12
    g          gravity [m/s^2]
    mu         coefficient of sliding friction [1]

    T = 1/2 m (x_c'^2 + y_c'^2) + 1/2 IG theta'^2      V = m g y_c
    ground:    y_c - (L/2) sin(theta) = 0, lambda = N in N
    friction:  (mu N, 0) on the contact point, Q = (mu N, 0, mu N (L/2) sin(theta))
    m x_c'' = mu N
    [IG + (m L^2/4) c (c - mu s)] theta'' = -(L/2) (c - mu s) (m g - (m L/2) theta'^2 s)
        with c = cos(theta), s = sin(theta)

The model holds while the contact point slides towards -x, x_c' + (L/2) theta' sin(theta) < 0, and
while N > 0. Its states are those of (x_c, theta).

Misprint: 3.175-3.176 omit the moment mu N (L/2) sin(theta) of the friction.
"""

import math

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Chart, Entry, Example
from systems.catalogue.chapter3 import falling_stick
from systems.catalogue.chapter3.falling_stick_multiplier import contact_height, kinetic, potential


def contact_velocity(t, q, v, params):
    """x_c' + (L/2) theta' sin(theta), velocity of the lower end along the ground [m/s]."""
    return v[0] + 0.5 * params["L"] * v[2] * jnp.sin(q[2])


def friction(t, q, v, params, lam):
    """Q = (mu N, 0, mu N (L/2) sin(theta)) (N, N, N m)."""
    F = params["mu"] * lam["ground"]
    return jnp.stack([F, jnp.zeros_like(F), 0.5 * params["L"] * jnp.sin(q[2]) * F])


def normal_force(t, q, v, a, params):
    """N = lambda [N]."""
    return system.multipliers(q, v, params, t=t)["ground"]


def friction_force(t, q, v, a, params):
    """mu N, towards x [N]."""
    return params["mu"] * normal_force(t, q, v, a, params)


def sliding_velocity(t, q, v, a, params):
    """Velocity of the contact point along the ground [m/s], negative."""
    return contact_velocity(t, q, v, params)


def on_ground(t, q, params):
    """(x_c, y_c, theta) of the stick on the ground, from (x_c, theta)."""
    return jnp.concatenate([falling_stick.center(t, q, params), q[1:]])


system = jl.System(
    coordinates=("x_c", "y_c", "theta"),
    kinetic=kinetic,
    potential=potential,
    forces=(
        jl.GeneralizedForce(
            friction, "friction", reaction=True, contact="ground", sliding=contact_velocity
        ),
    ),
    constraints=(jl.Holonomic(contact_height, "ground"),),
)

entry = Entry(
    name="falling_stick_friction",
    book="ch. 3, Example 17, Fig. 3.31, eq. 3.177",
    system=system,
    coordinate_units=("m", "m", "rad"),
    multiplier_units={"ground": "N"},
    parameter_units={"m": "kg", "L": "m", "g": "m/s^2", "mu": "1"},
    example=Example(
        params={"m": 0.5, "L": 1.0, "g": 9.81, "mu": 0.2},
        q0=(0.0, 0.4, math.asin(0.8)),
        v0=(0.0, -0.12, -0.4),
        duration=0.3,
    ),
    chart=Chart(coordinates=("x_c", "theta"), configuration=on_ground),
    extras={
        "N": normal_force,
        "friction": friction_force,
        "contact_point_velocity_x": sliding_velocity,
    },
)
