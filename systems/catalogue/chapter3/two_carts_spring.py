r"""Two carts joined by a spring, one of them pushed by a constant force.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 13 (Fig. 3.23, eqs. 3.155-3.157).

             +----+    k, l0     +----+
    F1 --->  | m1 |---/\/\/\/\---| m2 |
             +o--o+              +o--o+
    =======================================  smooth
             |--> x1             |--> x2

Coordinates
    x1, x2   positions of the carts [m], both to the right from one origin;
             the spring is unstretched where x2 - x1 = l0

Parameters
    m1, m2   masses [kg]
    k        stiffness [N/m]
    l0       unstretched length of the spring [m]
    F1       constant force on cart 1, to the right [N]

    T = 1/2 m1 x1'^2 + 1/2 m2 x2'^2      V = 1/2 k (x1 - x2 + l0)^2      Q = (F1, 0)
    m1 x1'' = k (x2 - x1 - l0) + F1
    m2 x2'' = -k (x2 - x1 - l0)

The mass center accelerates at F1/(m1 + m2), so m1 x1' + m2 x2' - F1 t stays constant. Misprint:
the parentheses of V are not balanced.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m1 x1'^2 + 1/2 m2 x2'^2 [J]."""
    return 0.5 * params["m1"] * v[0] ** 2 + 0.5 * params["m2"] * v[1] ** 2


def potential(t, q, params):
    """V = 1/2 k (x1 - x2 + l0)^2 [J], zero for the unstretched spring."""
    x1, x2 = q
    return 0.5 * params["k"] * (x1 - x2 + params["l0"]) ** 2


def push(t, q, v, params):
    """Q = (F1, 0) [N]."""
    return jnp.array([params["F1"], 0.0])


def initial_momentum(t, q, v, a, params):
    """m1 x1' + m2 x2' - F1 t, the total momentum at t = 0 [kg m/s]."""
    return params["m1"] * v[0] + params["m2"] * v[1] - params["F1"] * t


system = jl.System(
    coordinates=("x1", "x2"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(push, "push"),),
)


def exact(t, q0, v0, params):
    """The mass center under a constant push, and the carts swinging about it."""
    m1, m2, k, F1 = params["m1"], params["m2"], params["k"], params["F1"]
    total = m1 + m2
    weights = jnp.stack([m1, m2]) / total
    center, speed = _exact.accelerated(t, weights @ q0, weights @ v0, F1 / total)
    w = jnp.sqrt(k * total / (m1 * m2))
    rest = params["l0"] - F1 / (m1 * w**2)
    stretch, rate = q0[1] - q0[0] - rest, v0[1] - v0[0]
    c, s = jnp.cos(w * t), jnp.sin(w * t)
    apart, opening = rest + stretch * c + rate / w * s, rate * c - stretch * w * s
    shares = jnp.stack([-m2, m1]) / total
    return center + shares * apart, speed + shares * opening


entry = Entry(
    name="two_carts_spring",
    book="ch. 3, Example 13, Fig. 3.23, eqs. 3.155-3.157",
    system=system,
    coordinate_units=("m", "m"),
    parameter_units={"m1": "kg", "m2": "kg", "k": "N/m", "l0": "m", "F1": "N"},
    example=Example(
        params={"m1": 1.0, "m2": 2.0, "k": 15.0, "l0": 0.6, "F1": 0.8},
        q0=(0.0, 0.9),
        v0=(0.0, -0.2),
        duration=8.0,
    ),
    invariants={"initial_momentum": initial_momentum},
    exact=exact,
)
