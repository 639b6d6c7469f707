r"""Rigid body that turns about its mass center, in body rates.

Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 1 (eqs. 4.59-4.70).

         X                 x    wx
          \   .-------.   /
           \ /  roll   \ /          body axes x, y, z
            (     G     )           from X, Y, Z by yaw psi about Z,
           / \         / \          then pitch theta, then roll phi
          /   '-------'   \
         Y        |        y    wy
                  Z, z    wz

Coordinates
    phi, theta, psi   roll, pitch, yaw [rad]: Rz(psi) Ry(theta) Rx(phi)

Quasi-velocities
    wx, wy, wz        angular velocity along the body axes [rad/s]

Parameters
    Ix, Iy, Iz        principal moments of inertia [kg m^2]
    tau1, tau2, tau3  torque along the body axes [N m], constant

    wx = phi' - psi' sin(theta)
    wy = theta' cos(phi) + psi' cos(theta) sin(phi)
    wz = psi' cos(theta) cos(phi) - theta' sin(phi)
    T = 1/2 (Ix wx^2 + Iy wy^2 + Iz wz^2)      V = 0
    Ix wx' + (Iz - Iy) wy wz = tau1                                              (4.67)
    Iy wy' + (Ix - Iz) wx wz = tau2
    Iz wz' + (Iy - Ix) wx wy = tau3

Without torque the angular momentum is constant in space. The rates do not determine phi' and psi'
at theta = +-pi/2.

The book presents 4.67 for small angles; it holds for all of them. Its 4.63 has sin(theta) for
cos(theta) in row 1, column 2.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _attitude
from systems.catalogue._entry import Entry, Example


def angular_velocity(t, q, v, params):
    """Components of omega along the body axes [rad/s]."""
    return _attitude.body_rates(q, v)


def inertia(params):
    """Principal moments of inertia [kg m^2]."""
    return jnp.stack([params["Ix"], params["Iy"], params["Iz"]])


def kinetic(t, q, u, params):
    """T in body rates [J]."""
    return 0.5 * inertia(params) @ u**2


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def torque(t, q, v, params):
    """Torque along the body axes [N m]."""
    return jnp.stack([params["tau1"], params["tau2"], params["tau3"]])


def angular_momentum(q, v, params):
    """Angular momentum along X, Y, Z [kg m^2/s]."""
    return _attitude.matrix(q) @ (inertia(params) * _attitude.body_rates(q, v))


system = jl.System(
    coordinates=("phi", "theta", "psi"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.Torque(angular_velocity, torque, "torque"),),
    quasi=jl.QuasiVelocities(angular_velocity, ("wx", "wy", "wz")),
    written_in="u",
)

entry = Entry(
    name="rigid_body_roll_pitch_yaw",
    book="ch. 4, sec. 4.3, Example 1, eqs. 4.59-4.70",
    system=system,
    coordinate_units=("rad", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "rad/s"),
    parameter_units={
        **dict.fromkeys(("Ix", "Iy", "Iz"), "kg m^2"),
        **dict.fromkeys(("tau1", "tau2", "tau3"), "N m"),
    },
    example=Example(
        params={"Ix": 0.9, "Iy": 1.4, "Iz": 2.0, "tau1": 0.15, "tau2": -0.1, "tau3": 0.1},
        q0=(0.2, 0.3, -0.4),
        v0=(0.8, -0.3, 0.5),
        duration=2.0,
    ),
    invariants={
        "angular_momentum_X": lambda t, q, v, a, params: angular_momentum(q, v, params)[0],
        "angular_momentum_Y": lambda t, q, v, a, params: angular_momentum(q, v, params)[1],
        "angular_momentum_Z": lambda t, q, v, a, params: angular_momentum(q, v, params)[2],
    },
)
