"""The inputs of a simulation by name: their values, and their table entries within a step.

Inputs have knots where the signal or its slope jumps. The loop ends a step on every knot. Within
one step a table is evaluated only in the interval that contains the step, so that no stage
reads the wrong side of a jump. A step reads two entries of each table.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._model._input_signals import (
    AbstractInput,
    AbstractTable,
    Feedback,
    TimeFunction,
    interval_at,
)
from jaxlag._tracing._input_values import InputValues


def check_inputs(inputs: Any) -> dict[str, Any]:
    """`inputs` as a dict of input objects and arrays; raises a ValueError if they are invalid."""
    if inputs is None:
        return {}
    if not isinstance(inputs, Mapping) or not all(isinstance(k, str) for k in inputs):
        raise invalid(
            "inputs", "be a dict from names to input objects or arrays", f"it was {inputs!r}"
        )
    checked = {}
    for name, signal in inputs.items():
        if isinstance(signal, AbstractInput):
            checked[name] = signal
            continue
        if callable(signal):
            raise invalid(
                f"inputs[{name!r}]",
                "be an input object or an array",
                f"it was the function {signal!r}",
                "Wrap it in jl.TimeFunction (of time) or jl.Feedback (of the state).",
            )
        try:
            checked[name] = jnp.asarray(signal)
        except (TypeError, ValueError) as error:
            must = "be an input object or an array"
            raise invalid(f"inputs[{name!r}]", must, f"it was {signal!r}") from error
    return checked


def locate(inputs: Mapping[str, Any], t: Float[Array, ""]) -> dict[str, Array | None]:
    """Table interval of every input at time t."""
    return {
        name: signal.locate(t) if isinstance(signal, AbstractInput) else None
        for name, signal in inputs.items()
    }


def evaluate(
    inputs: Mapping[str, Any],
    t: Float[Array, ""],
    q: Float[Array, " n"],
    v: Float[Array, " n"],
    params: Any,
    intervals: Mapping[str, Any] | None = None,
    since: Float[Array, ""] | None = None,
    onwards: bool = False,
) -> InputValues:
    """Values of all inputs at (t, q, v); integers are converted to the dtype of q.

    Args:
        inputs: by name.
        t: time.
        q: coordinates.
        v: velocities.
        params: as the Lagrangian takes them.
        intervals: table intervals to read; those at t by default.
        since: the time of tables, if it has another origin.
        onwards: whether functions of time extend beyond the knot at the end of a step.
    """
    since = t if since is None else since
    intervals = locate(inputs, since) if intervals is None else intervals

    def value(name: str, signal: Any) -> Any:
        if isinstance(signal, AbstractInput):
            clock = since if isinstance(signal, AbstractTable) else t
            if onwards and isinstance(signal, TimeFunction):
                signal = signal.onwards(clock, params)
            else:
                signal = signal.value(clock, q, v, params, intervals[name])
        whole = jnp.issubdtype(jnp.result_type(signal), jnp.integer)
        return jnp.asarray(signal, q.dtype) if whole else signal

    return InputValues({name: value(name, signal) for name, signal in inputs.items()})


def tables(inputs: Mapping[str, Any]) -> dict[str, AbstractTable]:
    """The inputs that are tables."""
    return {name: x for name, x in inputs.items() if isinstance(x, AbstractTable)}


def at_interval(
    inputs: Mapping[str, Any], t: Float[Array, ""]
) -> tuple[dict[str, Any], dict[str, Array]]:
    """The inputs with the two table entries around a time, and the indices of the first ones.

    The interval is then the first one of each table; functions are cut to two knots.
    """
    starts = {}
    cuts = dict(inputs)
    for name, signal in inputs.items():
        entries = _entries(signal)
        if entries:
            starts[name] = start = interval_at(entries[0], t, entries[0].shape[0] - 2)
            cut = partial(jax.lax.dynamic_slice_in_dim, start_index=start, slice_size=2)
            cuts[name] = _with_entries(signal, *map(cut, entries))
    return cuts, starts


def marked(signal: Any, start: Array) -> Any:
    """An input with the index of its first entry in place of each table leaf, else None."""
    cut = {id(x) for x in _entries(signal)}
    return jax.tree.map(lambda x: start if id(x) in cut else None, signal)


def _entries(signal: Any) -> list[Array]:
    """The tabulated arrays of a signal."""
    fields = signal.tabulated if isinstance(signal, AbstractInput) else ()
    return [x for x in (getattr(signal, name) for name in fields) if x is not None]


def _with_entries(signal: Any, *entries: Array) -> Any:
    """The same signal with other entries."""
    return eqx.tree_at(lambda s: [getattr(s, name) for name in s.tabulated], signal, entries)


def counted_from(origin: Float[Array, ""], inputs: Mapping[str, Any]) -> dict[str, Any]:
    """The inputs with the times of tables from another origin: late times differ little."""
    given = tables(inputs).items()
    moved = {name: _with_entries(x, x.times - origin, x.values) for name, x in given}
    return dict(inputs) | moved


def knots_increase(inputs: Mapping[str, Any]) -> Bool[Array, ""]:
    """Whether the times of all knots are finite and increase strictly."""
    right = jnp.array(True)
    for signal in inputs.values():
        times = signal.knots() if isinstance(signal, AbstractInput) else None
        if times is None:
            continue
        right = right & jnp.all(jnp.isfinite(times)) & jnp.all(times[1:] > times[:-1])
    return right


def reads_state(inputs: Mapping[str, Any]) -> bool:
    """Whether any of the inputs depends on (q, v)."""
    return any(isinstance(x, Feedback) for x in inputs.values())


def all_knots(inputs: Mapping[str, Any]) -> Float[Array, " k"] | None:
    """Knots of all inputs, unsorted; None if there are none."""
    knots = [s.knots() for s in inputs.values() if isinstance(s, AbstractInput)]
    present = [k for k in knots if k is not None]
    return jnp.concatenate(present) if present else None


def common_range(inputs: Mapping[str, Any]) -> tuple[Array, Array] | None:
    """(first, last) time at which every table is defined; None without tables."""
    present = [table.times for table in tables(inputs).values()]
    if not present:
        return None
    first = jnp.max(jnp.stack([k[0] for k in present]))
    last = jnp.min(jnp.stack([k[-1] for k in present]))
    return first, last


def check_range(inputs: Mapping[str, Any], times: Any, argument: str = "ts") -> None:
    """Raise if concrete tables do not cover concrete times, called `argument`."""
    span = common_range(inputs)
    if span is None or not concrete(times, *span):
        return
    first, last = (float(x) for x in span)
    low, high = float(np.min(times)), float(np.max(times))
    if low < first or high > last:
        asked = f"from {low} to {high} s" if low < high else f"{low} s"
        raise invalid(
            "inputs",
            f"cover {argument}, {asked}",
            f"their tables cover {first} to {last} s",
            f"Extend the tables or change {argument}.",
        )
