r"""Carnival ride: a rider moved outward on a turning arm, with a prescribed motion.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.8, Example 7 (Fig. 2.13,
eqs. 2.43-2.47).

              Y
              |        / m
              |     r /
              |      /   r(t) = r0 + rdot0 t + rddot t^2/2
              |     /
              |    /  ) theta(t) = thetadot0 t + thetaddot t^2/2
              O----------------> X

Coordinates
    r       distance of the rider from the vertical axis of the ride [m]
    theta   turn of the arm about it [rad]

Parameters
    m                      mass of the rider [kg]
    r0, rdot0, rddot       distance at t = 0 [m], its rate [m/s], its acceleration [m/s^2]
    thetadot0, thetaddot   rate of turn at t = 0 [rad/s], its acceleration [rad/s^2]

    T = 1/2 m (r'^2 + r^2 theta'^2)      V = 0

The motion requires this force on the rider along r and this torque about the axis:

    radial force = m (r'' - r theta'^2)
    torque       = 2 m r r' theta' + m r^2 theta'' = dh/dt,   h = m r^2 theta'

The book calls 2 m r r' theta' and m r^2 theta'' accelerations; they are torques. 2.4 m/s^2 is the
transverse part of the acceleration alone, and 45 m/s^2 is 4.59 g (printed 4.5 g).
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import PrescribedEntry, PrescribedExample


def motion(t, params):
    """(r, theta) at time t (m, rad)."""
    r = params["r0"] + params["rdot0"] * t + 0.5 * params["rddot"] * t**2
    theta = params["thetadot0"] * t + 0.5 * params["thetaddot"] * t**2
    return jnp.stack([r, theta])


def kinetic(t, q, v, params):
    """T = 1/2 m (r'^2 + r^2 theta'^2) [J]."""
    return 0.5 * params["m"] * (v[0] ** 2 + (q[0] * v[1]) ** 2)


def potential(t, q, params):
    """V = 0: the ride is level."""
    return jnp.zeros_like(q[0])


def radial_force(t, q, v, a, params):
    """Force along r required for the motion [N], m (r'' - r theta'^2)."""
    return jl.inverse_dynamics(system, q, v, a, params, t=t)[0]


def torque(t, q, v, a, params):
    """Torque about the axis required for the motion [N m]."""
    return jl.inverse_dynamics(system, q, v, a, params, t=t)[1]


def coriolis_force(t, q, v, a, params):
    """2 m r' theta' [N], transverse to the arm."""
    return 2 * params["m"] * v[0] * v[1]


def centripetal_acceleration(t, q, v, a, params):
    """Acceleration r theta'^2 towards the axis [m/s^2]."""
    return q[0] * v[1] ** 2


def angular_momentum(t, q, v, a, params):
    """Angular momentum h = m r^2 theta' about the axis [kg m^2/s], the momentum of theta."""
    return system.momentum(q, v, params, t=t)[1]


system = jl.System(coordinates=("r", "theta"), kinetic=kinetic, potential=potential)

entry = PrescribedEntry(
    name="carnival_ride",
    book="ch. 2, sec. 2.8, Example 7, Fig. 2.13, eqs. 2.43-2.47",
    system=system,
    coordinate_units=("m", "rad"),
    parameter_units={
        "m": "kg",
        "r0": "m",
        "rdot0": "m/s",
        "rddot": "m/s^2",
        "thetadot0": "rad/s",
        "thetaddot": "rad/s^2",
    },
    example=PrescribedExample(
        params={
            "m": 100.0,
            "r0": 5.0,
            "rdot0": 0.4,
            "rddot": 0.0,
            "thetadot0": 3.0,
            "thetaddot": 0.0,
        },
        duration=4.0,
    ),
    motion=motion,
    extras={
        "torque": torque,
        "radial_force": radial_force,
        "coriolis_force": coriolis_force,
        "centripetal_acceleration": centripetal_acceleration,
        "angular_momentum": angular_momentum,
    },
)
