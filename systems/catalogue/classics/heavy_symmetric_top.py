r"""Symmetric top with a fixed point under gravity: Lagrange's top.

Not in the book; Goldstein, Classical Mechanics, sec. 5.7. The quasi-velocities are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 1.

         Z ^     theta    ___
           |        _    /   \ .  axis of the top: e3, spin psi
           |     .'     /  G  \
           |   .'       \   .'
           |           . '-'           G  mass center, l from O
           |       . '  l
           | . '                       e1  horizontal, normal to Z and the axis
           O--------------> X          e2 = e3 x e1

Coordinates
    phi, theta, psi   precession about Z, inclination from Z, spin about the axis [rad]

Quasi-velocities
    w1, w2, w3        angular velocity along e1, e2, e3 [rad/s]

Parameters
    m                 mass [kg]
    g                 gravity [m/s^2]
    l                 distance of the mass center from O [m]
    I1                inertia about O across the axis [kg m^2]
    I3                inertia about the axis [kg m^2]

    w1 = theta',   w2 = phi' sin(theta),   w3 = psi' + phi' cos(theta)
    T = 1/2 I1 (w1^2 + w2^2) + 1/2 I3 w3^2      V = m g l cos(theta)
    I1 w1' = I1 w2^2 cot(theta) - I3 w2 w3 + m g l sin(theta)
    I1 w2' = I3 w1 w3 - I1 w1 w2 cot(theta)
    w3' = 0
    p_phi = I1 w2 sin(theta) + I3 w3 cos(theta) and p_psi = I3 w3 are constant

The rates do not determine phi' and psi' at theta = 0 and pi, the upright and the hanging top.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def angular_velocity(t, q, v, params):
    """(w1, w2, w3) along e1, e2, e3 [rad/s]."""
    theta, (precession, lean, spin) = q[1], v
    return jnp.stack([lean, precession * jnp.sin(theta), spin + precession * jnp.cos(theta)])


def kinetic(t, q, u, params):
    """T = 1/2 I1 (w1^2 + w2^2) + 1/2 I3 w3^2 [J]."""
    w1, w2, w3 = u
    return 0.5 * params["I1"] * (w1**2 + w2**2) + 0.5 * params["I3"] * w3**2


def potential(t, q, params):
    """V = m g l cos(theta) [J]."""
    return params["m"] * params["g"] * params["l"] * jnp.cos(q[1])


def spin_momentum(t, q, v, a, params):
    """p_psi [kg m^2/s]."""
    return params["I3"] * angular_velocity(t, q, v, params)[2]


def vertical_momentum(t, q, v, a, params):
    """p_phi [kg m^2/s]."""
    _, w2, w3 = angular_velocity(t, q, v, params)
    return params["I1"] * w2 * jnp.sin(q[1]) + params["I3"] * w3 * jnp.cos(q[1])


system = jl.System(
    coordinates=("phi", "theta", "psi"),
    kinetic=kinetic,
    potential=potential,
    quasi=jl.QuasiVelocities(angular_velocity, ("w1", "w2", "w3")),
    written_in="u",
)

entry = Entry(
    name="heavy_symmetric_top",
    book="not in the book; Goldstein, sec. 5.7; ch. 4, sec. 4.3, Example 1",
    system=system,
    coordinate_units=("rad", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "rad/s"),
    parameter_units={
        "m": "kg",
        "g": "m/s^2",
        "l": "m",
        "I1": "kg m^2",
        "I3": "kg m^2",
    },
    example=Example(
        params={"m": 0.6, "g": 9.81, "l": 0.12, "I1": 0.012, "I3": 0.003},
        q0=(0.0, 0.7, 0.0),
        v0=(-1.0, 0.0, 50.0),
        duration=2.0,
    ),
    invariants={"p_phi": vertical_momentum, "p_psi": spin_momentum},
)
