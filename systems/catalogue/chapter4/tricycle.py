r"""Tricycle: rear axle and steered front wheel roll without slipping sideways.

Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2 (eqs. 4.72-4.98); the
kinetic energy is that of a rigid body with a fork, not the book's.

    Y ^                    / phi
      |              _ . (/)  front wheel, driven along itself by F_v
      |         _ .-'  l
      |    |.-' G            G  mass center, d ahead of the rear axle
      |   _|_- - - theta
      |    |  (x, y)
      +------------------------> X

Coordinates
    x, y       midpoint of the rear axle [m]
    theta      heading of the body from X [rad]
    phi        steering angle of the front wheel from the body [rad]

Quasi-velocities
    v          velocity of the front contact along the wheel [m/s]
    v_Y        velocity of the rear axle along itself, sideways [m/s]: 0
    v_R        velocity of the front contact across the wheel [m/s]: 0
    phidot     phi' [rad/s]

Parameters
    m          mass of all [kg]
    I_body     yaw inertia of the body about G, without the fork [kg m^2]
    I_steer    inertia of the fork about its axis [kg m^2]
    l          wheelbase [m]
    d          distance of G ahead of the rear axle [m]
    F_v        drive along the front wheel [N]
    tau        steering torque between body and fork [N m]

    T = 1/2 m |velocity of G|^2 + 1/2 I_body theta'^2 + 1/2 I_steer (theta' + phi')^2      V = 0
    v   =  x' cos(theta + phi) + y' sin(theta + phi) + l theta' sin(phi)
    v_Y = -x' sin(theta) + y' cos(theta),      lambda = force on the rear axle along it in N
    v_R = -x' sin(theta + phi) + y' cos(theta + phi) + l theta' cos(phi),
                                               lambda = force on the front wheel across it in N
    with s = sin(phi), c = cos(phi), J = I_body + m d^2:
    (m c^2 + J s^2/l^2) v' + (J/l^2 - m) s c v phi' + tau s/l = F_v
    I_steer (phi'' + theta'') = tau,      theta' = v s/l

Errors in the book: v of 4.72 is the wheel's speed only where v_R = 0, and singular at
phi = +-pi/2; v_R of 4.73 is the sideways velocity times cos(theta) and says nothing at
theta = +-pi/2. The kinetic energy 4.76 is not that of a rigid body and leads to a steering
torque m v^2 tan(phi) that does not exist; theta' is left in it although it depends on the
quasi-velocities; 4.97 and 4.98 have a derivative by theta' for one by theta. The inertia of the
fork belongs to theta' + phi'. The approximations after 4.92 are not needed. For the equations as
printed see tricycle_book_lagrangian.
"""

import jax.numpy as jnp

import jaxlag as jl
from jaxlag import energy
from systems.catalogue._entry import Entry, Example


def ahead(angle):
    """Unit vector in the direction `angle` from X."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def across(angle):
    """Unit vector to its left."""
    return jnp.stack([-jnp.sin(angle), jnp.cos(angle)])


def center(t, q, params):
    """Position of the mass center [m]."""
    return q[:2] + params["d"] * ahead(q[2])


def front(t, q, params):
    """Position of the front contact [m]."""
    return q[:2] + params["l"] * ahead(q[2])


def kinetic(t, q, v, params):
    """T of the mass center, of the body's turn and of the fork's [J]."""
    moving = energy.particles(center, params["m"], t, q, v, params)
    turning = 0.5 * params["I_body"] * v[2] ** 2
    return moving + turning + 0.5 * params["I_steer"] * (v[2] + v[3]) ** 2


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def drive(t, q, v, params):
    """F_v along the front wheel [N]."""
    return params["F_v"] * ahead(q[2] + q[3])


def steering(t, q, v, params):
    """phi' [rad/s]."""
    return v[3]


def torque(t, q, v, params):
    """The steering torque [N m]."""
    return params["tau"]


def velocities(t, q, v, params):
    """(v, v_Y, v_R, phidot) (m/s, m/s, m/s, rad/s)."""
    wheel, at_front = q[2] + q[3], energy.velocity(front, t, q, v, params)
    along, aside = at_front @ ahead(wheel), at_front @ across(wheel)
    return jnp.stack([along, v[:2] @ across(q[2]), aside, v[3]])


system = jl.System(
    coordinates=("x", "y", "theta", "phi"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.PointForce(front, drive, "drive"), jl.Torque(steering, torque, "steering")),
    quasi=jl.QuasiVelocities(velocities, ("v", "v_Y", "v_R", "phidot"), constrained=("v_Y", "v_R")),
)

entry = Entry(
    name="tricycle",
    book="ch. 4, sec. 4.3, Example 2, eqs. 4.72-4.98",
    system=system,
    coordinate_units=("m", "m", "rad", "rad"),
    quasi_units=("m/s", "m/s", "m/s", "rad/s"),
    multiplier_units={"v_Y": "N", "v_R": "N"},
    parameter_units={
        "m": "kg",
        "I_body": "kg m^2",
        "I_steer": "kg m^2",
        "l": "m",
        "d": "m",
        "F_v": "N",
        "tau": "N m",
    },
    example=Example(
        params={
            "m": 30.0,
            "I_body": 4.0,
            "I_steer": 0.4,
            "l": 1.0,
            "d": 0.4,
            "F_v": 10.0,
            "tau": -0.1,
        },
        q0=(0.0, 0.0, 0.0, 0.0),
        v0=(1.0, 0.0, 0.0, 0.5),
        duration=5.0,
    ),
)
