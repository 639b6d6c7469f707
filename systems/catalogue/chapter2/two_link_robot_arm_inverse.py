r"""Robot arm of two links with a prescribed motion: the torques of its motors.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.7 (Fig. 2.12, eqs. 2.34-2.41). The
motion is an addition.

     y                                 B  load m
     ^                               /
     |                             /   l2
     |                           /     theta2(t) = b0 + b1 cos(wb t)
     |             motor mA    A - - -
     |                 ____----
     |         ____----   l1           theta1(t) = a0 + a1 sin(wa t)
     |   ____----
     O--- - - - - - - - - --> x

Coordinates
    theta1, theta2   angles of the links OA and AB, BOTH from the horizontal [rad], positive
                     counterclockwise

Parameters
    mA           mass of the motor at A [kg]; may be zero
    m            load at B [kg]; the links have no mass
    l1, l2       lengths of the links [m]
    g            gravity along -y [m/s^2]
    a0, a1, wa   theta1: mean and amplitude [rad], angular frequency [rad/s]
    b0, b1, wb   theta2: the same

T and V are those of the driven arm. The required generalized force is (tauO - tauA, tauA), with
the torque tauA of link 1 on link 2, and tauO of the ground on link 1. Without gravity tauA is the
moment tau_B/A = r_BA x m a_B of the load; with gravity tauA = tau_B/A + m g l2 cos(theta2).
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import PrescribedEntry, PrescribedExample
from systems.catalogue.chapter2.two_link_robot_arm import kinetic, load_moment, potential


def motion(t, params):
    """(theta1, theta2) at time t [rad]."""
    theta1 = params["a0"] + params["a1"] * jnp.sin(params["wa"] * t)
    theta2 = params["b0"] + params["b1"] * jnp.cos(params["wb"] * t)
    return jnp.stack([theta1, theta2])


def motor_torque_O(t, q, v, a, params):
    """tauO [N m]: the sum of both components, which are tauO - tauA and tauA."""
    return jnp.sum(jl.inverse_dynamics(system, q, v, a, params, t=t))


def motor_torque_A(t, q, v, a, params):
    """tauA [N m]."""
    return jl.inverse_dynamics(system, q, v, a, params, t=t)[1]


system = jl.System(coordinates=("theta1", "theta2"), kinetic=kinetic, potential=potential)

entry = PrescribedEntry(
    name="two_link_robot_arm_inverse",
    book="ch. 2, sec. 2.7, Fig. 2.12, eqs. 2.34-2.41",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={
        "mA": "kg",
        "m": "kg",
        "l1": "m",
        "l2": "m",
        "g": "m/s^2",
        "a0": "rad",
        "a1": "rad",
        "wa": "rad/s",
        "b0": "rad",
        "b1": "rad",
        "wb": "rad/s",
    },
    example=PrescribedExample(
        params={
            "mA": 1.5,
            "m": 2.5,
            "l1": 0.7,
            "l2": 0.5,
            "g": 9.81,
            "a0": 0.6,
            "a1": 0.4,
            "wa": 2.0,
            "b0": -0.2,
            "b1": 0.7,
            "wb": 3.0,
        },
        duration=6.0,
    ),
    motion=motion,
    extras={
        "motor_torque_O": motor_torque_O,
        "motor_torque_A": motor_torque_A,
        "tau_B_about_A": load_moment,
    },
)
