"""Inputs: signals that forces read by name, from tables, functions of time or the state.

Table inputs have knots where the signal or its slope jumps. The driver ends a step on every
knot, and evaluates a table throughout one step in the one interval that the step lies in, so that
no stage ever reads the wrong side of a jump. All that a step reads of a table is two rows.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlag._captured import Captured, once
from jaxlag._closed import plain
from jaxlag._errors import accepts, bad, require_arity, wants
from jaxlag._input_values import InputValues
from jaxlag._params import concrete


class AbstractInput(eqx.Module):
    """A signal u(t, q, v, params) of any fixed shape."""

    def knots(self) -> Float[Array, " k"] | None:
        """Times (s, increasing) at which steps must end; None if there are none."""
        return None

    def locate(self, t: Float[Array, ""]) -> Int[Array, ""] | None:
        """Index of the table interval that holds t (right-continuous); None without a table."""
        return None

    def value(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        interval: Int[Array, ""] | int | None,
    ) -> Array:
        """The signal at (t, q, v), read from the given table interval."""
        raise NotImplementedError


class AbstractTable(AbstractInput):
    """A signal between times at which it is given.

    Attributes:
        times: shape (k,), s, strictly increasing.
        values: shape (k, ...).
    """

    times: eqx.AbstractVar[Array]
    values: eqx.AbstractVar[Array]

    def knots(self) -> Float[Array, " k"] | None:
        """The table's times."""
        return self.times

    def cut(self, times: Any, values: Any) -> "AbstractTable":
        """The same signal from other rows."""
        return eqx.tree_at(lambda s: (s.times, s.values), self, (times, values))


def _inexact(x: Any) -> Array:
    """`x` as an inexact array; values that are known remain so while JAX traces what is around."""
    if concrete(x):
        with jax.ensure_compile_time_eval():
            x = jnp.asarray(x)
            return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(jnp.result_type(float))
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(jnp.result_type(float))


def _table(kind: str, times: Any, values: Any) -> tuple[Array, Array]:
    times, values = _inexact(times), _inexact(values)
    _increasing(f"{kind}: times", times, 2)
    if values.ndim < 1 or values.shape[0] != times.shape[0]:
        raise bad(
            f"{kind}: values",
            f"have one entry per time, {times.shape[0]}",
            f"its shape was {values.shape}",
        )
    if concrete(values) and not np.all(np.isfinite(values)):
        raise bad(f"{kind}: values", "be finite", "some were nan or inf")
    return times, values


def _increasing(argument: str, times: Array, least: int) -> Array:
    """Times as they are; raises unless there are so many and they increase, as far as is known."""
    if times.ndim != 1 or times.shape[0] < least:
        must = f"be one row of at least {least} times"
        raise bad(argument, must, f"its shape was {times.shape}")
    if concrete(times):
        steps = np.diff(np.asarray(times, float))
        if not np.all(steps > 0):
            i, name = int(np.argmin(steps > 0)), argument.split()[-1]
            raise bad(
                argument,
                "increase strictly",
                f"{name}[{i}] = {times[i]} and {name}[{i + 1}] = {times[i + 1]}",
                "Sort the times and drop repeated ones.",
            )
    return times


def _interval(times: Array, t: Array, last: int) -> Array:
    index = jnp.searchsorted(times, t, side="right").astype(jnp.int32) - 1
    return jnp.clip(index, 0, last)


class ZeroOrderHold(AbstractTable):
    """A table held constant between its times: u(t) = values[i] for times[i] <= t < times[i+1].

    Defined on [times[0], times[-1]]; the last value holds at the last time only. A simulation
    that reaches beyond the table ends with `Status.input_range`.

    Args:
        times: shape (k,), s, strictly increasing, k >= 2.
        values: shape (k, ...), in the unit the force expects; or (k - 1, ...), one for each
            interval between the times, the last of which then holds at the last time, too.

    Raises:
        ValueError: shapes differ, times do not increase, values are not finite.
    """

    times: Array
    values: Array

    def __init__(self, times: Any, values: Any) -> None:
        intervals = np.size(times) - 1
        if intervals > 0 and np.shape(values)[:1] == (intervals,):
            last = np.arange(intervals + 1).clip(max=intervals - 1)
            values = np.asarray(values)[last] if concrete(values) else jnp.asarray(values)[last]
        self.times, self.values = _table("ZeroOrderHold", times, values)

    def locate(self, t: Float[Array, ""]) -> Int[Array, ""] | None:
        """Index i with times[i] <= t < times[i+1]."""
        return _interval(self.times, t, self.times.shape[0] - 1)

    def value(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        interval: Int[Array, ""] | int | None,
    ) -> Array:
        """values[interval]."""
        return self.values[interval]


class Linear(AbstractTable):
    """A table interpolated linearly between its times; continuous, with kinks at the knots.

    Defined on [times[0], times[-1]]; a simulation that reaches beyond ends with
    `Status.input_range`.

    Args:
        times: shape (k,), s, strictly increasing, k >= 2.
        values: shape (k, ...), in the unit the force expects.

    Raises:
        ValueError: shapes differ, times do not increase, values are not finite.
    """

    times: Array
    values: Array

    def __init__(self, times: Any, values: Any) -> None:
        self.times, self.values = _table("Linear", times, values)

    def locate(self, t: Float[Array, ""]) -> Int[Array, ""] | None:
        """Index i with times[i] <= t < times[i+1]."""
        return _interval(self.times, t, self.times.shape[0] - 2)

    def value(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        interval: Int[Array, ""] | int | None,
    ) -> Array:
        """values[i] + (values[i+1] - values[i]) (t - times[i]) / (times[i+1] - times[i])."""
        assert interval is not None
        start, end = self.times[interval], self.times[interval + 1]
        first, last = self.values[interval], self.values[interval + 1]
        fraction = ((t - start) / (end - start)).astype(first.dtype)
        return first + (last - first) * fraction


def _called(f: Callable, params: Any, *arguments: Any) -> Any:
    if isinstance(f, Captured):
        return f.beside(params, *arguments)
    return f(*map(plain, arguments))


class Function(AbstractInput):
    """A signal u(t) given by a function of time, or of time and params, smooth between its knots.

    Where it jumps, or bends, name the times: steps end there, and each step sees the side that it
    lies on. What is shorter than a step and not named may be stepped over; `simulate(dt_max=)`
    bounds the steps.

    Args:
        f: function `f(t)` or `f(t, params)`; t in s. An equinox module keeps its arrays traced.
        knots: shape (k,), s, increasing: where steps are to end. At a jump f(t) is the value from
            there on.

    Raises:
        ValueError: `f` is not callable in either form; knots that are no row of increasing numbers.
    """

    f: Callable
    takes_params: bool = eqx.field(static=True)
    times: Float[Array, " k"] | None
    within: Float[Array, "2"] | None

    def __init__(self, f: Callable, knots: Any = None) -> None:
        self.takes_params = callable(f) and accepts(f, 2) and wants(f, 1, "params")
        require_arity("Function: f", f, ("t", "params") if self.takes_params else ("t",))
        self.f = once(f)
        self.times = self.within = None
        if knots is not None:
            self.times = _increasing("Function: knots", _inexact(knots), 1)
            self.within = _inexact([-np.inf, np.inf])

    def knots(self) -> Float[Array, " k"] | None:
        """The times that were named."""
        return self.times

    def around(self, t: Float[Array, ""]) -> "Function":
        """The same signal in the interval between knots that holds t, both of its ends included."""
        assert self.times is not None
        never = jnp.full((1,), jnp.inf, self.times.dtype)
        ends = jnp.concatenate([-never, self.times, never])
        start = jnp.searchsorted(self.times, t, side="right")
        within = jax.lax.dynamic_slice_in_dim(ends, start, 2)
        return eqx.tree_at(lambda s: s.within, self, within)

    def value(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        interval: Int[Array, ""] | int | None,
    ) -> Array:
        """f(t) or f(t, params)."""
        if self.within is not None:
            first, last = jax.lax.stop_gradient(self.within).astype(t.dtype)
            inside = jnp.clip(t, first, jnp.nextafter(last, -jnp.inf))
            t = t + jax.lax.stop_gradient(inside - t)
        more = (params,) if self.takes_params else ()
        return jnp.asarray(_called(self.f, params, t, *more))


class Feedback(AbstractInput):
    """A signal that depends on the state: u = f(t, q, v, params), e.g. a controller.

    Args:
        f: function `f(t, q, v, params)`; an equinox module keeps its arrays traced.

    Raises:
        ValueError: `f` is not callable in this form.
    """

    f: Callable

    def __init__(self, f: Callable) -> None:
        require_arity("Feedback: f", f, ("t", "q", "v", "params"))
        self.f = once(f)

    def value(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        interval: Int[Array, ""] | int | None,
    ) -> Array:
        """f(t, q, v, params)."""
        return jnp.asarray(_called(self.f, params, t, q, v, params))


def check_inputs(inputs: Any) -> dict[str, Any]:
    """`inputs` as a dict of input objects and arrays, or a ValueError saying what is wrong."""
    if inputs is None:
        return {}
    if not isinstance(inputs, Mapping) or not all(isinstance(k, str) for k in inputs):
        raise bad("inputs", "be a dict from names to input objects or arrays", f"it was {inputs!r}")
    checked = {}
    for name, signal in inputs.items():
        if isinstance(signal, AbstractInput):
            checked[name] = signal
            continue
        if callable(signal):
            raise bad(
                f"inputs[{name!r}]",
                "be an input object or an array",
                f"it was the function {signal!r}",
                "Wrap it in jl.Function (of time) or jl.Feedback (of the state).",
            )
        try:
            checked[name] = jnp.asarray(signal)
        except (TypeError, ValueError) as error:
            must = "be an input object or an array"
            raise bad(f"inputs[{name!r}]", must, f"it was {signal!r}") from error
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
) -> InputValues:
    """Values of all inputs at (t, q, v); integers are numbers like any other.

    Args:
        inputs: by name.
        t: time.
        q: coordinates.
        v: velocities.
        params: as the Lagrangian takes them.
        intervals: in which tables are read; those at t by default.
        since: the time of tables, where that is counted from another origin.
    """
    since = t if since is None else since
    intervals = locate(inputs, since) if intervals is None else intervals

    def value(name: str, signal: Any) -> Any:
        if isinstance(signal, AbstractInput):
            clock = since if isinstance(signal, AbstractTable) else t
            signal = signal.value(clock, q, v, params, intervals[name])
        whole = jnp.issubdtype(jnp.result_type(signal), jnp.integer)
        return jnp.asarray(signal, q.dtype) if whole else signal

    return InputValues({name: value(name, signal) for name, signal in inputs.items()})


def tables(inputs: Mapping[str, Any]) -> dict[str, AbstractTable]:
    """Those of the inputs that are tables."""
    return {name: x for name, x in inputs.items() if isinstance(x, AbstractTable)}


def at_interval(
    inputs: Mapping[str, Any], t: Float[Array, ""]
) -> tuple[dict[str, Any], dict[str, Array]]:
    """The inputs with the two rows of each table around a time, and where these begin.

    Functions with knots are those of the interval around it. In the tables the interval is the
    first one.
    """
    starts = {}
    cuts = dict(inputs)
    for name, table in tables(inputs).items():
        last = table.times.shape[0] - 2
        starts[name] = start = _interval(table.times, t, last)
        rows = partial(jax.lax.dynamic_slice_in_dim, start_index=start, slice_size=2)
        cuts[name] = table.cut(rows(table.times), rows(table.values))
    for name, signal in inputs.items():
        if isinstance(signal, Function) and signal.times is not None:
            cuts[name] = signal.around(t)
    return cuts, starts


def counted_from(origin: Float[Array, ""], inputs: Mapping[str, Any]) -> dict[str, Any]:
    """The inputs, the times of tables counted from another one: small differences of late times."""
    moved = {name: x.cut(x.times - origin, x.values) for name, x in tables(inputs).items()}
    return dict(inputs) | moved


def in_order(inputs: Mapping[str, Any]) -> Bool[Array, ""]:
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
    """Raise where concrete tables do not cover concrete times, called `argument`."""
    span = common_range(inputs)
    if span is None or not concrete(times, *span):
        return
    first, last = (float(x) for x in span)
    low, high = float(np.min(times)), float(np.max(times))
    if low < first or high > last:
        asked = f"from {low} to {high} s" if low < high else f"{low} s"
        raise bad(
            "inputs",
            f"cover {argument}, {asked}",
            f"their tables cover {first} to {last} s",
            f"Extend the tables or change {argument}.",
        )
