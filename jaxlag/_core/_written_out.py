"""Programs on small arrays without sums, products, factorizations and scatters.

XLA has no code for scatters and calls of libraries within a native function. Sums and products of
arrays it emits as loops, with memory of their own. Here sums and products are chains of operations
on parts of the arrays, factorizations and solves are loops over columns, and a scatter is a choice
for every entry.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array

from jaxlag._core._jaxprs import rewritten, within

TERMS = 64
"""Largest number of terms of a sum, or of written entries."""
FACTORS = 12
"""Largest number of terms of a product of arrays. From 16 on libraries are faster."""
ENTRIES = 1024
"""Largest size of the factors of a product."""
COLUMNS = 16
"""Largest number of rows and columns of a matrix that is factored."""


def written_out(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program in this form, to be evaluated only: it has no derivatives."""
    known: dict[Any, Any] = {}

    def replaced(eqn: Any) -> Any:
        if not has_form(eqn):
            return eqn
        rule = _RULES[eqn.primitive.name]
        kinds = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in eqn.invars]
        key = None
        if not any(within(eqn)):  # texts of programs may be equal where they are not
            key = eqn.primitive.name, repr(eqn.params), *((x.shape, x.dtype) for x in kinds)
        call = known.get(key)
        if call is None:
            code = jax.make_jaxpr(jax.jit(lambda *args: rule.function(eqn.params, *args)))(*kinds)
            (call,) = code.jaxpr.eqns
            if key is not None:
                known[key] = call
        return eqn.replace(primitive=call.primitive, params=call.params)

    return rewritten(program, replaced)


def has_form(eqn: Any) -> bool:
    """Whether an operation is written out."""
    rule = _RULES.get(eqn.primitive.name)
    return rule is not None and rule.suits(eqn)


class _Rule(NamedTuple):
    """The form of an operation.

    Attributes:
        function: (parameters, *operands) -> results.
        suits: whether an equation has this form.
    """

    function: Callable
    suits: Callable[[Any], bool]


def _parts(x: Array, axis: int = 0) -> list[Array]:
    return [lax.index_in_dim(x, k, axis, keepdims=False) for k in range(x.shape[axis])]


def _total(x: Array) -> Array:
    """The sum over the first axis."""
    return reduce(lax.add, _parts(x))


# ---- Sums and products ---------------------------------------------------------------------------


def _reduced(combine: Callable) -> Callable:
    def function(params: Any, x: Array) -> Array:
        for axis in sorted(map(int, params["axes"]), reverse=True):
            x = reduce(combine, _parts(x, axis))
        return x

    return function


def _index_of(is_better: Callable) -> Callable:
    """Of the first best entry; NaN is better than numbers, as in JAX."""

    def function(params: Any, x: Array) -> Array:
        (axis,), kind = params["axes"], params["index_dtype"]
        best, *others = _parts(x.astype(jnp.int32) if x.dtype == bool else x, int(axis))
        index = jnp.zeros(best.shape, kind)
        for k, other in enumerate(others, 1):
            better = is_better(other, best) | ((other != other) & (best == best))
            best = jnp.where(better, other, best)
            index = jnp.where(better, jnp.asarray(k, kind), index)
        return index

    return function


def _product(params: Any, a: Array, b: Array) -> Array:
    (left, right), (left_batch, right_batch) = params["dimension_numbers"]
    rows = [i for i in range(a.ndim) if i not in (*left, *left_batch)]
    columns = [i for i in range(b.ndim) if i not in (*right, *right_batch)]
    batch = [a.shape[i] for i in left_batch]
    free = [a.shape[i] for i in rows], [b.shape[i] for i in columns]
    count = int(np.prod([a.shape[i] for i in left]))
    wide = [*batch, *free[0], *[1] * len(columns)], [*batch, *[1] * len(rows), *free[1]]
    a = a.transpose([*left, *left_batch, *rows]).reshape(count, *wide[0])
    b = b.transpose([*right, *right_batch, *columns]).reshape(count, *wide[1])
    return reduce(lax.add, [x * y for x, y in zip(_parts(a), _parts(b), strict=True)])


# ---- Matrices ------------------------------------------------------------------------------------


def _of_each(function: Callable) -> Callable:
    """The function of matrices, for arrays of them."""

    def of_all(params: Any, *arrays: Array) -> Any:
        of = partial(function, params)
        for _ in range(arrays[0].ndim - 2):
            of = jax.vmap(of)
        return of(*arrays)

    return of_all


def _qr(params: Any, a: Array) -> list[Array]:
    """Q and R by Householder's reflections I - tau v v^T.

    Source: Golub, Van Loan, Matrix Computations, 5.1 and 5.2.
    """
    count = min(a.shape)
    width = a.shape[0] if params["full_matrices"] else count
    order = jnp.arange(a.shape[0])
    zero, one = jnp.zeros((), a.dtype), jnp.ones((), a.dtype)

    def eliminated(k: Array, state: tuple) -> tuple:
        a, directions, factors = state
        x = jnp.where(order >= k, lax.dynamic_index_in_dim(a, k, 1, keepdims=False), zero)
        largest = reduce(lax.max, _parts(jnp.abs(x)))
        unit = jnp.where(largest > 0, largest, one)
        first = lax.dynamic_index_in_dim(x, k, 0, keepdims=False)
        below = _total(jnp.where(order > k, (x / unit) ** 2, zero))
        length = unit * jnp.sqrt((first / unit) ** 2 + below)
        moves = below != 0  # true for NaN
        pivot = jnp.where(first >= 0, -length, length)
        v = jnp.where(moves & (order > k), x / jnp.where(moves, first - pivot, one), zero)
        v = jnp.where(order == k, one, v)
        factor = jnp.where(moves, (pivot - first) / jnp.where(moves, pivot, one), zero)
        a = a - factor * v[:, None] * _total(v[:, None] * a)[None]
        return a, _set(directions, v, k), _set(factors, factor, k)

    def reflected(i: Array, q: Array) -> Array:
        k = count - 1 - i
        v = lax.dynamic_index_in_dim(directions, k, 0, keepdims=False)
        factor = lax.dynamic_index_in_dim(factors, k, 0, keepdims=False)
        return q - factor * v[:, None] * _total(v[:, None] * q)[None]

    init = a, jnp.zeros((count, a.shape[0]), a.dtype), jnp.zeros((count,), a.dtype)
    a, directions, factors = lax.fori_loop(0, count, eliminated, init)
    q = lax.fori_loop(0, count, reflected, jnp.eye(a.shape[0], width, dtype=a.dtype))
    return [q, jnp.triu(a[:width])]


def _triangular(params: Any, a: Array, b: Array) -> Array:
    """x with a x = b, or x a = b, or the same with a^T, by substitution."""
    lower, transposed = params["lower"], params["transpose_a"]
    if not params["left_side"]:
        b, transposed = b.T, not transposed
    if transposed:
        a, lower = a.T, not lower
    order = jnp.arange(a.shape[0])

    def solved(i: Array, x: Array) -> Array:
        k = i if lower else a.shape[0] - 1 - i
        row = lax.dynamic_index_in_dim(a, k, 0, keepdims=False)
        known = (order < k) if lower else (order > k)
        y = lax.dynamic_index_in_dim(b, k, 0, keepdims=False)
        y = y - _total(jnp.where(known, row, jnp.zeros((), a.dtype))[:, None] * x)
        if not params["unit_diagonal"]:
            y = y / lax.dynamic_index_in_dim(row, k, 0, keepdims=False)
        return _set(x, y, k)

    x = lax.fori_loop(0, a.shape[0], solved, jnp.zeros(b.shape, b.dtype))
    return x if params["left_side"] else x.T


def _set(array: Array, entry: Array, k: Array) -> Array:
    """The array with an entry along its first axis; its batching rule is no scatter."""
    places = lax.broadcasted_iota(jnp.int32, array.shape, 0)
    return jnp.where(places == k, jnp.broadcast_to(entry[None], array.shape), array)


def _solved(params: Any, *args: Any) -> Sequence[Array]:
    """The solution that a linear solve with an implicit derivative computes."""
    sizes, code = params["const_lengths"], params["jaxprs"].solve
    start = sizes.matvec + sizes.vecmat
    end = start + sizes.solve
    right = args[end + sizes.transpose_solve :]
    return jaxpr_as_fun(code)(*args[start:end], *right)


# ---- Scatters ------------------------------------------------------------------------------------


def _scattered(combine: Callable) -> Callable:
    """Entries along one axis; those outside of the array are dropped."""

    def function(params: Any, array: Array, indices: Array, entries: Array) -> Array:
        numbers = params["dimension_numbers"]
        axis = int(numbers.scatter_dims_to_operand_dims[0])
        indices = indices.reshape(-1)
        if indices.dtype.itemsize < 4:
            indices = indices.astype(jnp.int32)
        if params["mode"] == lax.GatherScatterMode.CLIP:
            indices = jnp.clip(indices, 0, array.shape[axis] - 1)
        inside = numbers.update_window_dims
        outside = [i for i in range(entries.ndim) if i not in inside]
        rest = [n for i, n in enumerate(array.shape) if i != axis]
        entries = entries.transpose([*outside, *inside]).reshape(-1, *rest)
        places = lax.broadcasted_iota(indices.dtype, array.shape, axis)
        for index, entry in zip(_parts(indices), _parts(entries), strict=True):
            new = jnp.broadcast_to(jnp.expand_dims(entry, axis), array.shape)
            array = jnp.where(places == index, combine(array, new), array)
        return array

    return function


# ---- Which operations ----------------------------------------------------------------------------


def _is_few(eqn: Any) -> bool:
    x = eqn.invars[0].aval
    few = 0 < int(np.prod([x.shape[i] for i in eqn.params["axes"]])) <= TERMS
    return few and not _is_half(x.dtype)


def _are_small(eqn: Any) -> bool:
    a, b = (x.aval for x in eqn.invars)
    (left, _), _ = eqn.params["dimension_numbers"]
    few = 0 < int(np.prod([a.shape[i] for i in left])) <= FACTORS
    kinds = {a.dtype, b.dtype, eqn.outvars[0].aval.dtype}
    numbers = len(kinds) == 1 and jnp.issubdtype(a.dtype, jnp.number) and not _is_half(a.dtype)
    return bool(few and numbers and max(a.size, b.size) <= ENTRIES)


def _is_half(dtype: Any) -> bool:
    """Whether XLA adds up such numbers in a wider type."""
    return jnp.issubdtype(dtype, jnp.floating) and dtype.itemsize < 4


def _is_matrix(eqn: Any) -> bool:
    *_, right = (x.aval for x in eqn.invars)
    a = eqn.invars[0].aval
    real = jnp.issubdtype(a.dtype, jnp.floating)
    small = max(a.shape) <= COLUMNS and a.size and right.size
    return bool(real and small and not eqn.params.get("pivoting"))


def _is_set(eqn: Any) -> bool:
    """Whether entries are set; `array.at[].apply` is the same operation with a program."""
    return eqn.params["update_jaxpr"] is None and _is_along_one_axis(eqn)


def _is_along_one_axis(eqn: Any) -> bool:
    numbers, indices = eqn.params["dimension_numbers"], eqn.invars[1].aval
    axes = tuple(map(int, numbers.scatter_dims_to_operand_dims))
    one = len(axes) == 1 and axes == tuple(map(int, numbers.inserted_window_dims))
    if not one or numbers.operand_batching_dims or not 0 < indices.size <= TERMS:
        return False
    array, _, entries = (x.aval for x in eqn.invars)
    whole = [n for i, n in enumerate(array.shape) if i not in axes]
    return [entries.shape[i] for i in numbers.update_window_dims] == whole


_RULES = {
    "reduce_sum": _Rule(_reduced(lax.add), _is_few),
    "reduce_prod": _Rule(_reduced(lax.mul), _is_few),
    "reduce_max": _Rule(_reduced(lax.max), _is_few),
    "reduce_min": _Rule(_reduced(lax.min), _is_few),
    "reduce_and": _Rule(_reduced(lax.bitwise_and), _is_few),
    "reduce_or": _Rule(_reduced(lax.bitwise_or), _is_few),
    "argmax": _Rule(_index_of(lax.gt), _is_few),
    "argmin": _Rule(_index_of(lax.lt), _is_few),
    "dot_general": _Rule(_product, _are_small),
    "qr": _Rule(_of_each(_qr), _is_matrix),
    "triangular_solve": _Rule(_of_each(_triangular), _is_matrix),
    "custom_linear_solve": _Rule(_solved, lambda eqn: True),
    "scatter": _Rule(_scattered(lambda old, new: new), _is_set),
    "scatter-add": _Rule(_scattered(lax.add), _is_along_one_axis),
}
