"""Interpreter of straight-line code: one loop over its lines, of one size for all programs.

XLA compiles a line of straight-line code in about 0.4 ms, once for each place of use. The
interpreter compiles in about a tenth of a second, however long the code is, and takes about 10 ns a
line instead of 1 ns. It is for code that runs a few times in a solve.

Derivatives are straight-line code, too, which is interpreted in the same way.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxlag._core import _xla
from jaxlag._core._arrays import elements
from jaxlag._core._batching import Chunks, in_lanes
from jaxlag._core._custom_jvp import CustomJVP
from jaxlag._core._linear_map import LinearMap, linear
from jaxlag._linalg._rounding_bounds import RUNS, STRENGTH, random_signs
from jaxlag._lowering._emit._code import Code, adjoint, tangent
from jaxlag._lowering._emit._execute import executed, is_trig, run, stacked
from jaxlag._lowering._emit._sincos import sincos
from jaxlag._lowering._graph._straight_line import Line
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported

_CHOICES = "select", "stop", "max", "min", "largest", "smallest"
_EXACT = frozenset(["neg", "abs", "sign", "floor", "ceil", "round", *_CHOICES])


class Bytecode(NamedTuple):
    """Straight-line code as a table. A place holds one number after another.

    Attributes:
        lines: for every line its function, the places of its operands and that of its result.
        functions: of as many numbers as the longest line has operands.
        exact: for every function whether its results are not rounded.
        truths: for every function whether its results are truth values.
        start: numbers in the places at the start; 0 for the given ones, which are the first.
        results: places of the results.
    """

    lines: np.ndarray
    functions: tuple[Callable, ...]
    exact: tuple[bool, ...]
    truths: tuple[bool, ...]
    start: np.ndarray
    results: np.ndarray

    @property
    def operands(self) -> int:
        """Number of operands that every function takes."""
        return self.lines.shape[1] - 2


def available() -> bool:
    """Whether XLA compiles the loop to one native function; otherwise lines take microseconds."""
    jitted = not jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]
    if jax.default_backend() != "cpu" or not jitted:
        return False
    return _xla.in_force() or _xla.by_attribute()


@lru_cache(maxsize=256)
def bytecode(code: Code) -> Bytecode:
    """The table of a code, in which places are used again for later results."""
    last = {slot: at for at, line in enumerate(code.lines) for slot in line.args}
    last |= dict.fromkeys(code.results, len(code.lines))
    numbers = [slot for slot in last if slot in code.numbers]
    place = {slot: at for at, slot in enumerate([*code.given, *numbers])}
    count, free = len(code.given) + len(numbers), []
    kinds: dict[Any, int] = {}
    functions: list[Callable] = []
    exact: list[bool] = []
    width = max((len(line.args) for line in code.lines), default=1)
    table = np.zeros((len(code.lines), width + 2), np.int32)
    for at, line in enumerate(code.lines):
        truths = tuple(slot in code.truths for slot in line.args)
        kind = line.op, line.data, truths, line.to in code.truths
        if kind not in kinds:
            kinds[kind] = len(functions)
            functions.append(_function(line, truths))
            name = line.data.name if line.op == "call" else line.op
            exact.append(name in _EXACT or line.to in code.truths)
        table[at, 0] = kinds[kind]
        table[at, 1 : 1 + len(line.args)] = [place[slot] for slot in line.args]
        free += [place[slot] for slot in dict.fromkeys(line.args) if last[slot] == at]
        if free:
            place[line.to] = free.pop()
        else:
            place[line.to], count = count, count + 1
        table[at, -1] = place[line.to]
    start = np.zeros(count)
    for slot in numbers:
        start[place[slot]] = float(code.numbers[slot])
    return Bytecode(
        table,
        tuple(functions),
        tuple(exact),
        tuple(truth for *_, truth in kinds),
        start,
        np.array([place[slot] for slot in code.results], np.int32),
    )


def _function(line: Line, truths: Sequence[bool]) -> Callable:
    """One line as a function of numbers; truth values are 1 and 0."""

    def function(*operands: Array) -> Array:
        given = [x != 0 if truth else x for x, truth in zip(operands, truths, strict=False)]
        if is_trig(line):
            found = sincos(given[0])[line.data.name == "cos"]
        else:
            found = executed(line, given)
        return jnp.asarray(found, operands[0].dtype)

    return function


def _loop(
    code: Bytecode, functions: Sequence[Callable], slots: Array, factors: Array | None = None
) -> Array:
    """All numbers after the last line, from those at the start, (places, ...).

    Args:
        code: the table.
        functions: what to execute for each of its functions.
        slots: numbers at the start.
        factors: for every line, a factor for its result; None for 1.
    """
    if not len(code.lines):
        return slots
    lines = jnp.asarray(code.lines)

    def body_fun(at: Array, slots: Array) -> Array:
        line = _entry(lines, at)
        operands = [_entry(slots, line[1 + k]) for k in range(code.operands)]
        result = lax.switch(line[0], functions, *operands)
        if factors is not None:
            result = result * _entry(factors, at)
        return lax.dynamic_update_index_in_dim(slots, result, line[-1], 0)

    return lax.fori_loop(0, len(code.lines), body_fun, slots)


def _entry(array: Array, at: Array) -> Array:
    return lax.dynamic_index_in_dim(array, at, 0, keepdims=False)


def _start(code: Bytecode, row: Array, dtype: Any) -> Array:
    """The numbers at the start; a scatter in a loop would keep XLA from making it one function."""
    return jnp.concatenate([row, jnp.asarray(code.start[row.size :], dtype)])


def _row(parts: Sequence[Array], dtype: Any) -> Array:
    """Numbers, or rows of them, as one row."""
    if all(x.ndim == 0 for x in parts):
        return stacked(parts, dtype)
    return jnp.concatenate([jnp.reshape(x, (-1,)) for x in parts])


def _split(row: Array, like: Sequence[Array]) -> tuple[Array, ...]:
    """The inverse of `_row`."""
    ends = np.cumsum([x.size for x in like])[:-1].tolist()
    pairs = zip(jnp.split(row, ends), like, strict=True)
    return tuple(jnp.reshape(part, x.shape) for part, x in pairs)


@lru_cache(maxsize=512)
def interpreted(code: Code, dtype: Any, alone: bool) -> Callable[..., Float[Array, " r"]]:
    """The results as a function of the given numbers, differentiable in every mode and order.

    The function takes numbers, or rows of consecutive ones.

    Args:
        code: straight-line code.
        dtype: of all numbers.
        alone: whether it is outside of all loops of a solve.
    """
    table = bytecode(code)
    around = _xla.native if alone else _inside

    def single(*given: Array) -> Array:
        start = _start(table, _row(given, dtype), dtype)
        return around(partial(_loop, table, table.functions), start)[table.results]

    @CustomJVP
    def call(*given: Array) -> Array:
        return in_lanes(single, lambda _: Chunks(single), *given)

    @partial(call.defjvp, symbolic_zeros=True)
    def _(given: tuple[Array, ...], dots: tuple[Array | None, ...]) -> tuple[Array, Array]:
        parts = tuple((x.size, dot is not None) for x, dot in zip(given, dots, strict=True))
        form = derivative(code, dtype, alone, parts) or _by_jax(code, dtype, parts)
        return call(*given), linear(form, given, tuple(dot for dot in dots if dot is not None))

    return call


def _inside(function: Callable, *args: Array) -> Array:
    return function(*args)


@lru_cache(maxsize=512)
def derivative(
    code: Code, dtype: Any, alone: bool, parts: tuple[tuple[int, bool], ...]
) -> LinearMap | None:
    """The derivative of the results along the parts that move, as a linear map.

    None if the derivative of a function has no code.

    Args:
        code: straight-line code.
        dtype: of all numbers.
        alone: whether it is outside of all loops of a solve.
        parts: the size of every part, and whether it moves.
    """
    moving = tuple(moves for size, moves in parts for _ in range(size))
    try:
        forwards = tangent(code, moving)
    except Unsupported:
        return None

    def forward(given: tuple, dots: tuple) -> Array:
        return interpreted(forwards, dtype, alone)(*given, *dots)

    def backward(given: tuple, bar: Array) -> tuple:
        moved = [x for x, (_, moves) in zip(given, parts, strict=True) if moves]
        backwards = interpreted(adjoint(code, moving), dtype, alone)
        return _split(backwards(*given, bar), moved)

    return LinearMap(forward, backward, forward, backward, at_once=None)


@lru_cache(maxsize=512)
def _by_jax(code: Code, dtype: Any, parts: tuple[tuple[int, bool], ...]) -> LinearMap:
    """The same by JAX, for functions whose derivatives have no code."""
    moving = [moves for _, moves in parts]

    def along(given: tuple) -> tuple[Callable, list]:
        def results(*moved: Array) -> Array:
            rest = iter(moved)
            numbers = [next(rest) if m else x for x, m in zip(given, moving, strict=True)]
            slots: dict[int, Any] = {
                slot: np.asarray(x, np.bool_ if isinstance(x, bool) else dtype)
                for slot, x in code.numbers.items()
            }
            slots |= dict(zip(code.given, elements(_row(numbers, dtype)), strict=True))
            run(code.lines, slots)
            return jnp.stack([jnp.asarray(slots[slot], dtype) for slot in code.results])

        return results, [x for x, m in zip(given, moving, strict=True) if m]

    def forward(given: tuple, dots: tuple) -> Array:
        results, start = along(given)
        return jax.jvp(results, start, list(dots))[1]

    def backward(given: tuple, bar: Array) -> tuple:
        results, start = along(given)
        return jax.vjp(results, *start)[1](bar)

    return LinearMap(forward, backward, forward, at_once=None)


def with_changes(
    code: Code, changed: np.ndarray, given: Sequence[Array], dtype: Any
) -> tuple[Float[Array, " r"], Float[Array, " r"]]:
    """(results, their changes by one rounding of every line and of some given numbers).

    The first of several runs is exact. All runs decide as it does.

    Args:
        code: straight-line code.
        changed: for every given number, whether it is rounded.
        given: the numbers.
        dtype: of all numbers.
    """
    table = bytecode(code)
    eps = float(jnp.finfo(dtype).eps)

    def factors(rounded: np.ndarray) -> Array:
        signs = random_signs(draw, len(rounded), RUNS) * rounded[:, None]
        signs = np.concatenate([np.zeros((len(rounded), 1)), signs], axis=1)
        return jnp.asarray(1.0 + STRENGTH * eps * signs, dtype)

    def decided(function: Callable, *operands: Array) -> Array:
        found = function(*operands)
        return jnp.broadcast_to(found[:1], found.shape)

    draw = np.random.default_rng(7)
    functions = [
        partial(decided, function) if truth else function
        for function, truth in zip(table.functions, table.truths, strict=True)
    ]
    rounded = np.logical_not(table.exact)[table.lines[:, 0]]

    def single(*given: Array) -> tuple[Array, Array]:
        start = _start(table, _row(given, dtype), dtype)
        start = start[:, None] * factors(np.pad(changed, (0, start.size - changed.size)))
        found = _xla.native(partial(_loop, table, functions), start, factors(rounded))
        found = found[table.results]
        bounds = jnp.max(jnp.abs(found[:, 1:] - found[:, :1]), axis=1) / STRENGTH
        return found[:, 0], bounds

    return in_lanes(single, lambda _: Chunks(single), *given)
