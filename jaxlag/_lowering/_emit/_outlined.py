"""Outlining: straight-line code as a function that XLA does not inline, with its derivatives.

In a loop of steps every stage evaluates the accelerations. In reverse mode every stage evaluates
their transposed derivative. If the code were copied into the loop, XLA's fusion would compute
shared lines again for each use. The derivatives start from the arguments again. Only sines and
cosines are stored: these are most of the work, and few numbers.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxlag._core._arrays import elements
from jaxlag._core._custom_jvp import CustomJVP
from jaxlag._core._linear_map import LinearMap, linear
from jaxlag._core._xla import not_inlined
from jaxlag._lowering._emit import _interpreter
from jaxlag._lowering._emit._code import body_of
from jaxlag._lowering._emit._execute import Pairs, is_trig, stacked, straight
from jaxlag._lowering._graph._straight_line import Program

Halves = tuple[Array, Array]  # (constants of a solve, state and inputs)


@lru_cache(maxsize=256)
def called(
    program: Program, dtype: Any, lanes: bool, columns: bool = False
) -> Callable[[Array, Array], Array]:
    """(constants of a solve, state and inputs) -> results, each as one array.

    Args:
        program: straight-line code.
        dtype: of the results.
        lanes: whether this is vmapped: every scalar is an array of numbers.
        columns: whether several tangents at once are interpreted.
    """
    slots = list(dict.fromkeys(line.args[0] for line in program.body if is_trig(line)))

    def both(numbers: Halves, sincos: Array | None = None) -> tuple[Array, Array]:
        """Results, and their sines and cosines, which may be known already."""
        pairs: Pairs = {}
        known: Pairs | None = None
        if sincos is not None:
            x = elements(sincos)
            known = {slot: (x[2 * i], x[2 * i + 1]) for i, slot in enumerate(slots)}
        given = elements(numbers[0]), elements(numbers[1])
        found = jnp.stack(straight(program, dtype, *given, lanes, pairs, known))
        trig = [x for slot in slots for x in pairs[slot]]
        return found, stacked(trig, dtype)

    def results(numbers: Halves) -> Array:
        return jnp.stack(
            straight(program, dtype, elements(numbers[0]), elements(numbers[1]), lanes)
        )

    @CustomJVP
    def call(carried: Array, given: Array) -> Array:
        return outlined((carried, given))

    @partial(call.defjvp, symbolic_zeros=True)
    def _(primals: Halves, tangents: tuple) -> tuple:
        found, sincos = with_sincos(*primals)
        which = _moving(tangents)
        return found, linear(of_results(which), (primals, sincos), tangents)

    @CustomJVP
    def with_sincos(carried: Array, given: Array) -> tuple[Array, Array]:
        return both_outlined((carried, given))

    @partial(with_sincos.defjvp, symbolic_zeros=True)
    def _(primals: Halves, tangents: tuple) -> tuple:
        found, sincos = with_sincos(*primals)
        which = _moving(tangents)
        return (found, sincos), linear(of_both[which], (primals, sincos), tangents)

    boundary = partial(_by_numbers, dtype=dtype) if lanes else not_inlined
    outlined, both_outlined = boundary(results), boundary(both)
    compiled, of_both = _maps(lambda numbers, sincos: both(numbers, sincos)[0]), _maps(both)

    @cache
    def of_results(which: tuple[bool, bool]) -> LinearMap:
        form = compiled[which]
        return replace(form, of_columns=_columns(program, dtype, which)) if columns else form

    return call


def _by_numbers(function: Callable, dtype: Any) -> Callable:
    """A function of arrays that is not inlined; every number is a separate argument or result.

    In lanes each number is an array. For a table of them, the code would search for each number
    the array that contains it, and compute all arrays for each.
    """

    def whole(arrays: Any) -> Any:
        one = partial(stacked, dtype=dtype)
        return jax.tree.map(one, arrays, is_leaf=lambda x: isinstance(x, list))

    def separate(*numbers: Any) -> Any:
        return jax.tree.map(elements, function(*whole(numbers)))

    inner = not_inlined(separate)
    return lambda *arrays: whole(inner(*jax.tree.map(elements, arrays)))


def _moving(tangents: tuple) -> tuple[bool, bool]:
    carried, given = tangents
    return carried is not None, given is not None


def _maps(function: Callable) -> dict[tuple[bool, bool], LinearMap]:
    """The derivative of function(numbers, sincos) in the numbers, for each set of moving halves."""

    def jvp_fn(at: tuple, dot: tuple) -> Any:
        numbers, sincos = at
        pairs = zip(numbers, dot, strict=True)
        filled = tuple(jnp.zeros_like(x) if d is None else d for x, d in pairs)
        return jax.jvp(lambda x: function(x, sincos), (numbers,), (filled,))[1]

    def vjp_fn(which: tuple[bool, bool]) -> Callable:
        def of(at: tuple, bar: Any) -> tuple:
            numbers, sincos = at
            parts = jax.vjp(lambda numbers: function(numbers, sincos), numbers)[1](bar)[0]
            return tuple(x if moves else None for x, moves in zip(parts, which, strict=True))

        return of

    return {
        which: LinearMap(not_inlined(jvp_fn), not_inlined(vjp_fn(which)), jvp_fn, at_once=None)
        for which in ((True, True), (False, True), (True, False))
    }


def _columns(program: Program, dtype: Any, which: tuple[bool, bool]) -> LinearMap | None:
    """The derivative by the interpreter, for several tangents or cotangents at once.

    None if the derivative of a function has no code.

    Args:
        program: straight-line code.
        dtype: of the results.
        which: the halves that move.
    """
    code = body_of(program)
    count = len(program.carried)
    parts = tuple(zip((count, len(code.given) - count), which, strict=True))
    inner = _interpreter.derivative(code, dtype, True, parts)
    if inner is None:
        return None

    def without_one(halves: Any) -> tuple:
        """Without the 1 at the end of the constants, and without halves that do not move."""
        carried, given = halves
        both = None if carried is None else carried[:-1], given
        return tuple(x for x in both if x is not None)

    def forward(at: tuple, dot: Any) -> Array:
        return inner.forward(without_one(at[0]), without_one(dot))

    def backward(at: tuple, bar: Any) -> tuple:
        found = iter(inner.backward(without_one(at[0]), bar))
        bars = [next(found) if moves else None for moves in which]
        return None if bars[0] is None else jnp.append(bars[0], 0.0), bars[1]

    return LinearMap(forward, backward, forward, backward, at_once=None)
