r"""Suslov's problem: a body about a fixed point that cannot turn about one of its own axes.

Not in the book; Suslov, Theoretical Mechanics (1946). The quasi-velocities are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2.

                     z    wz = 0: a sharp wheel in the body
                     |    on a sphere at rest
                  .--+--.
                 (   O---)---- y    wy
                  '-/---'
                   /
                  x    wx

Coordinates
    phi, theta, psi   roll, pitch, yaw [rad]: Rz(psi) Ry(theta) Rx(phi)

Quasi-velocities
    wx, wy            angular velocity along the body axes x, y [rad/s]
    wz                along z [rad/s]: 0

Parameters
    I1, I2, I3        moments of inertia about O [kg m^2]; I3 does not matter
    I13, I23          elements of the inertia matrix [kg m^2], minus the products of inertia

    T = 1/2 omega.I omega,   I = [[I1, 0, I13], [0, I2, I23], [I13, I23, I3]]      V = 0
    wz = psi' cos(theta) cos(phi) - theta' sin(phi)
    lambda = I13 wx' + I23 wy' + (I2 - I1) wx wy, torque about z in N m
    I1 wx' = -(I13 wx + I23 wy) wy
    I2 wy' = (I13 wx + I23 wy) wx

The energy is constant; the angular velocity goes from one fixed direction in the body to the
opposite one. The rates do not determine phi' and psi' at theta = +-pi/2.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _attitude
from systems.catalogue._entry import Entry, Example


def angular_velocity(t, q, v, params):
    """(wx, wy, wz) [rad/s]."""
    return _attitude.body_rates(q, v)


def inertia(params):
    """Inertia matrix about O along the body axes [kg m^2]."""
    I1, I2, I3, I13, I23 = (params[name] for name in ("I1", "I2", "I3", "I13", "I23"))
    return jnp.array([[I1, 0.0, I13], [0.0, I2, I23], [I13, I23, I3]])


def kinetic(t, q, u, params):
    """T = 1/2 omega.I omega [J]."""
    return 0.5 * u @ inertia(params) @ u


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


system = jl.System(
    coordinates=("phi", "theta", "psi"),
    kinetic=kinetic,
    potential=potential,
    quasi=jl.QuasiVelocities(angular_velocity, ("wx", "wy", "wz"), constrained=("wz",)),
    written_in="u",
)

entry = Entry(
    name="suslov",
    book="not in the book; Suslov (1946); ch. 4, sec. 4.3, Example 2",
    system=system,
    coordinate_units=("rad", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "rad/s"),
    multiplier_units={"wz": "N m"},
    parameter_units=dict.fromkeys(("I1", "I2", "I3", "I13", "I23"), "kg m^2"),
    example=Example(
        params={"I1": 1.5, "I2": 1.2, "I3": 1.0, "I13": 0.4, "I23": -0.2},
        q0=(0.0, 0.0, 0.0),
        v0=(-0.5, 0.3, 0.0),
        duration=5.0,
    ),
)
