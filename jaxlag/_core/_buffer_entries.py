"""Buffer reads and writes at an index of each trajectory's own, without a gather or scatter.

`jax.vmap` turns such a write into a scatter, and on CPU a loop with a scatter is no native
function. A few trajectories write one after the other instead. (256 double
pendulums, microseconds each: with 11 entries 214 | 50, 101 entries 307 | 72, 1001 entries 1262 |
296.) They also read one after the other: a gather of 32 entries takes ten times as long.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, PyTree

from jaxlag._core._batching import LANES, at_most
from jaxlag._core._custom_jvp import CustomJVP


def set_entry(buffer: PyTree, index: Array, entry: PyTree) -> PyTree:
    """buffer[index] = entry in every leaf. It has no transpose."""
    return jax.tree.map(lambda b, r: _put(b, r.astype(b.dtype), index), buffer, entry)


def entry_of(buffer: PyTree, index: Array) -> PyTree:
    """buffer[index] of every leaf, for an index from 0. It has no transpose."""
    return jax.tree.map(lambda b: _get(b, index), buffer)


def set_entries(
    buffers: Array, rows: Array, indices: Array, entries: Array, active: Array
) -> Array:
    """buffers[rows[k], indices[k]] = entries[k] where active[k], one after another."""
    rest = buffers.shape[2:]

    def write(k: Array, buffers: Array) -> Array:
        start = [rows[k], indices[k], *[0] * len(rest)]
        start = [jnp.asarray(i, jnp.int32) for i in start]
        present = lax.dynamic_slice(buffers, start, (1, 1, *rest))
        new = jnp.where(active[k], entries[k].reshape(present.shape), present)
        return lax.dynamic_update_slice(buffers, new, start)

    return lax.fori_loop(0, rows.shape[0], write, buffers)


def is_set_entry(params: Any) -> bool:
    """Whether an operation with these parameters is `set_entry` of an array."""
    return getattr(params.get("rule"), "__wrapped__", None) is _place.vmap_rule


@CustomJVP
def _get(buffer: Array, index: Array) -> Array:
    return _taken(buffer, index)


@_get.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    (_, index), (buffer_dot, _) = primals, tangents
    result = _get(*primals)
    inexact = jnp.issubdtype(result.dtype, jnp.inexact)
    return result, _get(buffer_dot, index) if inexact else None


@custom_vmap
def _taken(buffer: Array, index: Array) -> Array:
    return lax.dynamic_index_in_dim(buffer, index, keepdims=False)


@_taken.def_vmap
def _(size: Any, mapped: list, buffer: Array, index: Array) -> tuple[Array, bool]:
    if not mapped[1]:
        return lax.dynamic_index_in_dim(buffer, index, 1, keepdims=False), True
    if not at_most(size, 2 * LANES) or jax.default_backend() != "cpu":
        take = jax.vmap(_taken.fun, in_axes=(0 if mapped[0] else None, 0))
        return take(buffer, index), True

    def read(k: Array, entries: Array) -> Array:
        own = (k, index[k]) if mapped[0] else (index[k],)
        ends = buffer.shape[len(own) :]
        start = [*own, *[0] * len(ends)]
        start = [jnp.asarray(i, jnp.int32) for i in start]
        entry = lax.dynamic_slice(buffer, start, [*[1] * len(own), *ends])
        return lax.dynamic_update_index_in_dim(entries, entry.reshape(ends), k, 0)

    entry = buffer.shape[2:] if mapped[0] else buffer.shape[1:]
    return lax.fori_loop(0, size, read, jnp.zeros((size, *entry), buffer.dtype)), True


@CustomJVP
def _put(buffer: Array, entry: Array, index: Array) -> Array:
    return _place(buffer, entry, index)


@_put.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    (*_, index), (buffer_dot, entry_dot, _) = primals, tangents
    result = _put(*primals)
    if not jnp.issubdtype(result.dtype, jnp.inexact):
        return result, None
    return result, _put(buffer_dot, entry_dot, index)


def _write(buffer: Array, entry: Array, *index: Array | None) -> Array:
    """buffer[index] = entry; None for a whole axis."""
    axes = [axis for axis, k in enumerate(index) if k is not None]
    start = [0 if k is None else k for k in (*index, *[None] * (buffer.ndim - len(index)))]
    start = [jnp.asarray(k, jnp.int32) for k in start]
    return lax.dynamic_update_slice(buffer, jnp.expand_dims(entry, axes), start)


@custom_vmap
def _place(buffer: Array, entry: Array, index: Array) -> Array:
    return _write(buffer, entry, index)


@_place.def_vmap
def _(size: Any, mapped: list, buffer: Array, entry: Array, index: Array) -> tuple[Array, bool]:
    buffer, entry = _each(size, mapped, buffer, entry)
    if mapped[2]:
        return _places(0)(buffer, entry, index), True
    return _places(1)(buffer[None], entry[None], index[None])[0], True


def _each(size: Any, mapped: list, *arrays: Array) -> list[Array]:
    """The arrays, broadcast to one entry for each of `size`."""
    pairs = zip(arrays, mapped, strict=False)
    return [x if has else jnp.broadcast_to(x, (size, *x.shape)) for x, has in pairs]


def _places(shared: int) -> Callable:
    """(buffers, entries, indices) -> buffers with one entry written in each.

    Args:
        shared: number of axes after the first one over which buffers and entries share an index.
    """
    whole = [None] * shared

    def one(buffer: Array, entry: Array, index: Array) -> Array:
        return _write(buffer, entry, *whole, index)

    @custom_vmap
    def place(buffers: Array, entries: Array, indices: Array) -> Array:
        count = indices.shape[0]
        if count == 1:
            return one(buffers[0], entries[0], indices[0])[None]
        if not at_most(count, 2 * LANES) or jax.default_backend() != "cpu":
            return jax.vmap(one)(buffers, entries, indices)

        def write(k: Array, buffers: Array) -> Array:
            return _write(buffers, entries[k], k, *whole, indices[k])

        return lax.fori_loop(0, count, write, buffers)

    @place.def_vmap
    def _(size: Any, mapped: list, *args: Array) -> tuple[Array, bool]:
        buffers, entries, indices = args
        count = indices.shape[-1]
        buffers, entries = _each(size, mapped, buffers, entries)
        if count == 1 and not mapped[2]:  # (size, 1, ...) is (1, size, ...) in memory
            swapped = (jnp.swapaxes(x, 0, 1) for x in (buffers, entries))
            return jnp.swapaxes(_places(shared + 1)(*swapped, indices), 0, 1), True
        flat = (
            x.reshape(size * count, *x.shape[2:])
            for x in (buffers, entries, *_each(size, mapped[2:], indices))
        )
        return _places(shared)(*flat).reshape(buffers.shape), True

    return place
