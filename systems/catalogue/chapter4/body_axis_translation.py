r"""Particle under a force that turns with a frame of prescribed attitude, in body components.

Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.4, Example 3 (eq. 4.121).

          X ^        x    u, Fx
            |       /
            |      /
            |     m------ y    v, Fy      axes x, y, z turn with
            |     |                       phi(t), theta(t), psi(t)
            |     z    w, Fz
            o---------------> Y
             \
              Z

Coordinates
    X, Y, Z         position [m]

Quasi-velocities
    u, v, w         velocity along x, y, z [m/s]: T_B/I(t) (X', Y', Z')

Parameters
    m               mass [kg]
    Fx, Fy, Fz      force along x, y, z [N], constant
    phi0, phi1      roll phi0 + phi1 t [rad, rad/s]
    theta0, theta1  pitch theta0 + theta1 sin(nu t) [rad]
    nu              angular frequency of the pitch [rad/s]
    psi0, psi1      yaw psi0 + psi1 t [rad, rad/s]

    T = 1/2 m (u^2 + v^2 + w^2)      V = 0
    m (u' - wz v + wy w) = Fx                                                    (4.121)
    m (v' + wz u - wx w) = Fy
    m (w' + wx v - wy u) = Fz
    with the rates wx, wy, wz of the frame along x, y, z
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _attitude
from systems.catalogue._entry import Entry, Example


def attitude(t, params):
    """Prescribed (phi, theta, psi) [rad]."""
    phi = params["phi0"] + params["phi1"] * t
    theta = params["theta0"] + params["theta1"] * jnp.sin(params["nu"] * t)
    psi = params["psi0"] + params["psi1"] * t
    return jnp.stack([phi, theta, psi])


def body_velocity(t, q, v, params):
    """Components of the velocity along x, y, z [m/s]."""
    return _attitude.cosines(attitude(t, params)) @ v


def kinetic(t, q, u, params):
    """T = 1/2 m (u^2 + v^2 + w^2) [J]."""
    return 0.5 * params["m"] * u @ u


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def position(t, q, params):
    """Position along X, Y, Z [m]."""
    return q


def force(t, q, v, params):
    """Force along X, Y, Z [N]."""
    body = jnp.stack([params["Fx"], params["Fy"], params["Fz"]])
    return _attitude.matrix(attitude(t, params)) @ body


system = jl.System(
    coordinates=("X", "Y", "Z"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.PointForce(position, force, "force"),),
    quasi=jl.QuasiVelocities(body_velocity, ("u", "v", "w")),
    written_in="u",
)

entry = Entry(
    name="body_axis_translation",
    book="ch. 4, sec. 4.4, Example 3, eq. 4.121",
    system=system,
    coordinate_units=("m", "m", "m"),
    quasi_units=("m/s", "m/s", "m/s"),
    parameter_units={
        "m": "kg",
        **dict.fromkeys(("Fx", "Fy", "Fz"), "N"),
        "phi0": "rad",
        "phi1": "rad/s",
        "theta0": "rad",
        "theta1": "rad",
        "nu": "rad/s",
        "psi0": "rad",
        "psi1": "rad/s",
    },
    example=Example(
        params={
            "m": 1.5,
            "Fx": 0.8,
            "Fy": -0.5,
            "Fz": 0.6,
            "phi0": 0.2,
            "phi1": 0.4,
            "theta0": 0.1,
            "theta1": 0.5,
            "nu": 1.2,
            "psi0": 0.3,
            "psi1": 0.8,
        },
        q0=(0.0, 0.0, 0.0),
        v0=(1.0, -0.5, 0.3),
        duration=8.0,
    ),
)
