"""A function of numbers for many lanes at once, as one loop of vector instructions.

XLA's elementwise operations on rows become many loops: what several results read is computed again
for each or stored for all lanes in between. A `lax.reduce_window` whose windows have one entry
calls its combiner once for each entry. It is one loop with a straight body of numbers, and LLVM
vectorizes that loop over its entries.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxlag._integration._vector_loop._flat_program import FlatProgram, Value

MULTIPLE = 16
"""LLVM vectorizes over whole groups of lanes, and computes a rest one by one."""
WIDTH = 2 * MULTIPLE
"""Lanes in a loop; 16 and 64 take up to 1.1 times as long per turn."""


def on_rows(program: FlatProgram, wanted: Sequence[Value], rows: dict[int, Array]) -> list[Array]:
    """Values of a program on numbers, for every lane.

    Args:
        program: on numbers.
        wanted: some of its values.
        rows: (lanes,) each, the values that it starts from.
    """
    operations = program.needed(wanted)
    read = sorted(program.read_by(operations, wanted))

    def numbers(*entries: Any) -> list[Any]:
        known = dict(zip(read, entries, strict=True))
        return [jnp.asarray(x) for x in program.evaluate(operations, known, wanted)]

    kinds = [program.aval(x).dtype for x in wanted]
    return lane_map(numbers, [rows[x] for x in read], kinds)


def rows_of(array: Array) -> list[Array]:
    """The elements of (lanes, ...), (lanes,) each."""
    flat = array.reshape(array.shape[0], -1)
    return [flat[:, k] for k in range(flat.shape[1])]


def array_of(rows: Sequence[Array], like: Any) -> Array:
    """The inverse of `rows_of`, for arrays like this one."""
    return jnp.stack(rows, 1).reshape(like.shape) if rows else jnp.zeros(like.shape, like.dtype)


def lane_map(
    function: Callable[..., Sequence[Any]], rows: Sequence[Array], kinds: Sequence[Any]
) -> list[Array]:
    """The results of a function of numbers, for every lane.

    Args:
        function: of one number for each row; without other traced values.
        rows: (lanes,) each.
        kinds: dtypes of the results.
    """
    free = list(range(len(rows)))
    operands, place = [], {}
    for kind in kinds:  # a window has the dtypes of its results
        match = next((i for i in free if rows[i].dtype == kind), None)
        if match is None:
            operands.append(jnp.zeros(rows[0].shape, kind))
        else:
            free.remove(match)
            place[match] = len(operands)
            operands.append(rows[match])
    for i in free:
        place[i] = len(operands)
        operands.append(rows[i])

    def combine(_: Any, entries: Sequence[Any]) -> tuple:
        found = function(*(entries[place[i]] for i in range(len(rows))))
        return (*found, *entries[len(kinds) :])

    zeros = tuple(np.zeros((), x.dtype) for x in operands)
    alone = (1,), (1,), "VALID", None, None
    return list(lax.reduce_window(tuple(operands), zeros, combine, *alone))[: len(kinds)]
