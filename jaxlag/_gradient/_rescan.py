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
    step_ends: Array | None


def _slots(
    path: RecordedMotion, anchors: Array, saves: Array
) -> tuple[_Slots, Array, Array | None]:
    """The sequence, and the places of steps and of save times in it."""
    clock, record = path.clock, path.clock.record
    index = jnp.arange(record.offsets.shape[0], dtype=jnp.int32)
    ends = jax.vmap(lambda k: clock.time(k, anchors))(index)
    begins = jnp.concatenate([anchors[:1], ends[:-1]])
    used, reaches = (index < record.steps) & (ends > begins), clock.reach(ends, anchors)
    if record.save_step is None:
        no_saves = jnp.zeros_like(used)
        whole = (None, None) if reaches is None else (reaches, ends)
        return _Slots(begins, ends, used, no_saves, record.jumps, *whole), index, None
    save_step = record.save_step[:-1]
    count = save_step.shape[0]
    reached = save_step < record.steps
    before = jnp.searchsorted(save_step, index, side="right").astype(jnp.int32)
    of_step = index + before
    of_save = jnp.where(reached, save_step + jnp.arange(count, dtype=jnp.int32), 0)
    size = -(-(index.shape[0] + count) // CHUNK) * CHUNK

    def merged(steps: Array, saved: Array) -> Array:
        place = jnp.where(reached, of_save, size)
        out = jnp.zeros((size,), steps.dtype).at[of_step].set(steps)
        return out.at[place].set(saved, mode="drop")

    safe = jnp.where(reached, save_step, 0)
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
    return slots, of_step, of_save


def again(
    path: RecordedMotion,
    start: PyTree,
    moved: Sequence[Array],
    anchors: Array,
    saves: Array,
    points: bool,
) -> SolveTangents:
    """The motion repeated by a scan, which JAX differentiates in any mode and to any order.

    The scan skips whole chunks that no lane of a vmapped solve needs. Unused slots
    repeat the first step and discard its result, so that derivatives avoid unreachable states.
    """
    clock, record = path.clock, path.clock.record
    slots, of_step, of_save = _slots(path, anchors, saves)
    first = jnp.argmax(slots.used)
    begins = jnp.where(slots.used, slots.begins, slots.begins[first])
    ends = jnp.where(slots.used, slots.ends, slots.ends[first])
    slots = slots._replace(begins=begins, ends=ends)
    if slots.step_ends is not None:
        step_ends = jnp.where(slots.used, slots.step_ends, slots.step_ends[first])
        slots = slots._replace(step_ends=step_ends)

    @partial(jax.checkpoint, prevent_cse=False)
    def step(slot: _Slots, y: PyTree) -> PyTree:
        args, jump, rest = path.with_args(moved), slot.jumps, (slot.reaches, slot.step_ends)
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
        assert record.save_step is not None
        reached = record.save_step[:-1] < record.steps

        def gathered(x: Array) -> Array:
            wide = reached.reshape(reached.shape + (1,) * (x.ndim - 1))
            found = jnp.where(wide, x[of_save], 0.0)
            return jnp.concatenate([found, jnp.zeros_like(x[:1])])

        saved = jax.tree.map(gathered, afters)
    if points:
        count = jax.tree.leaves(record.points)[0].shape[0]
        at = jnp.arange(count, dtype=jnp.int32) * record.stride
        inside = (at < record.steps) & (at // record.stride < count - 1)
        at = of_step[jnp.where(inside, at, 0)]

        def at_points(x: Array) -> Array:
            wide = inside.reshape(inside.shape + (1,) * (x.ndim - 1))
            return jnp.where(wide, x[at], 0.0)

        point_states = jax.tree.map(at_points, befores)
    time = clock.time(clock.last, anchors)
    return SolveTangents(
        last, time, all_saved(start, saved, last, arrived(path, anchors)), point_states
    )
