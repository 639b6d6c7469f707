"""Quantities that follow from the states of a motion, one by one."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxlag._system._system import System

QUANTITIES: dict[str, Callable[[System, Any, Any, Any, Any, Any], Any]] = {
    "a": lambda system, t, q, v, params, inputs: system.acceleration(params, q, v, t, inputs),
    "u": lambda system, t, q, v, params, inputs: system.quasi_velocities(params, q, v, t),
    "p": lambda system, t, q, v, params, inputs: system.momentum(params, q, v, t),
    "energy": lambda system, t, q, v, params, inputs: system.energy(params, q, v, t),
    "kinetic": lambda system, t, q, v, params, inputs: system.kinetic(params, q, v, t),
    "potential": lambda system, t, q, v, params, inputs: system.potential(params, q, v, t),
    "power": lambda system, t, q, v, params, inputs: system.power(params, q, v, t, inputs),
    "lam": lambda system, t, q, v, params, inputs: system.multipliers(params, q, v, t, inputs),
    "constraint_force": lambda system, t, q, v, params, inputs: system.constraint_force(
        params, q, v, t, inputs
    ),
    "Q": lambda system, t, q, v, params, inputs: system.generalized_force(params, q, v, t, inputs),
}
"""Quantities of one state, by the name `save=` and the Solution know them under."""
# The same without multipliers solved for, from the equations in quasi-velocities.
_BY_QUASI = {
    name: lambda system, t, q, v, params, inputs, name=name: system.quasi_reactions(
        params, q, v, t, inputs
    )[name]
    for name in ("a", "lam", "constraint_force")
}


def at_saves(
    name: str,
    system: System,
    formulation: str,
    ts: Array,
    q: Array,
    v: Array,
    params: Any,
    inputs: Any,
) -> Any:
    """A quantity at every save time of one motion; NaN where the motion did not get."""
    reached = jnp.isfinite(q[:, 0])
    quantity = QUANTITIES[name]
    if formulation == "quasi":
        quantity = _BY_QUASI.get(name, quantity)

    def at(t: Array, q: Array, v: Array, reached: Array) -> Any:
        # States not reached are NaN: evaluate at the start instead, so that derivatives stay
        # finite.
        unknown = q[0]  # NaN there, with NaN for its derivatives
        q, v, t = (jnp.where(reached, x, x0) for x, x0 in ((q, q0), (v, v0), (t, t0)))
        value = quantity(system, t, q, v, params, inputs)
        return jax.tree.map(lambda x: jnp.where(reached, x, unknown.astype(x.dtype)), value)

    t0, q0, v0 = ts[0], q[0], v[0]
    return jax.vmap(at)(ts, q, v, reached)
