r"""Robot arm of two links with a motor at each joint, carrying a load.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.7 (Fig. 2.12, eqs. 2.32-2.41). Gravity
and the mass of the motor at A are additions; the book derives the law of moments below.

     y                                 B  load m
     ^                               /
     |                             /   l2
     |                           /
     |             motor mA    A - - - - - theta2
     |                 ____----
     |         ____----   l1
     |   ____----
     O--- - - - - - - - - - - - theta1  --> x

    at O: torque tauO of the ground on link 1;   at A: torque tauA of link 1 on link 2

Coordinates
    theta1, theta2   angles of the links OA and AB, BOTH from the horizontal [rad], positive
                     counterclockwise

Parameters
    mA           mass of the motor at A [kg]
    m            load at B [kg]; the links have no mass
    l1, l2       lengths of the links [m]
    g            gravity along -y [m/s^2]
    tauO0        amplitude of tauO = tauO0 cos(Omega t) [N m]
    tauA0        amplitude of tauA = tauA0 sin(Omega t) [N m]
    Omega        angular frequency of both [rad/s]

    T = 1/2 mA l1^2 theta1'^2 + 1/2 m [l1^2 theta1'^2 + l2^2 theta2'^2
        + 2 l1 l2 theta1' theta2' cos(theta1 - theta2)]
    V = mA g l1 sin(theta1) + m g (l1 sin(theta1) + l2 sin(theta2))
    Q = (tauO - tauA, tauA)

With the load's angular momentum h = r_BA x m v_B about the moving point A, the moment of all
forces on the load about A is

    tau_B/A = r_BA x m a_B = dh/dt + v_A x m v_B                                    (2.41)

and the last term drops out only where A rests or v_A is parallel to v_B.
"""

import jax
import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def ends(t, q, params):
    """Positions of A and B [m], shape (2, 2)."""
    theta1, theta2 = q
    link1 = params["l1"] * jnp.array([jnp.cos(theta1), jnp.sin(theta1)])
    link2 = params["l2"] * jnp.array([jnp.cos(theta2), jnp.sin(theta2)])
    return jnp.stack([link1, link1 + link2])


def masses(params):
    """Masses at A and B [kg]."""
    return jnp.array([params["mA"], params["m"]])


def kinetic(t, q, v, params):
    """T of motor and load [J]."""
    return jl.energy.particles(ends, masses(params), t, q, v, params)


def potential(t, q, params):
    """V of motor and load [J], zero at the height of O."""
    return jl.energy.gravity(masses(params), ends(t, q, params), (0.0, -params["g"]))


def torque_O(t, q, v, params):
    """tauO = tauO0 cos(Omega t) [N m]."""
    return params["tauO0"] * jnp.cos(params["Omega"] * t)


def torque_A(t, q, v, params):
    """tauA = tauA0 sin(Omega t) [N m]."""
    return params["tauA0"] * jnp.sin(params["Omega"] * t)


def load_moment(t, q, v, a, params):
    """tau_B/A = r_BA x m a_B [N m], along z."""

    def velocities(t, q, v):
        return jl.energy.velocity(ends, t, q, v, params)

    A, B = ends(t, q, params)
    _, (_, a_B) = jax.jvp(velocities, (t, q, v), (jnp.ones_like(t), v, a))
    return params["m"] * _cross(B - A, a_B)


def load_angular_momentum(t, q, v, a, params):
    """h = r_BA x m v_B about A [N m s], along z."""
    A, B = ends(t, q, params)
    _, v_B = jl.energy.velocity(ends, t, q, v, params)
    return params["m"] * _cross(B - A, v_B)


def load_moment_from_momentum(t, q, v, a, params):
    """dh/dt + v_A x m v_B [N m], along z (2.41)."""

    def h(t, q, v):
        return load_angular_momentum(t, q, v, a, params)

    v_A, v_B = jl.energy.velocity(ends, t, q, v, params)
    _, h_rate = jax.jvp(h, (t, q, v), (jnp.ones_like(t), v, a))
    return h_rate + params["m"] * _cross(v_A, v_B)


def _cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


system = jl.System(
    coordinates=("theta1", "theta2"),
    kinetic=kinetic,
    potential=potential,
    forces=(
        jl.Torque(lambda t, q, v, params: v[0], torque_O, "motor at O"),
        jl.Torque(lambda t, q, v, params: v[1] - v[0], torque_A, "motor at A"),
    ),
)

entry = Entry(
    name="two_link_robot_arm",
    book="ch. 2, sec. 2.7, Fig. 2.12, eqs. 2.32-2.41",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={
        "mA": "kg",
        "m": "kg",
        "l1": "m",
        "l2": "m",
        "g": "m/s^2",
        "tauO0": "N m",
        "tauA0": "N m",
        "Omega": "rad/s",
    },
    example=Example(
        params={
            "mA": 0.8,
            "m": 1.5,
            "l1": 0.6,
            "l2": 0.5,
            "g": 9.81,
            "tauO0": 6.0,
            "tauA0": 3.0,
            "Omega": 2.0,
        },
        q0=(-1.2, -1.6),
        v0=(0.0, 0.0),
        duration=6.0,
    ),
    extras={
        "tau_B_about_A": load_moment,
        "h_B_about_A": load_angular_momentum,
        "hdot_plus_vAxP": load_moment_from_momentum,
    },
)
