"""Quantities computed from the states of a motion."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxlag._core._by_name import ByName
from jaxlag._model._inputs import evaluate
from jaxlag._system._system import System

Quantity = Callable[..., Any]
"""(system, q, v, params, t=, inputs=) -> the quantity, as the method of `System` returns it."""


def _without_inputs(method: Quantity) -> Quantity:
    def quantity(system: System, q: Any, v: Any, params: Any, *, t: Any, inputs: Any) -> Any:
        return method(system, q, v, params, t=t)

    return quantity


def _input_values(system: System, q: Any, v: Any, params: Any, *, t: Any, inputs: Any) -> ByName:
    return ByName(evaluate(inputs, t, q, v, params).peek())


QUANTITIES: dict[str, Quantity] = {
    "a": System.acceleration,
    "u": _without_inputs(System.quasi_velocities),
    "p": _without_inputs(System.momentum),
    "energy": _without_inputs(System.energy),
    "kinetic": _without_inputs(System.kinetic),
    "potential": _without_inputs(System.potential),
    "power": System.power,
    "multipliers": System.multipliers,
    "constraint_force": System.constraint_force,
    "Q": System.generalized_force,
    "input_values": _input_values,
}
"""Quantities of one state, by their names in `save=` and the Solution."""


def _from_quasi(name: str) -> Quantity:
    def quantity(system: System, q: Any, v: Any, params: Any, *, t: Any, inputs: Any) -> Any:
        return system._quasi_reactions(q, v, params, t=t, inputs=inputs)[name]

    return quantity


# The same from the equations in quasi-velocities.
_BY_QUASI = {name: _from_quasi(name) for name in ("a", "multipliers", "constraint_force")}


def at_saves(
    name: str,
    system: System,
    formulation: str,
    params: Any,
    inputs: Any,
    ts: Array,
    q: Array,
    v: Array,
) -> Any:
    """A quantity at every save time of one motion; NaN at times that were not reached."""
    reached = jnp.isfinite(q[:, 0])
    quantity = QUANTITIES[name]
    if formulation == "quasi":
        quantity = _BY_QUASI.get(name, quantity)

    def at(t: Array, q: Array, v: Array, reached: Array) -> Any:
        # States not reached are NaN: evaluate at the start instead, so that derivatives stay
        # finite.
        unknown = q[0]  # NaN there, also in its derivatives
        q, v, t = (jnp.where(reached, x, x0) for x, x0 in ((q, q0), (v, v0), (t, t0)))
        value = quantity(system, q, v, params, t=t, inputs=inputs)
        return jax.tree.map(lambda x: jnp.where(reached, x, unknown.astype(x.dtype)), value)

    t0, q0, v0 = ts[0], q[0], v[0]
    return jax.vmap(at)(ts, q, v, reached)
