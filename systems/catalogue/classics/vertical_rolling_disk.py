r"""Upright disk that rolls on a level plane without slipping.

Not in the book; Bloch, Nonholonomic Mechanics and Control (2003), ch. 1. The quasi-velocities are
declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2.

       y ^          .  path
         |        /
         |     ==o==    disk seen from above, rolling towards phi;
         |    / '       roll angle theta about its axle
         |  .'  phi
         +--------------------> x

Coordinates
    x, y        point of contact [m]
    theta       roll about the axle [rad]
    phi         heading from x [rad]

Quasi-velocities
    thetadot    theta' [rad/s]
    phidot      phi' [rad/s]
    s_x, s_y    velocity of the disk at the point of contact [m/s]: 0

Parameters
    m           mass [kg]
    R           radius [m]
    I           inertia about the axle [kg m^2]
    J           inertia about a diameter [kg m^2]
    tau_theta   torque about the axle [N m]
    tau_phi     steering torque about the vertical [N m]

    T = 1/2 m (x'^2 + y'^2) + 1/2 I theta'^2 + 1/2 J phi'^2      V = 0
    s_x = x' - R theta' cos(phi),   lambda = force of the ground along x in N, m x''
    s_y = y' - R theta' sin(phi),   lambda = force of the ground along y in N, m y''
    (I + m R^2) theta'' = tau_theta
    J phi'' = tau_phi

Without torques the contact goes round a circle of radius R theta'/phi'.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact, _rolling
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T of the mass center, of the roll and of the turn [J]."""
    moving = 0.5 * params["m"] * v[:2] @ v[:2]
    return moving + 0.5 * params["I"] * v[2] ** 2 + 0.5 * params["J"] * v[3] ** 2


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def torques(t, q, v, params):
    """Q = (0, 0, tau_theta, tau_phi) (N, N, N m, N m)."""
    return jnp.array([0.0, 0.0, params["tau_theta"], params["tau_phi"]])


def velocities(t, q, v, params):
    """(thetadot, phidot, s_x, s_y) (rad/s, rad/s, m/s, m/s)."""
    slip = _rolling.of_upright_wheel(v[:2], q[3], v[2], params["R"])
    return jnp.concatenate([v[2:], slip])


system = jl.System(
    coordinates=("x", "y", "theta", "phi"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(torques, "torques"),),
    quasi=jl.QuasiVelocities(
        velocities, ("thetadot", "phidot", "s_x", "s_y"), constrained=("s_x", "s_y")
    ),
)


def exact(t, q0, v0, params):
    """Roll and heading under constant torques, and the path along them."""
    inertia = jnp.stack([params["I"] + params["m"] * params["R"] ** 2, params["J"]])
    a = jnp.stack([params["tau_theta"], params["tau_phi"]]) / inertia

    def speed(t):
        return params["R"] * (v0[2] + a[0] * t)

    def heading(t):
        return q0[3] + v0[3] * t + 0.5 * a[1] * t**2

    x = _exact.integral(lambda t: speed(t) * jnp.cos(heading(t)), t)
    y = _exact.integral(lambda t: speed(t) * jnp.sin(heading(t)), t)
    angles, rates = _exact.accelerated(t, q0[2:], v0[2:], a)
    forward = jnp.stack([jnp.cos(angles[1]), jnp.sin(angles[1])])
    q = jnp.concatenate([q0[:2] + jnp.stack([x, y]), angles])
    return q, jnp.concatenate([speed(t) * forward, rates])


entry = Entry(
    name="vertical_rolling_disk",
    book="not in the book; Bloch (2003); ch. 4, sec. 4.3, Example 2",
    system=system,
    coordinate_units=("m", "m", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "m/s", "m/s"),
    multiplier_units={"s_x": "N", "s_y": "N"},
    parameter_units={
        "m": "kg",
        "R": "m",
        "I": "kg m^2",
        "J": "kg m^2",
        "tau_theta": "N m",
        "tau_phi": "N m",
    },
    example=Example(
        params={
            "m": 1.5,
            "R": 0.3,
            "I": 0.07,
            "J": 0.04,
            "tau_theta": 0.1,
            "tau_phi": 0.02,
        },
        q0=(0.0, 0.0, 0.0, 0.0),
        v0=(0.9, 0.0, 3.0, 0.5),
        duration=5.0,
    ),
    exact=exact,
)
