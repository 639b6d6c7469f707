"""Input signals that forces read by name: tables, functions of time or of the state."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._tracing._closure_params import plain
from jaxlag._tracing._signature import accepts, require_arity, wants
from jaxlag._tracing._traced_function import TracedFunction, traced_unless_module


class AbstractInput(eqx.Module):
    """A signal u(t, q, v, params) of any fixed shape.

    Attributes:
        tabulated: fields of which a step reads two entries; the first field contains the times.
    """

    tabulated: ClassVar[tuple[str, ...]] = ()

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
    """A signal given at some times.

    Attributes:
        times: shape (k,), s, strictly increasing.
        values: shape (k, ...).
    """

    times: eqx.AbstractVar[Array]
    values: eqx.AbstractVar[Array]
    tabulated = ("times", "values")

    def knots(self) -> Float[Array, " k"] | None:
        """The table's times."""
        return self.times


def _inexact(x: Any) -> Array:
    """`x` as an inexact array; known values stay concrete under a trace of JAX."""
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
        raise invalid(
            f"{kind}: values",
            f"have one entry per time, {times.shape[0]}",
            f"its shape was {values.shape}",
        )
    if concrete(values) and not np.all(np.isfinite(values)):
        raise invalid(f"{kind}: values", "be finite", "some were nan or inf")
    return times, values


def _increasing(argument: str, times: Array, least: int) -> Array:
    """Times unchanged; raises unless there are enough and known ones increase."""
    if times.ndim != 1 or times.shape[0] < least:
        must = f"be an array of at least {least} times"
        raise invalid(argument, must, f"its shape was {times.shape}")
    if concrete(times):
        steps = np.diff(np.asarray(times, float))
        if not np.all(steps > 0):
            i, name = int(np.argmin(steps > 0)), argument.split()[-1]
            raise invalid(
                argument,
                "increase strictly",
                f"{name}[{i}] = {times[i]} and {name}[{i + 1}] = {times[i + 1]}",
                "Sort the times and drop repeated ones.",
            )
    return times


def interval_at(times: Array, t: Array, last: int) -> Array:
    index = jnp.searchsorted(times, t, side="right").astype(jnp.int32) - 1
    return jnp.clip(index, 0, last)


class ZeroOrderHold(AbstractTable):
    """A table held constant between its times: u(t) = values[i] for times[i] <= t < times[i+1].

    Defined on [times[0], times[-1]]; the last value holds at the last time only. A simulation
    that reaches beyond the table ends with `Status.input_range`.

    Args:
        times: shape (k,), s, strictly increasing, k >= 2.
        values: shape (k, ...), in the unit the force expects; or (k - 1, ...), one for each
            interval between the times. The last of these then also holds at the last time.

    Raises:
        ValueError: shapes differ, times do not increase, values are not finite.
    """

    times: Array
    values: Array

    def __init__(self, times: Any, values: Any) -> None:
        times, values = _inexact(times), _inexact(values)
        intervals = times.size - 1
        if intervals > 0 and values.shape[:1] == (intervals,):
            last = np.arange(intervals + 1).clip(max=intervals - 1)
            values = np.asarray(values)[last] if concrete(values) else values[last]
        self.times, self.values = _table("ZeroOrderHold", times, values)

    def locate(self, t: Float[Array, ""]) -> Int[Array, ""] | None:
        """Index i with times[i] <= t < times[i+1]."""
        return interval_at(self.times, t, self.times.shape[0] - 1)

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


class LinearInterpolation(AbstractTable):
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
        self.times, self.values = _table("LinearInterpolation", times, values)

    def locate(self, t: Float[Array, ""]) -> Int[Array, ""] | None:
        """Index i with times[i] <= t < times[i+1]."""
        return interval_at(self.times, t, self.times.shape[0] - 2)

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


def _slope(f: Callable, t: Array) -> Array:
    return jax.jvp(f, (t,), (jnp.ones_like(t),))[1]


def _called(f: Callable, params: Any, *arguments: Any) -> Any:
    if isinstance(f, TracedFunction):
        return f.call_with_closure(params, *arguments)
    return f(*map(plain, arguments))


class TimeFunction(AbstractInput):
    """A signal u(t) given by a function of time, or of time and params, smooth between its knots.

    Name the times of jumps and kinks as knots: steps end there, and each step uses the values of
    its own side. A feature shorter than a step that is no knot may be missed;
    `simulate(dt_max=)` bounds the steps.

    Args:
        f: function `f(t)` or `f(t, params)`; t in s. An equinox module keeps its arrays traced.
        knots: shape (k,), s, increasing: times at which steps end. At a jump f(t) is the value from
            then on. "kvaerno4" and "kvaerno5" have stages beyond the end of a step; they take three
            derivatives of f there.

    Raises:
        ValueError: `f` cannot be called in either form; knots that are not increasing numbers.
    """

    tabulated = ("ends",)

    f: Callable
    takes_params: bool = eqx.field(static=True)
    ends: Float[Array, " k+2"] | None  # -inf, the knots, inf; within a step two of these

    def __init__(self, f: Callable, knots: Any = None) -> None:
        self.takes_params = callable(f) and accepts(f, 2) and wants(f, 1, "params")
        require_arity("TimeFunction: f", f, ("t", "params") if self.takes_params else ("t",))
        self.f = traced_unless_module(f)
        self.ends = None
        if knots is not None:
            times = _increasing("TimeFunction: knots", _inexact(knots), 1)
            joined = (np if concrete(times) else jnp).concatenate
            never = np.full((1,), np.inf, times.dtype)
            self.ends = _inexact(joined((-never, times, never)))

    def knots(self) -> Float[Array, " k"] | None:
        """The declared knots."""
        return None if self.ends is None else self.ends[1:-1]

    def value(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        interval: Int[Array, ""] | int | None,
    ) -> Array:
        """f(t) or f(t, params); within a step on its side of the knots."""
        if self.ends is None or self.ends.size > 2:
            return self._called(t, params)
        return self._called(self._inside(t), params)

    def onwards(self, t: Float[Array, ""], params: Any) -> Array:
        """The same, extended beyond a knot by its Taylor polynomial of degree 3.

        With a constant f beyond the knot, methods with stages beyond the end of a step would lose
        their order, and derivatives in the time of the knot half their digits.
        """
        if self.ends is None or self.ends.size > 2:
            return self._called(t, params)
        inside = self._inside(t)
        along, f = t - inside, partial(self._number, params=params)
        total = f(inside)
        for k in range(1, 4):
            f = partial(_slope, f)
            total = total + f(inside) * (along**k / math.factorial(k))
        return total

    def _number(self, t: Array, params: Any) -> Array:
        value = self._called(t, params)
        inexact = jnp.issubdtype(value.dtype, jnp.inexact)
        return value if inexact else value.astype(t.dtype)

    def _called(self, t: Array, params: Any) -> Array:
        more = (params,) if self.takes_params else ()
        return jnp.asarray(_called(self.f, params, t, *more))

    def _inside(self, t: Array) -> Array:
        """The nearest time on this side of the knots; it moves with a knot if t lies beyond."""
        assert self.ends is not None
        first, last = self.ends.astype(t.dtype)
        slack = 4 * jnp.finfo(t.dtype).eps * jnp.abs(t)
        t = jnp.where(t > last + slack, last, jnp.where(t < first - slack, first, t))
        here, after, before = jax.lax.stop_gradient((t, first, last))
        return t + (jnp.clip(here, after, jnp.nextafter(before, -jnp.inf)) - here)


class Feedback(AbstractInput):
    """A signal that depends on the state: u = f(t, q, v, params), e.g. a controller.

    Args:
        f: function `f(t, q, v, params)`; an equinox module keeps its arrays traced.

    Raises:
        ValueError: `f` cannot be called in this form.
    """

    f: Callable

    def __init__(self, f: Callable) -> None:
        require_arity("Feedback: f", f, ("t", "q", "v", "params"))
        self.f = traced_unless_module(f)

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
