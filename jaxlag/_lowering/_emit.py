"""Straight-line code as JAX operations on scalars."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Float

from jaxlag import _params
from jaxlag._lowering._ingest import Rule
from jaxlag._lowering._program import Line, Program

# Code of more lines is one function that XLA does not inline: copied into every stage of a solver
# it compiles in many times the time, and XLA's fusion computes shared lines anew in each use.
INLINE_UP_TO = 60

_BINARY = {"add": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div}


def prelude(program: Program, params: Any, dtype: Any) -> Float[Array, " k"]:
    """What the body needs of what depends on params alone, in one row.

    Args:
        program: straight-line code.
        params: as the Lagrangian takes them.
        dtype: of the results.
    """
    wanted = {index: slot for (name, index), slot in program.inputs.items() if name == "params"}
    slots = _numbers(program, dtype)
    if wanted:
        flat = leaves(_params.split(params)[0])
        slots |= {slot: flat[index] for index, slot in wanted.items()}
    _run(program.prelude, slots)
    row = [jnp.asarray(slots[slot], dtype) for slot in program.carried]
    return jnp.stack(row) if row else jnp.zeros((0,), dtype)


def body(
    program: Program,
    carried: Float[Array, " k"],
    t: Array,
    q: Sequence[Array],
    v: Sequence[Array],
    inputs: Mapping[str, Any],
    dtype: Any,
) -> tuple[Array, ...]:
    """The results at one state, given element by element.

    Args:
        program: straight-line code.
        carried: what `prelude` returned.
        t: time.
        q: coordinates.
        v: velocities.
        inputs: values of the inputs by name.
        dtype: of the results.
    """
    names = {name for name, _ in program.inputs}
    flat = leaves(dict(inputs)) if "inputs" in names else []
    values = {"t": [t], "q": q, "v": v, "inputs": flat}
    read = [key for key in program.inputs if key[0] != "params"]
    given = [values[name][index] for name, index in read]
    kinds = {jnp.result_type(x) for x in given} | {jnp.dtype(dtype)}
    if len(program.body) <= INLINE_UP_TO or len(kinds) > 1:
        return _body(program, dtype, elements(carried), given)
    # One flat array in and one out.
    with set_xla_metadata(inlineable="false"):
        row = _called(program, jnp.dtype(dtype))(carried, jnp.stack(given))
    return tuple(elements(row))


@lru_cache(maxsize=256)
def _called(program: Program, dtype: Any) -> Any:
    def results(carried: Array, given: Array) -> Array:
        return jnp.stack(_body(program, dtype, elements(carried), elements(given)))

    return jax.jit(results)


def _body(
    program: Program, dtype: Any, carried: Sequence[Array], given: Sequence[Array]
) -> tuple[Array, ...]:
    slots = _numbers(program, dtype)
    for slot, x in zip(program.carried, carried, strict=True):
        slots[slot] = x != 0 if slot in program.truths else x
    read = [slot for (name, _), slot in program.inputs.items() if name != "params"]
    slots |= dict(zip(read, given, strict=True))
    _run(program.body, slots)
    return tuple(jnp.asarray(slots[slot], dtype) for slot in program.results)


def _run(lines: Sequence[Line], slots: dict[int, Any]) -> None:
    ruled: dict[Any, Array] = {}
    for line in lines:
        args = [slots[a] for a in line.args]
        if line.op == "custom":
            rule, index = line.data
            if (rule, line.args) not in ruled:
                ruled[rule, line.args] = _by_rule(rule, args)
            slots[line.to] = ruled[rule, line.args][index]
        else:
            slots[line.to] = _line(line, args)


def _line(line: Line, args: list[Any]) -> Any:
    op = line.op
    if op in _BINARY:
        return _BINARY[op](*args)
    if op == "neg":
        return lax.neg(args[0])
    if op == "select":
        return lax.select(*args)
    if op == "stop":
        return lax.stop_gradient(args[0])
    return line.data(*args)


def _by_rule(rule: Rule, args: Sequence[Array]) -> Array:
    """All results of a function with a derivative rule of its own, in one row."""
    operands, start = [], 0
    for aval in rule.avals:
        part = [jnp.asarray(x, aval.dtype) for x in args[start : start + aval.size]]
        start += aval.size
        operands.append(jnp.stack(part).reshape(aval.shape) if part else jnp.zeros(aval.shape))
    return jnp.concatenate([jnp.ravel(x) for x in rule.call(*operands)])


def _numbers(program: Program, dtype: Any) -> dict[int, Any]:
    return {
        slot: np.asarray(value, np.bool_ if isinstance(value, bool) else dtype)
        for slot, value in program.numbers.items()
    }


def elements(array: Array) -> list[Array]:
    """All elements of an array in one row, by static slices."""
    flat = jnp.reshape(array, (-1,))
    return [lax.squeeze(lax.slice_in_dim(flat, i, i + 1), (0,)) for i in range(flat.shape[0])]


def leaves(tree: Any) -> list[Array]:
    """All elements of all arrays of a pytree."""
    return [x for leaf in jax.tree.leaves(tree) for x in elements(jnp.asarray(leaf))]
