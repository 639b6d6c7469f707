r"""Tricycle with the book's Lagrangian and quasi-velocities, taken as printed.

Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2 (eqs. 4.72-4.76).

    Y ^                    / phi
      |              _ . (/)
      |         _ .-'  l
      |    |.-'
      |   _|_- - - theta
      |    |  (x, y)
      +------------------------> X

Coordinates
    x, y       midpoint of the rear axle [m]
    theta      heading of the body from X [rad]
    phi        steering angle of the front wheel from the body [rad]

Quasi-velocities
    v          (x' cos(theta) + y' sin(theta))/cos(phi) [m/s]                    (4.72)
    v_Y        -x' sin(theta) + y' cos(theta) [m/s]: 0                           (4.74, row 2)
    v_R        l theta' cos(theta) cos(phi) - x' sin(phi) [m/s]: 0               (4.73)
    phidot     phi' [rad/s]

Parameters
    m          mass [kg]
    I_theta    inertia that goes with theta' [kg m^2]
    I_phi      inertia that goes with phi' [kg m^2]
    l          wheelbase [m]
    F_v        force that goes with v [N]
    tau        steering torque [N m]

    L = 1/2 m (v^2 + v_Y^2 + v_R^2) + 1/2 I_phi phi'^2 + 1/2 I_theta theta'^2    (4.76)
    with s = sin(phi), c = cos(phi), no term dropped:
    (m + I_theta s^2/l^2) v' + I_theta s c phi' v/l^2 + m v phi' tan(phi) = F_v
    I_phi phi'' - m v^2 tan(phi) = tau
    lambda of v_Y and v_R in N

These are the consequences of 4.74 and 4.76, not the motion of a vehicle: the steering torque
m v^2 tan(phi) does not exist, see tricycle. Both angles must stay between -pi/2 and pi/2.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def velocities(t, q, v, params):
    """(v, v_Y, v_R, phidot) of 4.74 (m/s, m/s, m/s, rad/s)."""
    x_rate, y_rate, theta_rate, steer = v
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    along = (x_rate * c + y_rate * s) / jnp.cos(q[3])
    sideways = -x_rate * s + y_rate * c
    front = params["l"] * theta_rate * c * jnp.cos(q[3]) - x_rate * jnp.sin(q[3])
    return jnp.stack([along, sideways, front, steer])


def kinetic(t, q, v, params):
    """L of 4.76 [J]."""
    moving = 0.5 * params["m"] * jnp.sum(velocities(t, q, v, params)[:3] ** 2)
    return moving + 0.5 * params["I_phi"] * v[3] ** 2 + 0.5 * params["I_theta"] * v[2] ** 2


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def drive(t, q, v, params):
    """F_v times the row of v in 4.74, and tau on phi (N, N, N m, N m)."""
    along = params["F_v"] / jnp.cos(q[3])
    zero = jnp.zeros_like(along)
    return jnp.stack([along * jnp.cos(q[2]), along * jnp.sin(q[2]), zero, params["tau"]])


system = jl.System(
    coordinates=("x", "y", "theta", "phi"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(drive, "drive"),),
    quasi=jl.QuasiVelocities(velocities, ("v", "v_Y", "v_R", "phidot"), constrained=("v_Y", "v_R")),
)

entry = Entry(
    name="tricycle_book_lagrangian",
    book="ch. 4, sec. 4.3, Example 2, eqs. 4.72-4.76",
    system=system,
    coordinate_units=("m", "m", "rad", "rad"),
    quasi_units=("m/s", "m/s", "m/s", "rad/s"),
    multiplier_units={"v_Y": "N", "v_R": "N"},
    parameter_units={
        "m": "kg",
        "I_theta": "kg m^2",
        "I_phi": "kg m^2",
        "l": "m",
        "F_v": "N",
        "tau": "N m",
    },
    example=Example(
        params={"m": 2.5, "I_theta": 0.5, "I_phi": 1.5, "l": 1.0, "F_v": 0.4, "tau": -0.2},
        q0=(0.0, 0.0, 0.0, 0.0),
        v0=(0.6, 0.0, 0.0, 0.1),
        duration=3.0,
    ),
)
