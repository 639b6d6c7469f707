r"""Spherical pendulum: a bob on a massless string of fixed length, free to swing all round.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.1 (Fig. 3.1, eqs. 3.3-3.4).

           z ^
             |
             o----> y       x = L cos(theta) sin(phi)
            /|\             y = L sin(theta) sin(phi)
         x v | \            z = -L cos(phi)
             |  \ L
             |   \
            phi   \
             |     O  m

Coordinates
    theta   azimuth of the bob about the vertical z [rad], from x towards y
    phi     angle of the string from the downward vertical [rad]

Parameters
    m       mass of the bob [kg]
    L       length of the string [m]
    g       gravity [m/s^2]

    T = 1/2 m L^2 (phi'^2 + theta'^2 sin^2(phi))      V = -m g L cos(phi)
    p_theta = m L^2 sin^2(phi) theta' (constant)
    phi'' = theta'^2 sin(phi) cos(phi) - (g/L) sin(phi)
    tension = m g cos(phi) + m L (phi'^2 + theta'^2 sin^2(phi))

theta is undefined where the string is vertical, and the mass matrix is singular there
(sin(phi) = 0). The book lists the coordinates as L, theta, phi with L constant, and stops at the
position of the bob.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m L^2 (phi'^2 + theta'^2 sin^2(phi)) [J]."""
    return 0.5 * params["m"] * params["L"] ** 2 * _turning_squared(q, v)


def potential(t, q, params):
    """V = -m g L cos(phi) [J], zero at the height of the pivot."""
    return -params["m"] * params["g"] * params["L"] * jnp.cos(q[1])


def tension(t, q, v, a, params):
    """Tension of the string, m g cos(phi) + m L (phi'^2 + theta'^2 sin^2(phi)) [N]."""
    along = params["g"] * jnp.cos(q[1]) + params["L"] * _turning_squared(q, v)
    return params["m"] * along


def angular_momentum(t, q, v, a, params):
    """p_theta = m L^2 sin^2(phi) theta', about the vertical [kg m^2/s]."""
    return params["m"] * (params["L"] * jnp.sin(q[1])) ** 2 * v[0]


def _turning_squared(q, v):
    """Square of the rate at which the string turns [rad^2/s^2]."""
    azimuth_rate, w = v
    return w**2 + (azimuth_rate * jnp.sin(q[1])) ** 2


system = jl.System(coordinates=("theta", "phi"), kinetic=kinetic, potential=potential)

entry = Entry(
    name="spherical_pendulum_fixed",
    book="ch. 3, sec. 3.1, Fig. 3.1, eqs. 3.3-3.4",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={"m": "kg", "L": "m", "g": "m/s^2"},
    example=Example(
        params={"m": 0.5, "L": 1.0, "g": 9.81}, q0=(0.0, 1.2), v0=(1.5, 0.0), duration=8.0
    ),
    extras={"tension": tension},
    invariants={"p_theta": angular_momentum},
)
