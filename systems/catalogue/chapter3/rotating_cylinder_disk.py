r"""Disk spinning on a level rod that turns about the vertical.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 11 (Fig. 3.21, eqs. 3.135-3.143). The
torques of the drives are additions.

         z ^
           |                    ___
      Omega|  rod m1, l        |   |
        .--O===================| B |---> y, along the rod
        '->|                   |___|
           |                  m2, Iy, Iz
           |           x across the rod, so that x, y, z is right-handed; tilt delta about x

Coordinates
    alpha    turn of the rod about the vertical z [rad], Omega = alpha'
    delta    tilt of the rod about x [rad], upward, held at 0
    beta     spin of the disk about the rod [rad]; omega1 = -beta' of the book

Parameters
    m1, l    rod: mass [kg], length [m]
    m2       mass of the disk [kg], its center at the end of the rod
    Iy, Iz   its central inertia about the rod and across it [kg m^2]
    tau_z0   amplitude of the torque on the rod about the vertical [N m]
    tau_b    torque on the spin [N m], constant
    nu       angular frequency of the torque on the rod [rad/s]
    g        gravity [m/s^2]

    T = 1/2 (m1 l^2/3 + m2 l^2) (alpha'^2 cos^2(delta) + delta'^2)
        + 1/2 Iy (beta' + alpha' sin(delta))^2 + 1/2 Iz (delta'^2 + alpha'^2 cos^2(delta))
    V = (m1/2 + m2) g l sin(delta)
    Q = (tau_z0 cos(nu t), 0, tau_b)
    level:  delta = 0, lambda = torque about x that holds the rod in N m
    lambda = Iy Omega omega1 + (m1/2 + m2) g l

Misprints: 3.143 has the torque omega1 Omega (Iy - Iz - m2 l^2) for Iy Omega omega1. It takes the
components of the angular momentum as constant in axes that turn with Omega k - omega1 j, where
they are so in axes that turn with Omega k alone. In 3.141 the third row has omega_x for omega_z,
and the angular momentum about O leaves out the rod, which does not change the torque.
"""

import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from jaxlag import energy
from systems.catalogue._entry import Entry, Example

ALONG = np.array([0.0, 1.0, 0.0])
"""Direction of the rod in its axes."""


def pose(t, q, params):
    """Rotation of the axes x, y, z of the rod, and their origin O at rest."""
    alpha, delta, _ = q
    R = jl.rotation.compose(jl.rotation.about_z(alpha), jl.rotation.about_x(delta))
    return R, jnp.zeros(3)


def rod(params):
    """The rod by its inertia about O."""
    m1, length = params["m1"], params["l"]
    return energy.RigidBody(m1, m1 * length**2 / 3 * (1 - ALONG), 0.5 * length * ALONG)


def disk(params):
    """The disk by its inertia about O; its axes need not spin with it, because it is symmetric."""
    m2, end = params["m2"], params["l"] * ALONG
    central = jnp.stack([params["Iz"], params["Iy"], params["Iz"]])
    return energy.RigidBody(m2, energy.parallel_axis(central, m2, end), end)


def kinetic(t, q, v, params):
    """T of rod and disk [J]."""
    at_rest, omega = energy.body_velocity(pose, t, q, v, params)
    spin = disk(params).kinetic_from_rates(at_rest, omega + v[2] * ALONG)
    return rod(params).kinetic_from_rates(at_rest, omega) + spin


def potential(t, q, params):
    """V of the weights [J], zero at the height of O."""
    down = (0.0, 0.0, -params["g"])
    return sum(body(params).gravity(pose, t, q, params, down) for body in (rod, disk))


def drives(t, q, v, params):
    """Q = (tau_z0 cos(nu t), 0, tau_b) [N m]."""
    return jnp.array([params["tau_z0"] * jnp.cos(params["nu"] * t), 0.0, params["tau_b"]])


def tilt(t, q, params):
    """delta [rad]."""
    return q[1]


def support_torque(t, q, v, a, params):
    """Torque about x that holds the rod level [N m]."""
    return system.multipliers(q, v, params, t=t)["level"]


def support_torque_by_hand(t, q, v, a, params):
    """Iy Omega omega1 + (m1/2 + m2) g l [N m] (3.143, corrected)."""
    weight = (0.5 * params["m1"] + params["m2"]) * params["g"] * params["l"]
    return -params["Iy"] * v[0] * v[2] + weight


system = jl.System(
    coordinates=("alpha", "delta", "beta"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(drives, "drives"),),
    constraints=(jl.Holonomic(tilt, "level"),),
)

entry = Entry(
    name="rotating_cylinder_disk",
    book="ch. 3, Example 11, Fig. 3.21, eqs. 3.135-3.143",
    system=system,
    coordinate_units=("rad", "rad", "rad"),
    multiplier_units={"level": "N m"},
    parameter_units={
        "m1": "kg",
        "m2": "kg",
        "l": "m",
        "Iy": "kg m^2",
        "Iz": "kg m^2",
        "tau_z0": "N m",
        "tau_b": "N m",
        "nu": "rad/s",
        "g": "m/s^2",
    },
    example=Example(
        params={
            "m1": 0.9,
            "m2": 1.6,
            "l": 0.7,
            "Iy": 0.03,
            "Iz": 0.02,
            "tau_z0": 0.5,
            "tau_b": 0.04,
            "nu": 1.5,
            "g": 9.81,
        },
        q0=(0.0, 0.0, 0.0),
        v0=(1.5, 0.0, -10.0),
        duration=5.0,
    ),
    extras={"torque_x": support_torque, "torque_x_formula": support_torque_by_hand},
)
