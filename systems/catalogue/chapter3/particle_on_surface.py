r"""Particle on a smooth bowl that moves up and down.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.1 (Fig. 3.2, eqs. 3.6-3.11); the book
leaves the surface f(x, y, z, t) = 0 general, here it is an elliptic paraboloid.

         z ^    .
      .    |   .
       .   |  O  m   at (x, y, z)
        .  |.
          .|      ^
           |      |  c sin(Omega t)
           +----------> x, y

Coordinates
    x, y, z   position of the particle, z upward [m]

Parameters
    m         mass [kg]
    a, b      curvatures of the bowl along x and y [1/m]
    c         amplitude of its motion [m], 0 for a bowl at rest
    Omega     angular frequency of its motion [rad/s]
    g         gravity [m/s^2]

    T = 1/2 m (x'^2 + y'^2 + z'^2)      V = m g z
    surface:  f = z - a x^2/2 - b y^2/2 - c sin(Omega t) = 0
    reaction lambda grad f = lambda (-a x, -b y, 1) on the particle, lambda in N

The particle is held to the surface from both sides; one that only lies in the bowl would leave it
where lambda < 0.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m (x'^2 + y'^2 + z'^2) [J]."""
    return 0.5 * params["m"] * v @ v


def potential(t, q, params):
    """V = m g z [J]."""
    return params["m"] * params["g"] * q[2]


def height_above_surface(t, q, params):
    """f = z - a x^2/2 - b y^2/2 - c sin(Omega t) [m]."""
    x, y, z = q
    lift = params["c"] * jnp.sin(params["Omega"] * t)
    return z - 0.5 * params["a"] * x**2 - 0.5 * params["b"] * y**2 - lift


def reaction(t, q, v, a, params):
    """Force of the surface on the particle, lambda grad f [N] (3.10)."""
    return system.constraint_force(q, v, params, t=t)


system = jl.System(
    coordinates=("x", "y", "z"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(height_above_surface, "surface"),),
)

entry = Entry(
    name="particle_on_surface",
    book="ch. 3, sec. 3.1, Fig. 3.2, eqs. 3.6-3.11",
    system=system,
    coordinate_units=("m", "m", "m"),
    multiplier_units={"surface": "N"},
    parameter_units={
        "m": "kg",
        "a": "1/m",
        "b": "1/m",
        "c": "m",
        "Omega": "rad/s",
        "g": "m/s^2",
    },
    example=Example(
        params={"m": 0.4, "a": 0.8, "b": 1.5, "c": 0.1, "Omega": 3.0, "g": 9.81},
        q0=(0.5, 0.0, 0.1),
        v0=(0.0, 0.6, 0.3),
        duration=6.0,
    ),
    extras={"reaction": reaction},
)
