r"""Spherical pendulum on a spring: the length of the string is a third coordinate.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.1 (Fig. 3.1, eqs. 3.3-3.4), with the
length L left free against a spring; the book gives the position of the bob only.

           z ^
             |
             o----> y       x = L cos(theta) sin(phi)
            /|\             y = L sin(theta) sin(phi)
         x v | /            z = -L cos(phi)
             | \  k, L0
             |  /
            phi \
             |   O  m

Coordinates
    L       distance of the bob from the pivot [m], positive
    theta   azimuth of the bob about the vertical z [rad], from x towards y
    phi     angle of the spring from the downward vertical [rad]

Parameters
    m       mass of the bob [kg]
    L0      unstretched length of the spring [m]
    k       stiffness [N/m]
    g       gravity [m/s^2]

    T = 1/2 m (L'^2 + L^2 phi'^2 + L^2 theta'^2 sin^2(phi))
    V = -m g L cos(phi) + 1/2 k (L - L0)^2
    p_theta = m L^2 sin^2(phi) theta' (constant)
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m (L'^2 + L^2 phi'^2 + L^2 theta'^2 sin^2(phi)) [J]."""
    L, _, phi = q
    L_rate, azimuth_rate, w = v
    return 0.5 * params["m"] * (L_rate**2 + (L * w) ** 2 + (L * azimuth_rate * jnp.sin(phi)) ** 2)


def potential(t, q, params):
    """V = -m g L cos(phi) + 1/2 k (L - L0)^2 [J]."""
    L, _, phi = q
    stretch = L - params["L0"]
    return -params["m"] * params["g"] * L * jnp.cos(phi) + 0.5 * params["k"] * stretch**2


def angular_momentum(t, q, v, a, params):
    """p_theta = m L^2 sin^2(phi) theta', about the vertical [kg m^2/s]."""
    return params["m"] * (q[0] * jnp.sin(q[2])) ** 2 * v[1]


system = jl.System(coordinates=("L", "theta", "phi"), kinetic=kinetic, potential=potential)

entry = Entry(
    name="spherical_pendulum_elastic",
    book="ch. 3, sec. 3.1, Fig. 3.1, eqs. 3.3-3.4, with a spring",
    system=system,
    coordinate_units=("m", "rad", "rad"),
    parameter_units={"m": "kg", "L0": "m", "k": "N/m", "g": "m/s^2"},
    example=Example(
        params={"m": 0.5, "L0": 0.8, "k": 40.0, "g": 9.81},
        q0=(0.9, 0.0, 1.0),
        v0=(0.0, 1.5, 0.0),
        duration=6.0,
    ),
    invariants={"p_theta": angular_momentum},
)
