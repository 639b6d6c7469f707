"""Batching rule of a solve: how `jax.vmap` runs many trajectories.

On CPU, XLA compiles a loop over a few numbers to vector instructions. A loop over thousands of
numbers traverses memory for every operation. A vmapped solve therefore runs in chunks of
trajectories, one chunk after another. Each chunk is one loop that ends with its last trajectory.
Where a step has a form on numbers, larger chunks share the lanes of a vectorized loop
(`_integration._vector_loop`).

XLA splits large operations among threads. A loop that solves equations for thousands of
trajectories can deadlock on its own threads (jaxlib 0.10.2; never seen on one thread, nor with
matrices of 1e5 numbers in all). Chunks of implicit methods stay far below that.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, PyTree

from jaxlag._core._custom_jvp import CustomJVP

LANES = 16
VECTORIZED = 1024  # trajectories that share a vectorized loop
# XLA allocates memory for every operation of such a loop when a program is called: 0.3 to 0.5 ms.
# A turn of a trajectory is shorter by 0.1 to 0.2 us. So many trajectories, and turns of all:
VECTORIZED_FROM = 64
TURNS = 4096
MOST = 64  # trajectories of any method that takes several at once
NUMBERS = 2**14  # of all their Jacobians of the vector field


def at_once_implicit(size: int) -> int:
    """Number of trajectories of `size` numbers that an implicit method takes in one loop."""
    return max(1, min(MOST, NUMBERS // size**2))


def is_faster_vectorized(count: Any, max_steps: int) -> bool:
    """Whether a vectorized loop is faster.

    Args:
        count: number of trajectories, which may be a symbol of `jax.export`.
        max_steps: bound on the steps of each.
    """
    is_known = isinstance(count, int)  # a program for any number of them cannot be exported
    return is_known and count >= VECTORIZED_FROM and count * max_steps >= TURNS


class Chunks(NamedTuple):
    """How a batch of trajectories is divided.

    Attributes:
        function: of one trajectory, in the form to be vmapped.
        at_once: the largest number of trajectories in a chunk.
        even: whether chunks may be smaller to be equal.
    """

    function: Callable
    at_once: int = LANES
    even: bool = False


def in_lanes(single: Callable, chunks: Callable[[Any], Chunks], *args: PyTree) -> PyTree:
    """single(*args), and under `jax.vmap` one chunk of trajectories after another.

    Results have zero derivatives.

    Args:
        single: of arrays, returns arrays.
        chunks: number of trajectories -> how they are divided.
        args: pytrees of arrays.
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
        results = _batch(chunks, size)(own, shared)
        return results, jax.tree.map(lambda _: True, results)

    return constant(args)


def _batch(chunks: Callable[[Any], Chunks], size: Any) -> Callable:
    """(own, shared) -> results of `size` trajectories; own leaves have one lane for each.

    A further vmap multiplies the number of lanes.
    """

    @custom_vmap
    def lanes(own: PyTree, shared: PyTree) -> PyTree:
        divided = chunks(size)

        def one(own: PyTree) -> PyTree:
            return divided.function(*eqx.combine(own, shared))

        return in_batches(one, own, size, divided.at_once, divided.even)

    @lanes.def_vmap
    def _(outer: Any, mapped: list, own: PyTree, shared: PyTree) -> tuple:
        def flat(leaf: Any, is_mapped: bool) -> Any:
            leaf = leaf if is_mapped else jnp.broadcast_to(leaf, (outer, *leaf.shape))
            return leaf.reshape(outer * size, *leaf.shape[2:])

        def spread(leaf: Any) -> Any:
            return jnp.repeat(leaf, size, axis=0)

        more, fewer = eqx.partition(shared, mapped[1])
        own = eqx.combine(jax.tree.map(flat, own, mapped[0]), jax.tree.map(spread, more))
        results = _batch(chunks, outer * size)(own, fewer)
        results = jax.tree.map(lambda x: x.reshape(outer, size, *x.shape[1:]), results)
        return results, jax.tree.map(lambda _: True, results)

    return lanes


def in_batches(
    function: Callable,
    lanes: PyTree,
    count: Any,
    at_once: Any,
    even: bool = True,
    order: Array | None = None,
) -> PyTree:
    """The vmapped function over `count` lanes, up to `at_once` at a time.

    Args:
        function: of one lane.
        lanes: leaves (count, ...).
        count: number of lanes.
        at_once: the largest batch.
        even: whether batches may be smaller to be equal; otherwise, and if their number is a symbol
            of `jax.export`, all have `at_once` lanes. The last lane fills up the last batch.
        order: of the lanes in the batches; None for their own.
    """
    if at_most(count, at_once):
        return jax.vmap(function)(lanes)
    batches = -(-count // at_once)
    size = -(-count // batches) if even and isinstance(count, int) else at_once
    filled = jnp.minimum(jnp.arange(batches * size), count - 1)
    if order is not None:
        filled = order[filled]

    def batch(of: Array) -> PyTree:
        return jax.vmap(function)(jax.tree.map(lambda x: x[of], lanes))

    results = lax.map(batch, filled.reshape(batches, size))
    results = jax.tree.map(lambda x: x.reshape(batches * size, *x.shape[2:])[:count], results)
    if order is None:
        return results
    places = jnp.argsort(order)
    return jax.tree.map(lambda x: x[places], results)


def at_most(count: Any, most: Any) -> bool:
    """Whether count <= most is known to hold; either may be a symbol of `jax.export`."""
    try:
        return bool(count <= most)
    except jax.errors.InconclusiveDimensionOperation:
        return False
