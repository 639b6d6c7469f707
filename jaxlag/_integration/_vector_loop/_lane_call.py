"""A function of small arrays that `jax.vmap` runs as one vectorized loop over lanes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching
from jaxtyping import Array, PyTree

from jaxlag._integration._vector_loop._divisions import with_fewer_divisions
from jaxlag._integration._vector_loop._flat_program import FlatProgram, flat
from jaxlag._integration._vector_loop._lane_map import array_of, on_rows, rows_of
from jaxlag._integration._vector_loop._on_numbers import is_supported, on_numbers
from jaxlag._integration._vector_loop._turn import NotVectorizable


@dataclass(frozen=True, eq=False)
class _Form:
    """A function as a program on numbers, and the shapes of its results."""

    numbers: FlatProgram = field(repr=False)
    shapes: list[ShapedArray]


_call_p = Primitive("lane_call")
_call_p.multiple_results = True


def lane_call(function: Callable, *args: PyTree) -> PyTree:
    """function(*args), under `jax.vmap` only; without derivatives.

    Args:
        function: of pytrees of small arrays, which it may also read from its closure.
        args: those arrays.

    Raises:
        NotVectorizable: the function has no form on numbers.
    """
    leaves, tree = jax.tree.flatten(args)
    structure: Any = None

    def of_leaves(*leaves: Any) -> list[Any]:
        nonlocal structure
        found, structure = jax.tree.flatten(function(*jax.tree.unflatten(tree, leaves)))
        return found

    program, consts = flat(of_leaves, *leaves)
    needed = program.needed(program.outputs)
    others = sorted({x.name for x in needed if not is_supported(program, x)})
    if others:
        raise NotVectorizable(", ".join(others))
    read = program.read_by(needed, program.outputs)  # without whole tables of the closure
    pairs = zip((*program.consts, *program.inputs), (*consts, *leaves), strict=True)
    sources = {x: array for x, array in pairs if x in read}
    numbers = on_numbers(program, list(sources), program.outputs)
    kinds = map(program.aval, program.outputs)
    shapes = [ShapedArray(x.shape, x.dtype) for x in kinds]
    form = _Form(with_fewer_divisions(numbers), shapes)
    found = _call_p.bind(*sources.values(), form=form)
    return jax.tree.unflatten(structure, found)


@_call_p.def_abstract_eval
def _(*_: Any, form: _Form) -> list[Any]:
    return form.shapes


def _batched(args: Sequence[Any], axes: Sequence[Any], *, form: _Form) -> tuple:
    count = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)

    def lanes(x: Any, axis: int | None) -> Array:
        x = jnp.asarray(x)
        return jnp.broadcast_to(x, (count, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)

    arrays = map(lanes, args, axes)
    rows = [row for array in arrays for row in rows_of(array)]
    known = dict(zip(form.numbers.inputs, rows, strict=True))
    found = iter(on_rows(form.numbers, form.numbers.outputs, known))
    results = [
        array_of(list(islice(found, x.size)), jax.ShapeDtypeStruct((count, *x.shape), x.dtype))
        for x in form.shapes
    ]
    return results, [0] * len(results)


batching.primitive_batchers[_call_p] = _batched
