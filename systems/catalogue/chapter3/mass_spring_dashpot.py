r"""Hanging mass with a spring, a dashpot and a harmonic force.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 6 (Fig. 3.11, eqs. 3.91-3.92).

    ===============
      |        |
      \       |-|
    k /       | |  b
      \       +-+
      /        |
      |        |
    +------------+
    |     m      |
    +------------+
      |        |
      v x      v F(t) = F0 cos(Omega t)

Coordinate
    x       displacement of the mass DOWNWARD from the unstretched spring [m]

Parameters
    m       mass [kg]
    k       stiffness [N/m]
    b       damping [N s/m]
    g       gravity [m/s^2]
    F0      amplitude of the force, downward [N]
    Omega   angular frequency of the force [rad/s]

    T = 1/2 m x'^2      V = 1/2 k x^2 - m g x      R = 1/2 b x'^2      Q = F(t)
    m x'' + b x' + k x = m g + F(t)                                       (3.92)

The mass rests at x = m g/k when F0 = 0. Misprint: the book prints V with 1/2 m k x^2 (twice);
there is no m in it.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m x'^2 [J]."""
    return 0.5 * params["m"] * v[0] ** 2


def potential(t, q, params):
    """V = 1/2 k x^2 - m g x [J], zero for the unstretched spring."""
    return 0.5 * params["k"] * q[0] ** 2 - params["m"] * params["g"] * q[0]


def drive(t, q, v, params):
    """Q = F0 cos(Omega t) [N], downward."""
    return jnp.array([params["F0"] * jnp.cos(params["Omega"] * t)])


def dissipation(t, q, v, params):
    """R = 1/2 b x'^2 [W]."""
    return 0.5 * params["b"] * v[0] ** 2


system = jl.System(
    coordinates=("x",),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(drive, "drive"), jl.Rayleigh(dissipation, "dashpot")),
)


def exact(t, q0, v0, params):
    """The damped and driven linear motion (3.92)."""
    m, b, k = (jnp.reshape(params[name], (1, 1)) for name in ("m", "b", "k"))
    weight, drive = m[0] * params["g"], jnp.reshape(params["F0"], 1)
    return _exact.oscillating(t, q0, v0, m, b, k, weight, drive, params["Omega"])


entry = Entry(
    name="mass_spring_dashpot",
    book="ch. 3, Example 6, Fig. 3.11, eqs. 3.91-3.92",
    system=system,
    coordinate_units=("m",),
    parameter_units={
        "m": "kg",
        "k": "N/m",
        "b": "N s/m",
        "g": "m/s^2",
        "F0": "N",
        "Omega": "rad/s",
    },
    example=Example(
        params={"m": 1.5, "k": 60.0, "b": 1.2, "g": 9.81, "F0": 6.0, "Omega": 5.0},
        q0=(0.0,),
        v0=(0.0,),
        duration=12.0,
    ),
    exact=exact,
)
