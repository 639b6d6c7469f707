r"""Knife edge on an inclined plane, its mass center above the edge.

Not in the book; Bloch, Nonholonomic Mechanics and Control (2003), ch. 1. The quasi-velocities are
declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2.

       y ^             v
         |            /  along the edge
         |           /
         |      m, J    phi
         |         /
         +--------------------> x, downhill; the plane is inclined by alpha

Coordinates
    x, y       position of the edge in the plane, x downhill [m]
    phi        its direction from x [rad]

Quasi-velocities
    v          velocity along the edge [m/s]
    v_n        velocity across it, to the right [m/s]: 0
    phidot     phi' [rad/s]

Parameters
    m          mass [kg]
    J          inertia about the edge [kg m^2]
    g          gravity [m/s^2]
    alpha      slope of the plane [rad]

    T = 1/2 m (x'^2 + y'^2) + 1/2 J phi'^2      V = -m g x sin(alpha)
    v   = x' cos(phi) + y' sin(phi)
    v_n = x' sin(phi) - y' cos(phi),   lambda = -m (v phi' + g sin(alpha) sin(phi)) in N
    v' = g sin(alpha) cos(phi)
    phi'' = 0

Let go at rest at x = y = phi = 0 while it turns, the edge stays within
g sin(alpha)/(2 phi'^2) of its start downhill and drifts across the slope.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m (x'^2 + y'^2) + 1/2 J phi'^2 [J]."""
    return 0.5 * params["m"] * v[:2] @ v[:2] + 0.5 * params["J"] * v[2] ** 2


def potential(t, q, params):
    """V = -m g x sin(alpha) [J]."""
    return -params["m"] * params["g"] * jnp.sin(params["alpha"]) * q[0]


def velocities(t, q, v, params):
    """(v, v_n, phidot) (m/s, m/s, rad/s)."""
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    return jnp.stack([v[0] * c + v[1] * s, v[0] * s - v[1] * c, v[2]])


system = jl.System(
    coordinates=("x", "y", "phi"),
    kinetic=kinetic,
    potential=potential,
    quasi=jl.QuasiVelocities(velocities, ("v", "v_n", "phidot"), constrained=("v_n",)),
)


def exact(t, q0, v0, params):
    """An edge that turns, at the constant rate w, from the velocity v along itself."""
    (_, _, start), (v, _, w) = q0, velocities(0.0, q0, v0, params)
    downhill, phi = params["g"] * jnp.sin(params["alpha"]), start + w * t
    s, s0, c, c0 = jnp.sin(phi), jnp.sin(start), jnp.cos(phi), jnp.cos(start)
    rest = v - downhill / w * s0
    x = rest / w * (s - s0) + downhill / (2 * w**2) * (s**2 - s0**2)
    y = -rest / w * (c - c0) + downhill / (2 * w**2) * (phi - start - s * c + s0 * c0)
    along = rest + downhill / w * s
    return q0 + jnp.stack([x, y, w * t]), jnp.stack([along * c, along * s, w])


entry = Entry(
    name="knife_edge_incline",
    book="not in the book; Bloch (2003); ch. 4, sec. 4.3, Example 2",
    system=system,
    coordinate_units=("m", "m", "rad"),
    quasi_units=("m/s", "m/s", "rad/s"),
    multiplier_units={"v_n": "N"},
    parameter_units={"m": "kg", "J": "kg m^2", "g": "m/s^2", "alpha": "rad"},
    example=Example(
        params={"m": 1.0, "J": 0.2, "g": 9.81, "alpha": 0.3},
        q0=(0.0, 0.0, 0.0),
        v0=(0.0, 0.0, 1.5),
        duration=8.0,
    ),
    exact=exact,
)
