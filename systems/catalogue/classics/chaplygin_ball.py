r"""Chaplygin's ball: a balanced ball with three different moments of inertia that rolls.

Not in the book; Chaplygin, Mat. Sbornik 24 (1903) 139. The quasi-velocities are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2.

       Z ^        .---.
         |      .       .     m, a; I1, I2, I3 about the body axes x, y, z
         |     (    o    )
         |      .       .     mass center at the center, above (x, y)
         |        '---'
         +----------o-----------> X, Y
                 contact

Coordinates
    x, y              center of the ball [m]
    phi, theta, psi   roll, pitch, yaw of the ball [rad]: Rz(psi) Ry(theta) Rx(phi)

Quasi-velocities
    wx, wy, wz        angular velocity along the body axes [rad/s]
    s_x, s_y          velocity of the ball at the point of contact [m/s]: 0

Parameters
    m                 mass [kg]
    a                 radius [m]
    I1, I2, I3        moments of inertia about the body axes [kg m^2]

    T = 1/2 m (x'^2 + y'^2) + 1/2 (I1 wx^2 + I2 wy^2 + I3 wz^2)      V = 0
    s_x = x' - a wY,   lambda = force of the ground along x in N, m x''
    s_y = y' + a wX,   lambda = force of the ground along y in N, m y''
    with wX, wY along the axes at rest

Energy and angular momentum about the contact, K = I omega + m a^2 n x (omega x n) with the
vertical n, are constant; K along X, Y, Z. The rates do not determine phi' and psi' at
theta = +-pi/2.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _attitude, _rolling
from systems.catalogue._entry import Entry, Example


def angular_velocity(t, q, v, params):
    """(wx, wy, wz) along the body axes [rad/s]."""
    return _attitude.body_rates(q[2:], v[2:])


def inertia(params):
    """Moments of inertia about the body axes [kg m^2]."""
    return jnp.stack([params["I1"], params["I2"], params["I3"]])


def kinetic(t, q, v, params):
    """T of the mass center and of the rotation [J]."""
    rates = angular_velocity(t, q, v, params)
    return 0.5 * params["m"] * v[:2] @ v[:2] + 0.5 * inertia(params) @ rates**2


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def velocities(t, q, v, params):
    """(wx, wy, wz, s_x, s_y) (rad/s, m/s)."""
    omega = _attitude.space_rates(q[2:], v[2:])
    rolling = _rolling.of_ball(v[:2], omega, params["a"])
    return jnp.concatenate([angular_velocity(t, q, v, params), rolling])


def angular_momentum(q, v, params):
    """K about the point of contact, along X, Y, Z [kg m^2/s]."""
    R = _attitude.matrix(q[2:])
    omega = _attitude.body_rates(q[2:], v[2:])
    up = R[2]
    rolling = params["m"] * params["a"] ** 2 * jnp.cross(up, jnp.cross(omega, up))
    return R @ (inertia(params) * omega + rolling)


system = jl.System(
    coordinates=("x", "y", "phi", "theta", "psi"),
    kinetic=kinetic,
    potential=potential,
    quasi=jl.QuasiVelocities(
        velocities, ("wx", "wy", "wz", "s_x", "s_y"), constrained=("s_x", "s_y")
    ),
)

entry = Entry(
    name="chaplygin_ball",
    book="not in the book; Chaplygin (1903); ch. 4, sec. 4.3, Example 2",
    system=system,
    coordinate_units=("m", "m", "rad", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "rad/s", "m/s", "m/s"),
    multiplier_units={"s_x": "N", "s_y": "N"},
    parameter_units={
        "m": "kg",
        "a": "m",
        **dict.fromkeys(("I1", "I2", "I3"), "kg m^2"),
    },
    example=Example(
        params={"m": 1.0, "a": 0.25, "I1": 0.015, "I2": 0.025, "I3": 0.03},
        q0=(0.0, 0.0, 0.0, 0.0, 0.0),
        v0=(0.2, -0.1, 0.4, 0.8, -0.5),
        duration=1.5,
    ),
    invariants={
        "K_X": lambda t, q, v, a, params: angular_momentum(q, v, params)[0],
        "K_Y": lambda t, q, v, a, params: angular_momentum(q, v, params)[1],
        "K_Z": lambda t, q, v, a, params: angular_momentum(q, v, params)[2],
    },
)
