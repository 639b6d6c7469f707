"""Inputs of many experiments stacked into one batch, selected by an index."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._model._input_signals import (
    AbstractInput,
    AbstractTable,
    Feedback,
    LinearInterpolation,
    TimeFunction,
    ZeroOrderHold,
)
from jaxlag._model._inputs import check_inputs
from jaxlag._tracing import _params
from jaxlag._tracing._traced_function import TracedFunction, functions_of, traced_function

JUST_AFTER = 1e-9
"""Delay of a knot, over the length of a segment."""


class AbstractStackedInputs(eqx.Module):
    """Inputs by name of many experiments; every array has their axis in front."""

    @abstractmethod
    def at(self, params: Any, ts: Array) -> dict[str, Any]:
        """Inputs of one experiment at these params, as for `jl.simulate` at times ts."""


class StackedInputs(AbstractStackedInputs):
    """Inputs that do not depend on params.

    Functions cannot be leaves of a batch: all that is no array is stored separately.
    """

    arrays: Any
    rest: _params.Static = eqx.field(static=True)

    def at(self, params: Any, ts: Array) -> dict[str, Any]:
        """The given inputs."""
        del params, ts
        return eqx.combine(self.arrays, self.rest.tree)


class ComputedInputs(AbstractStackedInputs):
    """Inputs that depend on params: all are computed, and each experiment selects its own.

    Attributes:
        which: index of the function, by experiment.
        functions: functions of the params.
        ends: last times, s, of the experiments with these functions.
    """

    which: Int[Array, " k"]
    functions: tuple[TracedFunction, ...] = eqx.field(static=True)
    ends: tuple[float, ...] = eqx.field(static=True)

    def at(self, params: Any, ts: Array) -> dict[str, Any]:
        """Inputs of one function."""
        each = [check_inputs(f.function(params)) for f in self.functions]
        if len(each) > 1:
            for inputs in each:
                _check_closures(inputs)
        together = stacked(each, self.ends)
        own = jax.tree.map(lambda x: x[self.which], together.arrays)
        inputs = StackedInputs(own, together.rest).at(params, ts)
        return {name: _after(signal, ts) for name, signal in inputs.items()}


def _after(signal: Any, ts: Array) -> Any:
    """The same signal; a knot at the first time is moved to just after it.

    Otherwise derivatives would not contain its motion where one segment ends and the next begins.
    """
    if not isinstance(signal, AbstractInput) or not signal.tabulated:
        return signal
    field = signal.tabulated[0]
    times = getattr(signal, field)
    if times is None:
        return signal
    inside = jnp.zeros(len(times), bool).at[1:-1].set(True)
    moved = times + JUST_AFTER * jnp.where(inside & (times == ts[0]), ts[-1] - ts[0], 0.0)
    return eqx.tree_at(lambda x: getattr(x, field), signal, moved)


class _OfTime(eqx.Module):
    """One of several functions of time or constants, u(t, params)."""

    name: str = eqx.field(static=True)
    which: Int[Array, ""]
    among: tuple[Any, ...]

    def __call__(self, t: Array, params: Any) -> Array:
        """The selected value; the others are computed, too."""
        nothing = jnp.zeros(0)
        return _chosen(self, t, nothing, nothing, params)


class _OfState(eqx.Module):
    """The same for functions that may read the state, u(t, q, v, params)."""

    name: str = eqx.field(static=True)
    which: Int[Array, ""]
    among: tuple[Any, ...]

    def __call__(self, t: Array, q: Array, v: Array, params: Any) -> Array:
        """The selected value; the others are computed, too."""
        return _chosen(self, t, q, v, params)


def _chosen(
    choice: _OfTime | _OfState, t: Array, q: Array, v: Array, params: Any
) -> Float[Array, "..."]:
    values = [
        x.value(t, q, v, params, None) if isinstance(x, AbstractInput) else x for x in choice.among
    ]
    dtype = jnp.result_type(*values)
    values = [jnp.asarray(x, dtype) for x in values]
    shapes = {x.shape for x in values}
    if len(shapes) > 1:
        was = f"they had {sorted(shapes)}"
        raise invalid(f"inputs[{choice.name!r}]", "have one shape in all experiments", was)
    return jax.lax.select_n(choice.which, *values)


def _check_closures(inputs: dict[str, Any]) -> None:
    """Raise if a signal has params in its closure: a selection needs them as arguments."""
    for name, signal in inputs.items():
        for function in functions_of(signal):
            cells = getattr(function.function, "__closure__", None) or ()
            if not concrete([cell.cell_contents for cell in cells]):
                must = "take params as an argument if experiments have different functions"
                fix = "Write jl.TimeFunction(f(t, params)) or jl.Feedback(f(t, q, v, params))."
                raise invalid(
                    f"inputs[{name!r}]", must, "it closes over the params of inputs(params)", fix
                )


def computed(inputs: Sequence[Any], ends: Sequence[float]) -> ComputedInputs:
    """The inputs of segments if some of them are a function of the params.

    Args:
        inputs: for each segment, by name, or a function.
        ends: last time of each segment, s.
    """
    functions: dict[Any, TracedFunction] = {}
    last: dict[Any, float] = {}
    for each, end in zip(inputs, ends, strict=True):
        key = each if callable(each) else id(each)
        if key not in functions:
            functions[key] = traced_function(each if callable(each) else _constant(each))
        last[key] = max(end, last.get(key, end))
    keys = list(functions)
    which = [keys.index(each if callable(each) else id(each)) for each in inputs]
    found = jnp.asarray(which, jnp.int32), tuple(functions.values()), tuple(last.values())
    return ComputedInputs(*found)


def _constant(inputs: dict[str, Any]) -> Callable[[Any], dict[str, Any]]:
    return lambda params: inputs


def stacked(inputs: Sequence[dict[str, Any]], ends: Sequence[float]) -> StackedInputs:
    """The inputs of segments, with a leading axis.

    Tables are extended with their last value to the longest. Functions and constants may differ:
    the program then contains all of them.

    Args:
        inputs: for each segment.
        ends: last time of each segment, s.

    Raises:
        ValueError: different names, or tables combined with other inputs.
    """
    if any(each.keys() != inputs[0].keys() for each in inputs):
        was = " or ".join(sorted({str(sorted(each)) for each in inputs}))
        raise invalid("names of the inputs", "be the same in every experiment", f"they were {was}")
    columns = {name: _alike(name, [each[name] for each in inputs], ends) for name in inputs[0]}
    each = [dict(zip(columns, x, strict=True)) for x in zip(*columns.values(), strict=True)]
    halves = [eqx.partition(x, _params.is_array) for x in each or [{}] * len(inputs)]
    arrays = jax.tree.map(lambda *x: jnp.stack(list(map(jnp.asarray, x))), *(a for a, _ in halves))
    return StackedInputs(arrays, _params.Static(halves[0][1]))


def _alike(name: str, signals: list[Any], ends: Sequence[float]) -> list[Any]:
    """The same signals, of one structure."""
    kinds = sorted({_kind(signal) for signal in signals})
    tables = any(isinstance(signal, AbstractTable) for signal in signals)
    must = "be tables of one kind in every experiment, or functions and constants in all"
    if tables and len(kinds) > 1:
        raise invalid(f"inputs[{name!r}]", must, f"they were {' and '.join(kinds)}")
    if all(isinstance(signal, LinearInterpolation | ZeroOrderHold) for signal in signals):
        longest = max(len(table.times) for table in signals)
        return [_filled(table, longest) for table in signals]
    of_state = any(isinstance(signal, Feedback) for signal in signals)
    knots = [signal.knots() if isinstance(signal, TimeFunction) else None for signal in signals]
    most = max(0 if times is None else len(times) for times in knots)
    if of_state and most:
        must = "have no knots if another experiment has a Feedback of this name"
        raise invalid(f"inputs[{name!r}]", must, f"one had {most} knots")
    plain = [TimeFunction(x.f) if isinstance(x, TimeFunction) else x for x in signals]
    if not _equal(plain):
        among = _different(plain)
        plain = [_choice(name, one, among, of_state) for one in plain]
    if not most:
        return plain
    later = (_later(times, most, end) for times, end in zip(knots, ends, strict=True))
    return [TimeFunction(x.f, times) for x, times in zip(plain, later, strict=True)]


def _choice(name: str, signal: Any, among: list[Any], of_state: bool) -> TimeFunction | Feedback:
    """The same signal, with its structure among those of all experiments."""
    i = next(i for i, other in enumerate(among) if _equal([signal, other]))
    which = jnp.asarray(i, jnp.int32), (*among[:i], signal, *among[i + 1 :])
    return Feedback(_OfState(name, *which)) if of_state else TimeFunction(_OfTime(name, *which))


def _kind(signal: Any) -> str:
    return type(signal).__name__ if isinstance(signal, AbstractInput) else "a constant"


def _equal(signals: list[Any]) -> bool:
    """Whether they have one structure, so that only their arrays need an axis in front."""
    first, *others = ((jax.tree.structure(a), _params.Static(b)) for a, b in map(_halves, signals))
    shapes = [[np.shape(x) for x in jax.tree.leaves(_halves(signal)[0])] for signal in signals]
    return all(other == first for other in others) and all(x == shapes[0] for x in shapes)


def _halves(signal: Any) -> tuple[Any, Any]:
    return eqx.partition(signal, _params.is_array)


def _different(signals: list[Any]) -> list[Any]:
    """One of each structure, in order."""
    found: list[Any] = []
    for signal in signals:
        if not any(_equal([signal, other]) for other in found):
            found.append(signal)
    return found


def _later(
    times: Array | None, count: int, end: float
) -> Float[np.ndarray, " k"] | Float[Array, " k"]:
    """Knots filled up to `count`: the missing ones lie beyond the end."""
    xp = np if concrete(times) else jnp
    own = np.zeros(0) if times is None else xp.asarray(times, float)
    last = xp.max(xp.append(own, end))
    return xp.concatenate([own, last + 1.0 + np.arange(count - len(own))])


def _filled(table: Any, length: int) -> AbstractInput:
    """A table extended with its last value."""
    xp = np if concrete(table) else jnp
    times, values = xp.asarray(table.times), xp.asarray(table.values)
    missing = length - len(times)
    if not missing:
        return table
    step = times[-1] - times[-2]
    later = times[-1] + step * np.arange(1, missing + 1)
    held = xp.broadcast_to(values[-1], (missing, *values.shape[1:]))
    return type(table)(xp.concatenate([times, later]), xp.concatenate([values, held]))
