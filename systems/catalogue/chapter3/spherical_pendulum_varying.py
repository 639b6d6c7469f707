r"""Spherical pendulum on a string that is drawn in and let out at a given rate.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.1 (Fig. 3.1, eqs. 3.3-3.4), with a
length L of the string that is prescribed: a rheonomic constraint.

           z ^
             |   L = L0 + L1 sin(Omega t)
             o----> y       x = L cos(theta) sin(phi)
            /|\             y = L sin(theta) sin(phi)
         x v | \            z = -L cos(phi)
             |  \ L
             |   \
            phi   \
             |     O  m

Coordinates
    L        length of the string [m], positive
    theta    azimuth of the bob about the vertical z [rad], from x towards y
    phi      angle of the string from the downward vertical [rad]

Parameters
    m        mass of the bob [kg]
    L0, L1   mean length and amplitude [m]
    Omega    angular frequency of the length [rad/s]
    g        gravity [m/s^2]

    T = 1/2 m (L'^2 + L^2 phi'^2 + L^2 theta'^2 sin^2(phi))      V = -m g L cos(phi)
    length:  L - L0 - L1 sin(Omega t) = 0, lambda = -tension in N
    p_theta = m L^2 sin^2(phi) theta' (constant)

The tension does work on the bob as the length changes, so that T + V is not constant.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example
from systems.catalogue.chapter3 import spherical_pendulum_elastic


def potential(t, q, params):
    """V = -m g L cos(phi) [J], zero at the height of the pivot."""
    L, _, phi = q
    return -params["m"] * params["g"] * L * jnp.cos(phi)


def length_excess(t, q, params):
    """L - L0 - L1 sin(Omega t) [m]."""
    return q[0] - params["L0"] - params["L1"] * jnp.sin(params["Omega"] * t)


def tension(t, q, v, a, params):
    """Tension of the string, -lambda [N]."""
    return -system.multipliers(q, v, params, t=t)["length"]


system = jl.System(
    coordinates=("L", "theta", "phi"),
    kinetic=spherical_pendulum_elastic.kinetic,
    potential=potential,
    constraints=(jl.Holonomic(length_excess, "length"),),
)

entry = Entry(
    name="spherical_pendulum_varying",
    book="ch. 3, sec. 3.1, Fig. 3.1, eqs. 3.3-3.4, with a prescribed length",
    system=system,
    coordinate_units=("m", "rad", "rad"),
    multiplier_units={"length": "N"},
    parameter_units={"m": "kg", "L0": "m", "L1": "m", "Omega": "rad/s", "g": "m/s^2"},
    example=Example(
        params={"m": 0.5, "L0": 1.0, "L1": 0.2, "Omega": 1.5, "g": 9.81},
        q0=(1.0, 0.0, 1.0),
        v0=(0.3, 1.5, 0.0),
        duration=8.0,
    ),
    extras={"tension": tension},
    invariants={"p_theta": spherical_pendulum_elastic.angular_momentum},
)
