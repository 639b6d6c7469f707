"""Straight-line code as JAX operations on scalars."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxlag._core._arrays import elements
from jaxlag._core._xla import opaque_one
from jaxlag._lowering._emit import _interpreter
from jaxlag._lowering._emit._code import body_of, prelude_of
from jaxlag._lowering._emit._execute import leaves, numbers, run, stacked, straight
from jaxlag._lowering._emit._outlined import called
from jaxlag._lowering._graph._expression import FIXED, KNOWN
from jaxlag._lowering._graph._straight_line import Program
from jaxlag._tracing import _params

# Longer code is one function that XLA does not inline. Copied into every stage of a solver
# it would take many times as long to compile, and XLA's fusion would recompute shared lines.
INLINE_UP_TO = 60
# In a loop over one trajectory or a few lanes. On wider arrays XLA may split the work of a
# function among threads, which it cannot do inside a loop that is one native function.
INLINE_IN_LOOP = 14
# Fixed inputs that are 1 if they are not given.
_ONES = "active_rows", "nonzero", "time_direction"
# Longer code that runs a few times in a solve is interpreted: that compiles in the time of so many
# lines.
INTERPRET_FROM = 250
# The same for Jacobians in implicit methods. 10 columns of 2,431 lines take 0.2 s to compile and
# 0.18 ms to run, and compiled 9 s and 0.09 ms. A motion of 350 lines, interpreted | compiled: first
# result 1.7 | 5.2 s, run 11.5 | 9.0 ms. Single tangents take 7 times as long interpreted.
COLUMNS_FROM = 200


def prelude(
    program: Program,
    params: Any,
    dtype: Any,
    active_rows: Array | None = None,
    nonzero: Array | None = None,
    time_direction: Array | float = 1.0,
    known: Array | None = None,
    in_loop: bool = False,
) -> Float[Array, " k"]:
    """Values for the body that depend on `FIXED` inputs alone, as one array.

    Args:
        program: straight-line code.
        params: as the Lagrangian takes them.
        dtype: of the results.
        active_rows: for every constraint row whether it is used in solves; None for all.
        nonzero: for every row whether it is more than rounding; None for all.
        time_direction: -1 if time runs backwards.
        known: results of another program that this one continues; None without one.
        in_loop: whether this is in a loop over one trajectory or a few lanes.
    """
    values = {"active_rows": active_rows, "nonzero": nonzero, "time_direction": time_direction}
    values |= {} if known is None else {KNOWN: known}
    given = fixed_inputs(program, params, dtype, values)
    if len(program.prelude) > INTERPRET_FROM and _may_interpret(program):
        function = _interpreter.interpreted(prelude_of(program), dtype, alone=not in_loop)
        return jnp.append(function(*given.values()), opaque_one(dtype))
    slots = numbers(program, dtype)
    slots |= {program.inputs[key]: x for key, x in given.items()}
    run(program.prelude, slots, program.whole)
    row = [jnp.asarray(slots[slot], dtype) for slot in program.carried]
    return jnp.stack([*row, opaque_one(dtype)])


def fixed_inputs(
    program: Program, params: Any, dtype: Any, values: Mapping[str, Any]
) -> dict[tuple[str, int], Array]:
    """Values of the `FIXED` inputs, in the order of the program.

    Args:
        program: straight-line code.
        params: as the Lagrangian takes them.
        dtype: of the results.
        values: arrays of the others by name; None for 1.
    """
    one = jnp.ones((), dtype)
    known: dict[str, Any] = dict.fromkeys(_ONES)
    known |= {name: leaves(x) for name, x in values.items() if x is not None}
    keys = [key for key in program.inputs if key[0] in FIXED]
    if any(name == "params" for name, _ in keys):
        known["params"] = leaves(_params.split(params)[0])
    return {
        (name, index): one if known[name] is None else jnp.asarray(known[name][index], dtype)
        for name, index in keys
    }


def body(
    program: Program,
    carried: Float[Array, " k"],
    t: Array,
    q: Float[Array, " n"],
    v: Float[Array, " w"],
    inputs: Mapping[str, Any],
    lanes: bool = False,
    in_loop: bool = False,
    seldom: bool = False,
    jacobians: bool = False,
) -> Float[Array, " r"]:
    """The results at one state.

    Args:
        program: straight-line code.
        carried: the result of `prelude`.
        t: time.
        q: coordinates.
        v: velocities.
        inputs: values of the inputs by name.
        lanes: whether this is vmapped: every scalar is an array of numbers.
        in_loop: whether this is in a loop over one trajectory or a few lanes.
        seldom: whether this runs a few times in a solve.
        jacobians: whether its derivatives are Jacobians, several tangents at one state.
    """
    names = {name for name, _ in program.inputs}
    flat = leaves(dict(inputs)) if "inputs" in names else []
    values = {"t": [t], "q": elements(q), "v": elements(v), "inputs": flat}
    return _evaluated(program, carried, values, q.dtype, lanes, in_loop, seldom, jacobians)


def solved(
    program: Program,
    known: Float[Array, " k"],
    right: Float[Array, "s m"],
    in_loop: bool = False,
) -> Float[Array, "s r"]:
    """The results of code that continues another program, for several right-hand sides.

    In a loop one after another: vmapped, LLVM took more than 22 GB of memory for 7 sides in
    float32, and 24 sides of 215 lines did not run faster. Else all at once: XLA may split code
    among threads, which it cannot do in a loop of its own.

    Args:
        program: straight-line code of (`KNOWN`, i) and ("c", k).
        known: results of the other program.
        right: right-hand sides.
        in_loop: whether this is in a loop over one trajectory or a few lanes.
    """
    carried = prelude(program, {}, known.dtype, known=known, in_loop=in_loop)

    def of(c: Array) -> Array:
        return _evaluated(program, carried, {"c": elements(c)}, known.dtype, not in_loop, in_loop)

    return lax.map(of, right) if in_loop else jax.vmap(of)(right)


def _evaluated(
    program: Program,
    carried: Array,
    values: Mapping[str, Sequence[Array]],
    dtype: Any,
    lanes: bool,
    in_loop: bool,
    seldom: bool = False,
    jacobians: bool = False,
) -> Array:
    """The results from the carried numbers and the inputs that vary, by name."""
    read = [key for key in program.inputs if key[0] not in FIXED]
    given = [values[name][index] for name, index in read]
    kinds = {jnp.result_type(x) for x in given} | {jnp.dtype(dtype)}
    kind = program, jnp.dtype(dtype), lanes
    short = len(program.body) <= (INLINE_IN_LOOP if in_loop else INLINE_UP_TO)
    if short or len(kinds) > 1 or jax.default_backend() != "cpu":
        return jnp.stack(_function(*kind)(carried, given))
    # One flat array in and one out.
    if seldom and len(program.body) > INTERPRET_FROM and _may_interpret(program):
        function = _interpreter.interpreted(body_of(program), dtype, alone=not in_loop)
        return function(*elements(carried[:-1]), *given)
    columns = jacobians and len(program.body) > COLUMNS_FROM and _may_interpret(program)
    return called(*kind, columns)(carried, stacked(given, dtype))


def _may_interpret(program: Program) -> bool:
    return _interpreter.available() and not program.has_rules


@lru_cache(maxsize=256)
def _function(program: Program, dtype: Any, lanes: bool) -> Any:
    """The body as a function that is traced once for all stages."""

    def results(carried: Array, given: Sequence[Array]) -> tuple[Array, ...]:
        return straight(program, dtype, elements(carried), given, lanes)

    return jax.jit(results)
