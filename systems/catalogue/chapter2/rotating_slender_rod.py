r"""Slender rod pinned to the end of an arm that turns about the vertical.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.5, Example 6 (Fig. 2.9,
eqs. 2.28-2.30). Gravity and the drive torque are additions: the book stops at T.

      Z1, vertical, fixed
       ^     :theta2
       |     :   /
       |     :  /   rod: rho, L (body axis Y)
       |     : /
       |     :/
       +-----O      pin, horizontal and at right angles to the arm
       |  R
       ) theta1     turn of the arm, torque tau0 cos(Omega t)

Coordinates
    theta1   turn of the arm about Z1 [rad], counterclockwise from above
    theta2   angle of the rod from the UPWARD vertical [rad], positive outward; this
             is what omega_y = +theta1' cos(theta2) implies

Parameters
    rho      mass of the rod per length [kg/m]
    L        length of the rod [m]
    R        length of the (massless) arm [m]
    g        gravity [m/s^2]
    tau0     amplitude of the torque on theta1 [N m]
    Omega    angular frequency of the torque [rad/s]

    M = rho L,   ybar = L/2,   Ix = Iz = rho L^3/3 about O,   Iy = 0
    T = 1/2 M R^2 theta1'^2 + 1/2 Iz theta1'^2 sin^2(theta2)
        + M ybar R theta1'^2 sin(theta2) + 1/2 Ix theta2'^2               (2.30)
    V = M g ybar cos(theta2)

Misprints: item 6 lists ybar = 0 among the zeros, yet 2.30 keeps M ybar R, with ybar = L/2; item 3
gives the Z velocity as +l theta2', which omega_x = -theta2' makes -l theta2' (T is the same).
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T of the rod [J] (2.30)."""
    rho, L, R = params["rho"], params["L"], params["R"]
    M, ybar, Ix = rho * L, L / 2, rho * L**3 / 3
    s2 = jnp.sin(q[1])
    w1, w2 = v
    about_axis = M * R**2 + Ix * s2**2 + 2 * M * ybar * R * s2
    return 0.5 * about_axis * w1**2 + 0.5 * Ix * w2**2


def potential(t, q, params):
    """V = M g (L/2) cos(theta2) [J], zero at the height of the arm."""
    return params["rho"] * params["L"] * params["g"] * 0.5 * params["L"] * jnp.cos(q[1])


def drive(t, q, v, params):
    """Q = (tau0 cos(Omega t), 0) [N m]."""
    return jnp.array([params["tau0"] * jnp.cos(params["Omega"] * t), 0.0])


system = jl.System(
    coordinates=("theta1", "theta2"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(drive, "drive"),),
)

entry = Entry(
    name="rotating_slender_rod",
    book="ch. 2, sec. 2.5, Example 6, Fig. 2.9, eqs. 2.28-2.30",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={
        "rho": "kg/m",
        "L": "m",
        "R": "m",
        "g": "m/s^2",
        "tau0": "N m",
        "Omega": "rad/s",
    },
    example=Example(
        params={"rho": 1.2, "L": 1.0, "R": 0.5, "g": 9.81, "tau0": 1.0, "Omega": 2.0},
        q0=(0.0, 2.6),
        v0=(2.0, 0.0),
        duration=6.0,
    ),
)
