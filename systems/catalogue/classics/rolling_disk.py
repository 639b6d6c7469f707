r"""Thin disk that rolls on a level plane without slipping and leans freely.

Not in the book; Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972), and, low and without
friction losses, Euler's disk. The quasi-velocities are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2.

         z ^        e2 \    __
           |            \ /   /        e1  horizontal diameter, towards the heading psi
           |             /   /         e2  up in the plane of the disk
           |      e3 ---o   /  m, R    e3  axle, e1 x e2
           |           /   /
           |          /__ /  theta
           +----------------------> x, y

Coordinates
    x, y         position of the center over the plane [m]; its height is R sin(theta)
    psi          heading of the horizontal diameter from x [rad]
    theta        angle between disk and plane [rad], pi/2 for the upright disk
    phi          spin about the axle [rad]

Quasi-velocities
    w1, w2, w3   angular velocity along e1, e2, e3 [rad/s]
    s_x, s_y     velocity of the disk at the point of contact [m/s]: 0

Parameters
    m            mass [kg]
    R            radius [m]
    I_d          inertia about a diameter [kg m^2]
    I_a          inertia about the axle [kg m^2]
    g            gravity [m/s^2]

    w1 = theta',   w2 = psi' sin(theta),   w3 = phi' + psi' cos(theta)
    T = 1/2 m (x'^2 + y'^2 + R^2 cos(theta)^2 theta'^2) + 1/2 I_d (w1^2 + w2^2) + 1/2 I_a w3^2
    V = m g R sin(theta)
    s_x = x' + R w3 cos(psi) - R theta' sin(theta) sin(psi)
    s_y = y' + R w3 sin(psi) + R theta' sin(theta) cos(psi)
    lambda = m (x'', y''), the horizontal force of the ground in N
    (I_d + m R^2) w1' = I_d w2^2 cot(theta) - (I_a + m R^2) w2 w3 - m g R cos(theta)
    I_d w2' = I_a w1 w3 - I_d w1 w2 cot(theta)
    (I_a + m R^2) w3' = m R^2 w1 w2

The rates do not determine psi' and phi' at theta = 0 and pi, the disk that lies flat.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def angular_velocity(t, q, v, params):
    """(w1, w2, w3) along e1, e2, e3 [rad/s]."""
    theta, (heading_rate, lean, spin) = q[3], v[2:]
    return jnp.stack([lean, heading_rate * jnp.sin(theta), spin + heading_rate * jnp.cos(theta)])


def kinetic(t, q, v, params):
    """T of the mass center and of the rotation [J]."""
    w1, w2, w3 = angular_velocity(t, q, v, params)
    rise = params["R"] * jnp.cos(q[3]) * v[3]
    moving = 0.5 * params["m"] * (v[0] ** 2 + v[1] ** 2 + rise**2)
    return moving + 0.5 * params["I_d"] * (w1**2 + w2**2) + 0.5 * params["I_a"] * w3**2


def potential(t, q, params):
    """V = m g R sin(theta) [J]."""
    return params["m"] * params["g"] * params["R"] * jnp.sin(q[3])


def contact_velocity(t, q, v, params):
    """(s_x, s_y) [m/s]."""
    along = params["R"] * angular_velocity(t, q, v, params)[2]
    across = params["R"] * v[3] * jnp.sin(q[3])
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    return jnp.stack([v[0] + along * c - across * s, v[1] + along * s + across * c])


def velocities(t, q, v, params):
    """(w1, w2, w3, s_x, s_y) (rad/s, m/s)."""
    rates = angular_velocity(t, q, v, params)
    return jnp.concatenate([rates, contact_velocity(t, q, v, params)])


system = jl.System(
    coordinates=("x", "y", "psi", "theta", "phi"),
    kinetic=kinetic,
    potential=potential,
    quasi=jl.QuasiVelocities(
        velocities, ("w1", "w2", "w3", "s_x", "s_y"), constrained=("s_x", "s_y")
    ),
)

entry = Entry(
    name="rolling_disk",
    book="not in the book; Neimark, Fufaev (1972); ch. 4, sec. 4.3, Example 2",
    system=system,
    coordinate_units=("m", "m", "rad", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "rad/s", "m/s", "m/s"),
    multiplier_units={"s_x": "N", "s_y": "N"},
    parameter_units={
        "m": "kg",
        "R": "m",
        "I_d": "kg m^2",
        "I_a": "kg m^2",
        "g": "m/s^2",
    },
    example=Example(
        params={"m": 1.0, "R": 0.3, "I_d": 0.0225, "I_a": 0.045, "g": 9.81},
        q0=(0.0, 0.0, 0.0, 1.2, 0.0),
        v0=(2.4, 0.0, 0.0, 0.0, -8.0),
        duration=5.0,
    ),
)
