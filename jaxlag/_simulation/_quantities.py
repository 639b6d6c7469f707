"""Quantities computed from the states of a motion."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxlag._core._by_name import ByName
from jaxlag._model._inputs import evaluate
from jaxlag._model._states import named_states, state_names
from jaxlag._system._system import System

Quantity = Callable[..., Any]
"""(system, q, v, params, t=, inputs=) -> the quantity, as the method of `System` returns it."""


def _without_inputs(method: Quantity) -> Quantity:
    def quantity(system: System, q: Any, v: Any, params: Any, *, t: Any, inputs: Any) -> Any:
        return method(system, q, v, params, t=t)

    return quantity


def _input_values(system: System, q: Any, v: Any, params: Any, *, t: Any, inputs: Any) -> ByName:
    values = evaluate(inputs, t, q, v, params).peek()
    states = state_names(system.states)
    return ByName({name: value for name, value in values.items() if name not in states})


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
    "state_rates": System.state_rates,
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
    states: tuple[Array, Array, Array | None],
) -> Any:
    """A quantity at every save time of one motion; NaN at times that were not reached.

    Args:
        name: among `QUANTITIES`.
        system: the mechanical system.
        formulation: of the motion.
        params: as the Lagrangian takes them.
        inputs: by name.
        ts: save times, (s,).
        states: (q, v, x), x of the states beside (q, v) if there are any.
    """
    q = states[0]
    reached = jnp.isfinite(q[:, 0])
    quantity = QUANTITIES[name]
    if formulation == "quasi":
        quantity = _BY_QUASI.get(name, quantity)

    def at(now: Any, reached: Array) -> Any:
        # States not reached are NaN: evaluate at the start instead, so that derivatives stay
        # finite.
        unknown = now[1][0]  # NaN there, also in its derivatives
        t, q, v, x = jax.tree.map(lambda y, y0: jnp.where(reached, y, y0), now, start)
        signals = inputs | named_states(system.states, x)
        value = quantity(system, q, v, params, t=t, inputs=signals)
        return jax.tree.map(lambda y: jnp.where(reached, y, unknown.astype(y.dtype)), value)

    along = ts, *states
    start = jax.tree.map(lambda y: y[0], along)
    return jax.vmap(at)(along, reached)
