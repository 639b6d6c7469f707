"""Rows of a buffer written where each of several trajectories says.

What `jax.vmap` makes of a row written at an index of its own is a scatter, and a loop with one is
no native function on CPU. A few trajectories write one after the other instead. (256 double
pendulums, microseconds each: with 11 rows 214 | 50, 101 rows 307 | 72, 1001 rows 1262 | 296.)
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, PyTree

from jaxlag._lanes import LANES, zero_tangent


def put(buffer: PyTree, index: Array, row: PyTree) -> PyTree:
    """buffer[index] = row in every leaf. Not to be transposed."""
    return jax.tree.map(lambda b, r: _put(b, r.astype(b.dtype), index), buffer, row)


@jax.custom_jvp
def _put(buffer: Array, row: Array, index: Array) -> Array:
    return _places(0)(buffer[None], row[None], index[None])[0]


@_put.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    (*_, index), (buffer_dot, row_dot, _) = primals, tangents
    result = _put(*primals)
    if not jnp.issubdtype(result.dtype, jnp.inexact):
        return result, zero_tangent(result)
    return result, _put(buffer_dot, row_dot, index)


def _places(shared: int) -> Callable:
    """(buffers, rows, indices) -> buffers with a row each.

    Args:
        shared: number of axes after the first one over which buffers and rows share an index.
    """

    def write(k: Array | int, buffers: Array, rows: Array, indices: Array) -> Array:
        start = [k, *[0] * shared, indices[k], *[0] * (rows.ndim - 1 - shared)]
        row = jnp.expand_dims(rows[k], (0, 1 + shared))
        return lax.dynamic_update_slice(buffers, row, [jnp.asarray(i, jnp.int32) for i in start])

    @custom_vmap
    def place(buffers: Array, rows: Array, indices: Array) -> Array:
        count = indices.shape[0]
        if count == 1:
            return write(0, buffers, rows, indices)
        if count <= LANES and jax.default_backend() == "cpu":
            return lax.fori_loop(0, count, lambda k, b: write(k, b, rows, indices), buffers)
        return jax.vmap(lambda *one: write(0, *(x[None] for x in one))[0])(buffers, rows, indices)

    @place.def_vmap
    def _(size: int, mapped: list, *args: Array) -> tuple[Array, bool]:
        def batch(x: Array, is_mapped: bool) -> Array:
            return x if is_mapped else jnp.broadcast_to(x, (size, *x.shape))

        (buffers, rows, indices), count = args, args[2].shape[-1]
        buffers, rows = batch(buffers, mapped[0]), batch(rows, mapped[1])
        if count == 1 and not mapped[2]:  # (size, 1, ...) is (1, size, ...) in memory
            swapped = (jnp.swapaxes(x, 0, 1) for x in (buffers, rows))
            return jnp.swapaxes(_places(shared + 1)(*swapped, indices), 0, 1), True
        each = buffers, rows, batch(indices, mapped[2])
        flat = (x.reshape(size * count, *x.shape[2:]) for x in each)
        return _places(shared)(*flat).reshape(buffers.shape), True

    return place
