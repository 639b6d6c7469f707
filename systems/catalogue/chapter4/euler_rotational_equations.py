r"""Rigid body under a torque that turns with it and damping: Euler's equations.

Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.4, Example 4 (eq. 4.141).

         X                 x    wx,  t1 sin(nu t) - c wx
          \   .-------.   /
           \ /         \ /          body axes x, y, z
            (     O     )           from X, Y, Z by yaw psi about Z,
           / \         / \          then pitch theta, then roll phi
          /   '-------'   \
         Y        |        y    wy,  t2 cos(nu t) - c wy
                  Z, z    wz,  t3 - c wz

Coordinates
    phi, theta, psi   roll, pitch, yaw [rad]: Rz(psi) Ry(theta) Rx(phi)

Quasi-velocities
    wx, wy, wz        angular velocity along the body axes [rad/s]

Parameters
    Ix, Iy, Iz        principal moments of inertia about O [kg m^2]
    t1, t2, t3        torques along the body axes [N m]
    nu                angular frequency of the first two [rad/s]
    c                 damping [N m s]

    T = 1/2 (Ix wx^2 + Iy wy^2 + Iz wz^2)      V = 0
    Rayleigh function 1/2 c (wx^2 + wy^2 + wz^2)
    Ix wx' + (Iz - Iy) wy wz = t1 sin(nu t) - c wx                               (4.141)
    Iy wy' + (Ix - Iz) wx wz = t2 cos(nu t) - c wy
    Iz wz' + (Iy - Ix) wx wy = t3 - c wz

O is the mass center or a fixed point. The rates do not determine phi' and psi' at
theta = +-pi/2.

Misprint: the second and third line of 4.141 have the rate of the first component; it is that of
the second and the third.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example
from systems.catalogue.chapter4 import rigid_body_roll_pitch_yaw as free_body


def torque(t, q, v, params):
    """(t1 sin(nu t), t2 cos(nu t), t3) along the body axes [N m]."""
    phase = params["nu"] * t
    beat = jnp.stack([jnp.sin(phase), jnp.cos(phase), jnp.ones_like(phase)])
    return jnp.stack([params["t1"], params["t2"], params["t3"]]) * beat


def dissipation(t, q, v, params):
    """Rayleigh function, half the power lost [W]."""
    rates = free_body.angular_velocity(t, q, v, params)
    return 0.5 * params["c"] * rates @ rates


system = jl.System(
    coordinates=("phi", "theta", "psi"),
    kinetic=free_body.kinetic,
    potential=free_body.potential,
    forces=(
        jl.Torque(free_body.angular_velocity, torque, "torque"),
        jl.Rayleigh(dissipation, "damping"),
    ),
    quasi=jl.QuasiVelocities(free_body.angular_velocity, ("wx", "wy", "wz")),
    written_in="u",
)

entry = Entry(
    name="euler_rotational_equations",
    book="ch. 4, sec. 4.4, Example 4, eq. 4.141",
    system=system,
    coordinate_units=("rad", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "rad/s"),
    parameter_units={
        **dict.fromkeys(("Ix", "Iy", "Iz"), "kg m^2"),
        **dict.fromkeys(("t1", "t2", "t3"), "N m"),
        "nu": "rad/s",
        "c": "N m s",
    },
    example=Example(
        params={
            "Ix": 0.6,
            "Iy": 0.8,
            "Iz": 1.1,
            "t1": 0.4,
            "t2": 0.3,
            "t3": 0.1,
            "nu": 2.5,
            "c": 0.15,
        },
        q0=(0.2, 0.1, 0.3),
        v0=(0.6, -0.4, 0.8),
        duration=4.0,
    ),
)
