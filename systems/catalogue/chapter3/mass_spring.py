r"""Mass on a spring: the harmonic oscillator.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 1 (Fig. 3.7, eq. 3.57).

    |/|              +-----+
    |/|---/\/\/\/----|  m  |---> x
    |/|      k       +-----+
    ===========================  smooth

Coordinate
    x    displacement of the mass [m], zero where the spring is unstretched,
         positive where it is stretched

Parameters
    m    mass [kg]
    k    stiffness [N/m]

    T = 1/2 m x'^2      V = 1/2 k x^2      m x'' + k x = 0                (3.57)

The motion is x = x0 cos(w t) + (v0/w) sin(w t) with w^2 = k/m.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m x'^2 [J]."""
    return 0.5 * params["m"] * v[0] ** 2


def potential(t, q, params):
    """V = 1/2 k x^2 [J], zero for the unstretched spring."""
    return 0.5 * params["k"] * q[0] ** 2


system = jl.System(coordinates=("x",), kinetic=kinetic, potential=potential)


def exact(t, q0, v0, params):
    """x = x0 cos(w t) + (v0/w) sin(w t), and x'."""
    w = jnp.sqrt(params["k"] / params["m"])
    c, s = jnp.cos(w * t), jnp.sin(w * t)
    return q0 * c + v0 / w * s, v0 * c - q0 * w * s


entry = Entry(
    name="mass_spring",
    book="ch. 3, Example 1, Fig. 3.7, eq. 3.57",
    system=system,
    coordinate_units=("m",),
    parameter_units={"m": "kg", "k": "N/m"},
    example=Example(params={"m": 1.5, "k": 24.0}, q0=(0.3,), v0=(0.5,), duration=5.0),
    exact=exact,
)
