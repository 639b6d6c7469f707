"""Systems for the tests beyond those of the book, and chains of any length."""

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp

import jaxlag as jl


class Case(NamedTuple):
    """A system with a start and params around which random states are drawn."""

    system: jl.System
    params: dict
    q0: tuple
    largest_speed: float = 3.0


def chain_lagrangian(t, q, v, params):
    """n equal links with a bob at the end of each; angles from the downward vertical."""
    m, length, g = params["m"], params["l"], params["g"]
    x_rate = length * jnp.cumsum(jnp.cos(q) * v)
    y_rate = length * jnp.cumsum(jnp.sin(q) * v)
    y = -length * jnp.cumsum(jnp.cos(q))
    return jnp.sum(0.5 * m * (x_rate**2 + y_rate**2) - m * g * y)


@cache
def chain(n, forces=(), lowering="auto"):
    return jl.System(chain_lagrangian, {"theta": (n,)}, forces=forces, lowering=lowering)


CHAIN_PARAMS = {"m": 0.4, "l": 0.3, "g": 9.81}


def driven_pivot(t, q, v, params):
    """Pendulum whose pivot moves as X cos(Omega t), horizontally; L in full, time terms too."""
    m, length, X, omega = params["m"], params["l"], params["X"], params["Omega"]
    pivot_rate = -X * omega * jnp.sin(omega * t)
    x_rate = pivot_rate + length * v[0] * jnp.cos(q[0])
    y_rate = length * v[0] * jnp.sin(q[0])
    return 0.5 * m * (x_rate**2 + y_rate**2) + m * params["g"] * length * jnp.cos(q[0])


def charged(t, q, v, params):
    """Charge e in a field B along z, in the symmetric gauge A = B/2 (-y, x)."""
    x, y = q
    A = 0.5 * params["B"] * jnp.array([-y, x])
    return 0.5 * params["m"] * v @ v + params["e"] * A @ v


def relativistic(t, q, v, params):
    """L = -m c^2 sqrt(1 - v^2/c^2) - m g x."""
    m, c = params["m"], params["c"]
    return -m * c**2 * jnp.sqrt(1 - v @ v / c**2) - m * params["g"] * q[0]


def rotating_bead(t, q, v, params):
    """Bead on the wire y = s^2/2 that rotates at Omega; its mass grows: M depends on t and q."""
    m = params["m"] * (1 + 0.1 * t)
    s, s_rate = q[0], v[0]
    x, y = s, 0.5 * s**2
    x_rate = s_rate - params["Omega"] * y
    y_rate = s * s_rate + params["Omega"] * x
    return 0.5 * m * (x_rate**2 + y_rate**2)


DRIVEN = jl.System(driven_pivot, ("theta",))
CHARGED = jl.System(charged, ("x", "y"))
RELATIVISTIC = jl.System(relativistic, ("x", "y"))
BEAD = jl.System(rotating_bead, ("s",))

GENERAL = {
    "driven_pivot": Case(DRIVEN, {"m": 0.7, "l": 0.5, "g": 9.81, "X": 0.2, "Omega": 3.0}, (0.4,)),
    "charged": Case(CHARGED, {"m": 1.3, "e": -0.8, "B": 2.0}, (0.1, 0.2)),
    "relativistic": Case(RELATIVISTIC, {"m": 1.3, "c": 4.0, "g": 9.81}, (0.1, 0.2), 2.0),
    "bead": Case(BEAD, {"m": 0.6, "Omega": 2.0}, (0.3,)),
    "chain": Case(chain(3), CHAIN_PARAMS, (0.3, -0.4, 0.8)),
}
"""Lagrangians beyond the book: explicit time, terms linear in v, not quadratic, three links."""
