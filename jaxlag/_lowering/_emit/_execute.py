"""Execution of straight-line code, line by line, as JAX operations on scalars."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxlag._core._arrays import elements
from jaxlag._core._custom_jvp import CustomJVP
from jaxlag._core._max_min import largest_p, smallest_p
from jaxlag._lowering._emit._sincos import recalled, sincos
from jaxlag._lowering._graph._expression import FIXED
from jaxlag._lowering._graph._straight_line import Line, Program
from jaxlag._lowering._jaxpr._from_jaxpr import Rule

# From this many lines on, sines and cosines are divided by 1: XLA's CPU backend would
# recompute them for every result that depends on them, but never repeats a division. In short
# code on scalars the compiler finds the repetitions itself.
KEEP_FROM = 120
KEEP_FROM_IN_LANES = 14

_EXTREMES = {"max": largest_p, "min": smallest_p}

_BINARY = {"add": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div}


Pairs = dict[int, tuple[Array, Array]]


def straight(
    program: Program,
    dtype: Any,
    carried: Sequence[Array],
    given: Sequence[Array],
    lanes: bool,
    pairs: Pairs | None = None,
    known: Pairs | None = None,
) -> tuple[Array, ...]:
    """The results of the body.

    `pairs` receives the sine and cosine of every argument, by slot; known ones
    are taken from `known`.
    """
    slots = numbers(program, dtype)
    for slot, x in zip(program.carried, carried, strict=False):
        slots[slot] = x != 0 if slot in program.truths else x
    keep_from = KEEP_FROM_IN_LANES if lanes else KEEP_FROM
    divides = len(program.body) > keep_from and jax.default_backend() == "cpu"
    one = carried[-1] if divides else None
    read = [slot for (name, _), slot in program.inputs.items() if name not in FIXED]
    slots |= dict(zip(read, given, strict=True))
    run(program.body, slots, program.whole, one, pairs, known)
    return tuple(jnp.asarray(slots[slot], dtype) for slot in program.results)


def run(
    lines: Sequence[Line],
    slots: dict[int, Any],
    whole: frozenset[int] = frozenset(),
    one: Array | None = None,
    pairs: Pairs | None = None,
    known: Pairs | None = None,
) -> None:
    """Execute line after line, each into a new slot.

    XLA would move constants out of powers of `whole` slots, which could then overflow.
    """
    ruled: dict[Any, Array] = {}
    pairs = {} if pairs is None else pairs
    for line in lines:
        args = [slots[a] for a in line.args]
        if line.op == "custom":
            rule, index = line.data
            if (rule, line.args) not in ruled:
                ruled[rule, line.args] = _by_rule(rule, args)
            slots[line.to] = ruled[rule, line.args][index]
        elif is_trig(line):
            (argument,) = line.args
            if argument not in pairs and known is not None:
                pairs[argument] = recalled(*args, *known[argument])
            elif argument not in pairs:
                s, c = sincos(*args)
                pairs[argument] = (s, c) if one is None else (s / one, c / one)
            slots[line.to] = pairs[argument][line.data.name == "cos"]
        else:
            slots[line.to] = executed(line, args)
        if line.to in whole:
            slots[line.to] = lax.optimization_barrier(slots[line.to])


def is_trig(line: Line) -> bool:
    """Whether this is a sine or a cosine."""
    return line.op == "call" and line.data.name in ("sin", "cos")


@CustomJVP
def _quotient(x: Array, y: Array) -> Array:
    """x / y with the derivative (dx - x/y dy) / y, which, unlike JAX's, does not square y."""
    return x / y


@_quotient.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (_, y), (dx, dy) = primals, tangents
    z = _quotient(*primals)
    return z, _quotient(dx - z * dy, y)


def executed(line: Line, args: Sequence[Any]) -> Any:
    """The result of a line without a rule of its own."""
    op = line.op
    if op == "div" and args[1].dtype == jnp.float32:
        return _quotient(jnp.asarray(args[0], args[1].dtype), args[1])
    if op in _BINARY:
        return _BINARY[op](*args)
    if op == "neg":
        return lax.neg(args[0])
    if op == "select":
        return lax.select(*args)
    if op == "stop":
        return lax.stop_gradient(args[0])
    if op == "call" and line.data.name in _EXTREMES:
        return _EXTREMES[line.data.name].bind(*args)
    return line.data(*args)


def _by_rule(rule: Rule, args: Sequence[Any]) -> Array:
    """All results of a function with a custom derivative rule, as one array."""
    operands, start = [], 0
    for aval in rule.avals:
        part = [jnp.asarray(x, aval.dtype) for x in args[start : start + aval.size]]
        start += aval.size
        operands.append(jnp.stack(part).reshape(aval.shape) if part else jnp.zeros(aval.shape))
    return jnp.concatenate([jnp.ravel(x) for x in rule.call(*operands)])


def numbers(program: Program, dtype: Any) -> dict[int, Any]:
    return {
        slot: np.asarray(value, np.bool_ if isinstance(value, bool) else dtype)
        for slot, value in program.numbers.items()
    }


def stacked(numbers: Sequence[Array], dtype: Any) -> Array:
    """Numbers as one array, which may be empty: the inverse of `elements`."""
    return jnp.stack(numbers) if numbers else jnp.zeros((0,), dtype)


def leaves(tree: Any) -> list[Array]:
    """All elements of all arrays of a pytree."""
    return [x for leaf in jax.tree.leaves(tree) for x in elements(jnp.asarray(leaf))]
