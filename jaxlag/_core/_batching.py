"""Batching rule of a solve: how `jax.vmap` runs many trajectories.

On CPU, XLA compiles a loop over a few numbers to vector instructions. A loop over thousands of
numbers traverses memory for every operation. A vmapped solve therefore runs in chunks of
trajectories, one chunk after another. Each chunk is one loop that ends with its last trajectory.

XLA splits large operations among threads. A loop that solves equations for thousands of
trajectories can deadlock on its own threads (jaxlib 0.10.2; never seen on one thread, nor with
matrices of 1e5 numbers in all). Chunks of implicit methods stay far below that.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import PyTree

from jaxlag._core._custom_jvp import CustomJVP

LANES = 16
MOST = 64  # trajectories of an implicit method
NUMBERS = 2**14  # of all their Jacobians of the vector field


def at_once_implicit(size: int) -> int:
    """Number of trajectories of `size` numbers that an implicit method takes in one loop."""
    return max(1, min(MOST, NUMBERS // size**2))


def in_lanes(
    single: Callable, vmapped: Callable, *args: PyTree, at_once: int = LANES, even: bool = False
) -> PyTree:
    """single(*args), and under `jax.vmap` chunks of `vmapped`.

    Results have zero derivatives.

    Args:
        single: of arrays, returns arrays.
        vmapped: the same function, in the form to be vmapped over up to `at_once` trajectories.
        args: pytrees of arrays.
        at_once: the largest chunk.
        even: whether chunks may be smaller to be equal.
    """

    @CustomJVP
    def constant(args: tuple) -> PyTree:
        return batched(args)

    @constant.defjvp
    def _(primals: tuple, _: tuple) -> tuple:
        return constant(*primals), None

    @custom_vmap
    def batched(args: tuple) -> PyTree:
        return single(*args)

    @batched.def_vmap
    def _(size: Any, mapped: list, args: tuple) -> tuple:
        own, shared = eqx.partition(args, mapped[0])
        results = _batch(vmapped, size, at_once, even)(own, shared)
        return results, jax.tree.map(lambda _: True, results)

    return constant(args)


def _batch(vmapped: Callable, size: Any, at_once: Any, even: bool) -> Callable:
    """(own, shared) -> results of `size` trajectories; own leaves have one lane for each.

    A further vmap multiplies the number of lanes.
    """

    @custom_vmap
    def lanes(own: PyTree, shared: PyTree) -> PyTree:
        def one(own: PyTree) -> PyTree:
            return vmapped(*eqx.combine(own, shared))

        return in_batches(one, own, size, at_once, even)

    @lanes.def_vmap
    def _(outer: Any, mapped: list, own: PyTree, shared: PyTree) -> tuple:
        def flat(leaf: Any, is_mapped: bool) -> Any:
            leaf = leaf if is_mapped else jnp.broadcast_to(leaf, (outer, *leaf.shape))
            return leaf.reshape(outer * size, *leaf.shape[2:])

        def spread(leaf: Any) -> Any:
            return jnp.repeat(leaf, size, axis=0)

        more, fewer = eqx.partition(shared, mapped[1])
        own = eqx.combine(jax.tree.map(flat, own, mapped[0]), jax.tree.map(spread, more))
        results = _batch(vmapped, outer * size, at_once, even)(own, fewer)
        results = jax.tree.map(lambda x: x.reshape(outer, size, *x.shape[1:]), results)
        return results, jax.tree.map(lambda _: True, results)

    return lanes


def in_batches(
    function: Callable, lanes: PyTree, count: Any, at_once: Any, even: bool = True
) -> PyTree:
    """The vmapped function over `count` lanes, up to `at_once` at a time.

    Args:
        function: of one lane.
        lanes: leaves (count, ...).
        count: number of lanes.
        at_once: the largest batch.
        even: whether batches may be smaller to be equal; otherwise, and if their number is a symbol
            of `jax.export`, all have `at_once` lanes. The last lane fills up the last batch.
    """
    if at_most(count, at_once):
        return jax.vmap(function)(lanes)
    batches = -(-count // at_once)
    size = -(-count // batches) if even and isinstance(count, int) else at_once
    filled = jnp.minimum(jnp.arange(batches * size), count - 1)
    parts = jax.tree.map(lambda x: x[filled].reshape(batches, size, *x.shape[1:]), lanes)
    results = lax.map(jax.vmap(function), parts)
    return jax.tree.map(lambda x: x.reshape(batches * size, *x.shape[2:])[:count], results)


def at_most(count: Any, most: Any) -> bool:
    """Whether count <= most is known to hold; either may be a symbol of `jax.export`."""
    try:
        return bool(count <= most)
    except jax.errors.InconclusiveDimensionOperation:
        return False
