r"""Rigid aircraft in body axes whose origin is not its mass center.

Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.5, Example 5 (eqs. 4.172-4.197).

                     __
                     \ \            x    u, p
        _            _\ \_________ /
       | \__________/        O    `--.
       |______________ + ___/ \______.'      O  origin of the body axes
                     / / G     y    v, q     G  mass center at (xc, yc, zc)
                    /_/
                                z    w, r    X, Y level, Z down

Coordinates
    X, Y, Z              position of O [m], Z downward
    phi, theta, psi      roll, pitch, yaw [rad]: Rz(psi) Ry(theta) Rx(phi)

Quasi-velocities
    u, v, w              velocity of O along the body axes [m/s]
    p, q, r              angular velocity along the body axes [rad/s]

Parameters
    m                    mass [kg]
    g                    gravity [m/s^2]
    xc, yc, zc           mass center from O, body components rc [m]
    Ix, Iy, Iz           moments of inertia about O [kg m^2]
    Ixy, Ixz, Iyz        products of inertia about O, integrals of xy, xz, yz dm [kg m^2]
    Fx, Fy, Fz           force at O along the body axes [N], constant
    Mx, My, Mz           moment about O along the body axes [N m], constant

    with V = (u, v, w), omega = (p, q, r) and k = T_B/I (0, 0, 1):
    T = 1/2 m V.V + m V.(omega x rc) + 1/2 omega.I_O omega      (V of the book) = -m g (Z + k.rc)
    m [V' + omega x V + omega' x rc + omega x (omega x rc)] = F + m g k
    I_O omega' + omega x I_O omega + m rc x (V' + omega x V) = M + m g rc x k

The rates do not determine phi' and psi' at theta = +-pi/2.

Errors in the book: the term m V.(omega x rc) has the wrong sign in 4.172-4.175, 4.180 and 4.186
(2.16 has the right one), and with it the terms in rc of 4.181-4.184 and 4.188-4.197. 4.197 lacks
V x dT/dV, which 4.170 takes to be zero: the equations as printed lose or gain energy without any
force. Its -rc x F must be +rc x F, and belongs there only for a force at the mass center. The
potential of 4.178 and 4.187 leaves out the height of O; the last element of the inertia matrix
after 4.175 is +Iz.
"""

import jax.numpy as jnp

import jaxlag as jl
from jaxlag import energy
from systems.catalogue import _attitude
from systems.catalogue._entry import Entry, Example


def pose(t, q, params):
    """(R, position of O) of the body axes."""
    return _attitude.matrix(q[3:]), q[:3]


def body(params):
    """Mass, inertia about O and mass center."""
    moments = (params["Ix"], params["Iy"], params["Iz"])
    products = (params["Ixy"], params["Ixz"], params["Iyz"])
    center = jnp.stack([params["xc"], params["yc"], params["zc"]])
    return energy.RigidBody(params["m"], energy.inertia_matrix(*moments, *products), center)


def kinetic(t, q, u, params):
    """T in body components [J]."""
    return body(params).kinetic_from_rates(u[:3], u[3:])


def potential(t, q, params):
    """V = -m g (Z + k.rc) [J]."""
    down = params["g"] * jnp.array([0.0, 0.0, 1.0])
    return body(params).gravity(pose, t, q, params, down)


def origin(t, q, params):
    """Position of O [m]."""
    return q[:3]


def force(t, q, v, params):
    """Force at O along X, Y, Z [N]."""
    return _attitude.matrix(q[3:]) @ jnp.stack([params["Fx"], params["Fy"], params["Fz"]])


def moment(t, q, v, params):
    """Moment about O along the body axes [N m]."""
    return jnp.stack([params["Mx"], params["My"], params["Mz"]])


system = jl.System(
    coordinates=("X", "Y", "Z", "phi", "theta", "psi"),
    kinetic=kinetic,
    potential=potential,
    forces=(
        jl.PointForce(origin, force, "force"),
        jl.Torque(_attitude.angular_velocity, moment, "moment"),
    ),
    quasi=jl.QuasiVelocities(_attitude.body_velocities, ("u", "v", "w", "p", "q", "r")),
    written_in="u",
)

entry = Entry(
    name="rigid_aircraft",
    book="ch. 4, sec. 4.5, Example 5, eqs. 4.172-4.197",
    system=system,
    coordinate_units=("m", "m", "m", "rad", "rad", "rad"),
    quasi_units=("m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s"),
    parameter_units={
        "m": "kg",
        "g": "m/s^2",
        **dict.fromkeys(("xc", "yc", "zc"), "m"),
        **dict.fromkeys(("Ix", "Iy", "Iz", "Ixy", "Ixz", "Iyz"), "kg m^2"),
        **dict.fromkeys(("Fx", "Fy", "Fz"), "N"),
        **dict.fromkeys(("Mx", "My", "Mz"), "N m"),
    },
    example=Example(
        params={
            "m": 8.0,
            "g": 9.81,
            "xc": -0.15,
            "yc": 0.05,
            "zc": 0.1,
            "Ix": 4.0,
            "Iy": 8.0,
            "Iz": 10.0,
            "Ixy": 0.2,
            "Ixz": 0.5,
            "Iyz": -0.1,
            "Fx": 20.0,
            "Fy": -2.0,
            "Fz": -70.0,
            "Mx": 1.0,
            "My": -1.5,
            "Mz": 0.6,
        },
        q0=(0.0, 0.0, -100.0, 0.1, 0.2, 0.4),
        v0=(18.0, 8.0, -1.0, 0.2, 0.1, -0.1),
        duration=2.0,
    ),
)
