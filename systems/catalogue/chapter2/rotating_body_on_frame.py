r"""Rigid body that spins on a frame which itself turns about the vertical.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.2, Example 1 (Fig. 2.2, eqs. 2.2-2.7;
T from eq. 2.16). Gravity and the drive torque are additions: the book stops at the velocities.

        vertical        Z, shaft of the body
           |             /
           |   theta    /
           |          _/__
           |         /  / \    body: M; A, B, C; mass center (xb, yb, zb)
           |        (  /   )       phi, spin about Z
           |         \/___/
           |         /
           |________/          O lies on the vertical
           |       /
           |      /
           )_____/   frame: turn psi, torque tau

Coordinates
    psi     turn of the frame about the vertical [rad], counterclockwise from above
    phi     turn of the body on its shaft Z [rad], from the horizontal node line of the
            frame to the body axis X

Parameters
    M            mass of the body [kg]
    A, B, C      principal inertias about the mass center, along the body axes X, Y, Z [kg m^2]
    xb, yb, zb   mass center from O in body axes [m]; O is the crossing of shaft and vertical
    theta        tilt of the shaft from the vertical [rad], constant
    g            gravity [m/s^2]
    tau          torque on the frame about the vertical [N m], constant
    x2, y2, z2   a second origin from O in body axes [m]
    x, y, z      a particle of the body from that second origin [m]

The body's axes are turned by Rz(psi) Rx(theta) Rz(phi), the Euler angles z-x-z, and O is at rest:

    omega = (psi' sin(theta) sin(phi), psi' sin(theta) cos(phi), phi' + psi' cos(theta))    (2.2)
    T = 1/2 omega . I_O omega,   I_O = diag(A, B, C) + M (|c|^2 E - c c^T),   c = (xb, yb, zb)
    V = M g [(xb sin(phi) + yb cos(phi)) sin(theta) + zb cos(theta)]
    Q = (tau, 0)

The particle moves at omega x (r2 + r) in body axes, the second origin r2 = (x2, y2, z2) at
omega x r2.

Misprint: the second line of 2.7 lacks the parenthesis before phi' + psi' cos(theta), which
multiplies x as a whole.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def pose(t, q, params):
    """Rotation of the body axes, and their origin O at rest."""
    psi, phi = q
    return jl.rotation.zxz.matrix((psi, params["theta"], phi)), jnp.zeros(3)


def body(params):
    """The body by its inertia about O."""
    M = params["M"]
    c = jnp.array([params["xb"], params["yb"], params["zb"]])
    central = (params["A"], params["B"], params["C"])
    return jl.energy.RigidBody(M, jl.energy.parallel_axis(central, M, c), c)


def kinetic(t, q, v, params):
    """T of the body [J] (2.16)."""
    return body(params).kinetic(pose, t, q, v, params)


def potential(t, q, params):
    """V of the weight [J], zero at the height of O."""
    return body(params).gravity(pose, t, q, params, (0.0, 0.0, -params["g"]))


def drive(t, q, v, params):
    """Q = (tau, 0) [N m]."""
    return jnp.array([params["tau"], 0.0])


def omega_body(t, q, v, a, params):
    """Angular velocity of the body in body axes [rad/s] (2.2)."""
    return jl.energy.body_velocity(pose, t, q, v, params)[1]


def second_origin_velocity(t, q, v, a, params):
    """Velocity of the second origin in body axes [m/s] (2.6)."""
    r2 = jnp.array([params["x2"], params["y2"], params["z2"]])
    return jnp.cross(omega_body(t, q, v, a, params), r2)


def particle_velocity(t, q, v, a, params):
    """Velocity of the particle in body axes [m/s] (2.7)."""
    r = jnp.array([params["x"], params["y"], params["z"]])
    relative = jnp.cross(omega_body(t, q, v, a, params), r)
    return second_origin_velocity(t, q, v, a, params) + relative


def momentum_less_impulse(t, q, v, a, params):
    """p_psi - tau t [N m s]: only the drive changes p_psi."""
    return system.momentum(q, v, params, t=t)[0] - params["tau"] * t


def energy_less_work(t, q, v, a, params):
    """H - tau psi [J]: only the drive does work."""
    return system.energy(q, v, params, t=t) - params["tau"] * q[0]


system = jl.System(
    coordinates=("psi", "phi"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(drive, "drive"),),
)

entry = Entry(
    name="rotating_body_on_frame",
    book="ch. 2, sec. 2.2, Example 1, Fig. 2.2, eqs. 2.2-2.7",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={
        "M": "kg",
        "A": "kg m^2",
        "B": "kg m^2",
        "C": "kg m^2",
        "xb": "m",
        "yb": "m",
        "zb": "m",
        "theta": "rad",
        "g": "m/s^2",
        "tau": "N m",
        "x2": "m",
        "y2": "m",
        "z2": "m",
        "x": "m",
        "y": "m",
        "z": "m",
    },
    example=Example(
        params={
            "M": 1.5,
            "A": 0.02,
            "B": 0.03,
            "C": 0.015,
            "xb": 0.04,
            "yb": 0.01,
            "zb": 0.25,
            "theta": 0.6,
            "g": 9.81,
            "tau": 0.02,
            "x2": 0.05,
            "y2": 0.02,
            "z2": 0.2,
            "x": 0.1,
            "y": -0.03,
            "z": 0.08,
        },
        q0=(0.0, 0.5),
        v0=(1.0, 3.0),
        duration=5.0,
    ),
    extras={
        "omega_body": omega_body,
        "v_origin_body": second_origin_velocity,
        "v_point_body": particle_velocity,
    },
    invariants={
        "p_psi_less_impulse": momentum_less_impulse,
        "H_less_work": energy_less_work,
    },
)
