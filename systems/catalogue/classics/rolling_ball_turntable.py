r"""Ball that rolls without slipping on a turntable, level or tilted.

Not in the book; Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972). The quasi-velocities are
declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2.

       y ^     . - ~ - .
         |   .    .-.    .      ball m, a, I at (x, y)
         |  .    (   )    .
         |  .     '-'     .     Omega, counterclockwise
         |   .           .
         |     ' - . - '        table about the origin
         +--------------------> x, downhill where the table is tilted by alpha

Coordinates
    x, y              center of the ball [m]
    phi, theta, psi   roll, pitch, yaw of the ball [rad]: Rz(psi) Ry(theta) Rx(phi)

Quasi-velocities
    wX, wY, wZ        angular velocity along X, Y, Z, the axes at rest [rad/s]
    s_x, s_y          velocity of the ball relative to the table at the contact [m/s]: 0

Parameters
    m                 mass [kg]
    a                 radius [m]
    I                 inertia about any axis through the center [kg m^2]
    Omega             rate of the table [rad/s]
    g                 gravity [m/s^2]
    alpha             tilt of the table [rad]

    T = 1/2 m (x'^2 + y'^2) + 1/2 I (wX^2 + wY^2 + wZ^2)      V = -m g x sin(alpha)
    s_x = x' - a wY + Omega y,   lambda = force of the table along x in N
    s_y = y' + a wX - Omega x,   lambda = force of the table along y in N
    I wX' = a lambda_y,   I wY' = -a lambda_x,   wZ' = 0
    with k = I/(m a^2):
    (1 + k) x'' = -k Omega y' + g sin(alpha)
    (1 + k) y'' = k Omega x'

On the level table the ball goes round a circle at the rate k Omega/(1 + k), 2/7 Omega if it is
solid. On the tilted one it drifts across the slope at g sin(alpha)/(k Omega). The table does work.
The rates do not determine phi' and psi' at theta = +-pi/2.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _attitude, _rolling
from systems.catalogue._entry import Entry, Example


def angular_velocity(t, q, v, params):
    """(wX, wY, wZ) [rad/s]."""
    return _attitude.space_rates(q[2:], v[2:])


def kinetic(t, q, v, params):
    """T of the mass center and of the rotation [J]."""
    omega = angular_velocity(t, q, v, params)
    return 0.5 * params["m"] * v[:2] @ v[:2] + 0.5 * params["I"] * omega @ omega


def potential(t, q, params):
    """V = -m g x sin(alpha) [J]."""
    return -params["m"] * params["g"] * jnp.sin(params["alpha"]) * q[0]


def velocities(t, q, v, params):
    """(wX, wY, wZ, s_x, s_y) (rad/s, m/s)."""
    omega = angular_velocity(t, q, v, params)
    rolling = _rolling.of_ball(v[:2], omega, params["a"])
    table = params["Omega"] * jnp.stack([-q[1], q[0]])
    return jnp.concatenate([omega, rolling - table])


system = jl.System(
    coordinates=("x", "y", "phi", "theta", "psi"),
    kinetic=kinetic,
    potential=potential,
    quasi=jl.QuasiVelocities(
        velocities, ("wX", "wY", "wZ", "s_x", "s_y"), constrained=("s_x", "s_y")
    ),
)

entry = Entry(
    name="rolling_ball_turntable",
    book="not in the book; Neimark, Fufaev (1972); ch. 4, sec. 4.3, Example 2",
    system=system,
    coordinate_units=("m", "m", "rad", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "rad/s", "m/s", "m/s"),
    multiplier_units={"s_x": "N", "s_y": "N"},
    parameter_units={
        "m": "kg",
        "a": "m",
        "I": "kg m^2",
        "Omega": "rad/s",
        "g": "m/s^2",
        "alpha": "rad",
    },
    example=Example(
        params={"m": 0.25, "a": 0.08, "I": 0.00064, "Omega": 1.5, "g": 9.81, "alpha": 0.01},
        q0=(0.2, 0.0, 0.1, 0.0, 0.0),
        v0=(0.0, 0.1, 2.5, 0.0, 0.0),
        duration=1.0,
    ),
)
