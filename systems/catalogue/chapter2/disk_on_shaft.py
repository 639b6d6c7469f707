r"""Disk spinning on a shaft that is tilted against a turning one.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.2, Example 2 (Figs. 2.3-2.4,
eqs. 2.8-2.14). Inertia, drive and bearing drag are additions: the book stops at the velocities.

       Z1, fixed
        ^
        |                     \    disk: M, It, Ia
        |               s   __-\-- c
        |              __---    \
        |   theta __---     ) phi, drag c phi'
        |    __---
        | ---  b
        |
        |
        a  ) psi, torque tau0 cos(Omega t)

Coordinates
    psi     turn of the shaft a-b about Z1 [rad], from the plane X1-Z1 to the plane of the shafts
    phi     turn of the disk on the shaft b-c [rad], from the common normal of the shafts to the
            body axis X

Parameters
    M        mass of the disk [kg]
    It, Ia   its inertias about the center [kg m^2]: transverse, and about the shaft
    s        distance of its center from the bend b along the shaft [m]
    theta    angle between the shafts [rad], constant
    tau0     amplitude of the torque on psi [N m]
    Omega    angular frequency of the torque [rad/s]
    c        drag of the disk's bearing [N m s]
    x, y, z  a particle of the disk from its center, in body axes, Z along the shaft [m]

    omega = (psi' sin(theta) sin(phi), psi' sin(theta) cos(phi), phi' + psi' cos(theta))     (2.8)
          = (phi' sin(theta) cos(psi), phi' sin(theta) sin(psi), psi' + phi' cos(theta))     (2.9)
            in body axes, and in the fixed axes X1, Y1, Z1
    |omega|^2 = phi'^2 + psi'^2 + 2 phi' psi' cos(theta)                                    (2.10)
    T = 1/2 (M s^2 + It) psi'^2 sin^2(theta) + 1/2 Ia (phi' + psi' cos(theta))^2
    V = 0      R = 1/2 c phi'^2      Q = (tau0 cos(Omega t), 0)

Both coordinates are cyclic. 2.8 and 2.9 fit together with the body axes turned by
Rz(psi + pi/2) Rx(theta) Rz(phi). Misprint: "s in phi" at the end of vy in 2.14 is sin(phi).
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T of the disk [J]."""
    theta = params["theta"]
    psi_rate, phi_rate = v
    across = (params["M"] * params["s"] ** 2 + params["It"]) * (psi_rate * jnp.sin(theta)) ** 2
    along = params["Ia"] * (phi_rate + psi_rate * jnp.cos(theta)) ** 2
    return 0.5 * (across + along)


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def drive(t, q, v, params):
    """Q = (tau0 cos(Omega t), 0) [N m]."""
    return jnp.array([params["tau0"] * jnp.cos(params["Omega"] * t), 0.0])


def dissipation(t, q, v, params):
    """R = 1/2 c phi'^2 [W]."""
    return 0.5 * params["c"] * v[1] ** 2


def omega_body(t, q, v, a, params):
    """Angular velocity of the disk in body axes [rad/s] (2.8)."""
    theta = params["theta"]
    phi = q[1]
    psi_rate, phi_rate = v
    across = psi_rate * jnp.sin(theta)
    along = phi_rate + psi_rate * jnp.cos(theta)
    return jnp.array([across * jnp.sin(phi), across * jnp.cos(phi), along])


def omega_fixed(t, q, v, a, params):
    """Angular velocity of the disk in the fixed axes [rad/s] (2.9)."""
    theta = params["theta"]
    psi = q[0]
    psi_rate, phi_rate = v
    across = phi_rate * jnp.sin(theta)
    along = psi_rate + phi_rate * jnp.cos(theta)
    return jnp.array([across * jnp.cos(psi), across * jnp.sin(psi), along])


def omega_magnitude(t, q, v, a, params):
    """|omega| [rad/s] (2.10)."""
    psi_rate, phi_rate = v
    cross = 2 * phi_rate * psi_rate * jnp.cos(params["theta"])
    return jnp.sqrt(phi_rate**2 + psi_rate**2 + cross)


def particle_velocity(t, q, v, a, params):
    """Velocity of the particle in body axes [m/s] (2.14); the bend b is at rest."""
    from_bend = jnp.array([params["x"], params["y"], params["z"] + params["s"]])
    return jnp.cross(omega_body(t, q, v, a, params), from_bend)


def shaft_momentum_less_impulse(t, q, v, a, params):
    """p_psi - (tau0/Omega) sin(Omega t) [N m s]: only the drive changes p_psi."""
    impulse = params["tau0"] / params["Omega"] * jnp.sin(params["Omega"] * t)
    return system.momentum(q, v, params, t=t)[0] - impulse


def disk_momentum_plus_drag(t, q, v, a, params):
    """p_phi + c phi [N m s]: only the drag -c phi' changes p_phi."""
    return system.momentum(q, v, params, t=t)[1] + params["c"] * q[1]


system = jl.System(
    coordinates=("psi", "phi"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(drive, "drive"), jl.Rayleigh(dissipation, "bearing")),
)

entry = Entry(
    name="disk_on_shaft",
    book="ch. 2, sec. 2.2, Example 2, Figs. 2.3-2.4, eqs. 2.8-2.14",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={
        "M": "kg",
        "It": "kg m^2",
        "Ia": "kg m^2",
        "s": "m",
        "theta": "rad",
        "tau0": "N m",
        "Omega": "rad/s",
        "c": "N m s",
        "x": "m",
        "y": "m",
        "z": "m",
    },
    example=Example(
        params={
            "M": 2.0,
            "It": 0.02,
            "Ia": 0.04,
            "s": 0.3,
            "theta": 0.8,
            "tau0": 0.5,
            "Omega": 2.0,
            "c": 0.02,
            "x": 0.15,
            "y": 0.0,
            "z": 0.0,
        },
        q0=(0.0, 0.0),
        v0=(0.5, 15.0),
        duration=10.0,
    ),
    extras={
        "omega_body": omega_body,
        "omega_fixed": omega_fixed,
        "omega_magnitude": omega_magnitude,
        "v_point_body": particle_velocity,
    },
    invariants={
        "p_psi_less_impulse": shaft_momentum_less_impulse,
        "p_phi_plus_drag": disk_momentum_plus_drag,
    },
)
