"""A recorded motion repeated by a scan, which JAX differentiates in any mode, to any order."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from jaxlag._gradient._recorded_motion import (
    RecordedMotion,
    SolveTangents,
    all_saved,
    arrived,
    pick,
)
from jaxlag._integration._loop import CHUNK


class _Slots(NamedTuple):
    """Steps and save times in one sequence; a save time precedes the step that contains it."""

    begins: Array
    ends: Array
    used: Array
    to_save: Array
    jumps: Array | None
    reaches: Array | None
    turn_ends: Array | None


def _slots(
    path: RecordedMotion, anchors: Array, saves: Array
) -> tuple[_Slots, Array, Array | None]:
    """The sequence, and the places of turns and of save times in it."""
    clock, record = path.clock, path.clock.record
    index = jnp.arange(record.offsets.shape[0], dtype=jnp.int32)
    ends = jax.vmap(lambda k: clock.time(k, anchors))(index)
    begins = jnp.concatenate([anchors[:1], ends[:-1]])
    used, reaches = (index < record.turns) & (ends > begins), clock.reach(ends, anchors)
    if record.save_turn is None:
        still = jnp.zeros_like(used)
        whole = (None, None) if reaches is None else (reaches, ends)
        return _Slots(begins, ends, used, still, record.jumps, *whole), index, None
    turn = record.save_turn[:-1]
    count = turn.shape[0]
    reached = turn < record.turns
    before = jnp.searchsorted(turn, index, side="right").astype(jnp.int32)
    of_turn = index + before
    of_save = jnp.where(reached, turn + jnp.arange(count, dtype=jnp.int32), 0)
    size = -(-(index.shape[0] + count) // CHUNK) * CHUNK

    def merged(steps: Array, saved: Array) -> Array:
        place = jnp.where(reached, of_save, size)
        out = jnp.zeros((size,), steps.dtype).at[of_turn].set(steps)
        return out.at[place].set(saved, mode="drop")

    safe = jnp.where(reached, turn, 0)
    whole = (None, None)
    if reaches is not None:
        assert record.save_reach is not None
        whole = merged(reaches, record.save_reach[:-1]), merged(ends, ends[safe])
    slots = _Slots(
        merged(begins, begins[safe]),
        merged(ends, saves[1:-1]),
        merged(used, reached),
        merged(jnp.zeros_like(used), reached),
        None if record.jumps is None else merged(record.jumps, record.jumps[safe]),
        *whole,
    )
    return slots, of_turn, of_save


def again(
    path: RecordedMotion,
    start: PyTree,
    moved: Sequence[Array],
    anchors: Array,
    saves: Array,
    points: bool,
) -> SolveTangents:
    """The motion repeated by a scan, which JAX differentiates in any mode and to any order.

    The scan skips whole chunks that no lane of a vmapped solve needs. Unused turns
    repeat the first step and discard its result, so that derivatives avoid unreachable states.
    """
    clock, record = path.clock, path.clock.record
    slots, of_turn, of_save = _slots(path, anchors, saves)
    first = jnp.argmax(slots.used)
    begins = jnp.where(slots.used, slots.begins, slots.begins[first])
    ends = jnp.where(slots.used, slots.ends, slots.ends[first])
    slots = slots._replace(begins=begins, ends=ends)
    if slots.turn_ends is not None:
        turn_ends = jnp.where(slots.used, slots.turn_ends, slots.turn_ends[first])
        slots = slots._replace(turn_ends=turn_ends)

    @partial(jax.checkpoint, prevent_cse=False)
    def step(slot: _Slots, y: PyTree) -> PyTree:
        args, jump, rest = path.with_args(moved), slot.jumps, (slot.reaches, slot.turn_ends)
        return path.ahead(args, slot.begins, slot.ends, jump, y, *rest)

    def one(y: PyTree, slot: _Slots) -> tuple[PyTree, tuple[PyTree, PyTree]]:
        new = step(slot, pick(slot.used, y, start))
        return pick(slot.used & ~slot.to_save, new, y), (y, new)

    def chunk(y: PyTree, slots: _Slots) -> tuple[PyTree, PyTree]:
        def skip(y: PyTree) -> tuple[PyTree, PyTree]:
            same = jax.tree.map(lambda x: jnp.broadcast_to(x, (CHUNK, *x.shape)), y)
            return y, (same, same)

        def take(y: PyTree) -> tuple[PyTree, PyTree]:
            return jax.lax.scan(one, y, slots)

        return jax.lax.cond(eqxi.unvmap_any(slots.used), take, skip, y)

    parts = jax.tree.map(lambda x: x.reshape(-1, CHUNK), slots)
    last, found = path.native(partial(jax.lax.scan, chunk), start, parts)
    befores, afters = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), found)
    saved = point_states = None
    if of_save is not None:
        assert record.save_turn is not None
        reached = record.save_turn[:-1] < record.turns

        def gathered(x: Array) -> Array:
            wide = reached.reshape(reached.shape + (1,) * (x.ndim - 1))
            found = jnp.where(wide, x[of_save], 0.0)
            return jnp.concatenate([found, jnp.zeros_like(x[:1])])

        saved = jax.tree.map(gathered, afters)
    if points:
        count = jax.tree.leaves(record.points)[0].shape[0]
        at = jnp.arange(count, dtype=jnp.int32) * record.stride
        inside = (at < record.turns) & (at // record.stride < count - 1)
        at = of_turn[jnp.where(inside, at, 0)]

        def kept(x: Array) -> Array:
            wide = inside.reshape(inside.shape + (1,) * (x.ndim - 1))
            return jnp.where(wide, x[at], 0.0)

        point_states = jax.tree.map(kept, befores)
    time = clock.time(clock.last, anchors)
    return SolveTangents(
        last, time, all_saved(start, saved, last, arrived(path, anchors)), point_states
    )
