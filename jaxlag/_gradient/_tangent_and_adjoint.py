"""Tangent and adjoint sweeps over the recorded steps.

With y_{k+1} = step(y_k, args, t_k, t_{k+1}) at recorded times the derivative is

    dy_{k+1} = J_k dy_k + B_k dargs + c_k dt_k + e_k dt_{k+1},

and the same for a saved state, which a step from y_k reaches at its own time. It is a linear map
from (dy_0, dargs, danchors, dsaves) to the required states dy_0, dy_1, ... and the saved states.
The forward sweep carries dy beside y. The reverse sweep takes the transposed steps from the last to
the first, at the recorded points. If points are further apart than one step, the states between are
recomputed from them. Neither sweep depends on the step-size control, whose error estimates round
differently in another program.

Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. II.6 (variational
equations); Griewank, Walther, Evaluating Derivatives, ch. 12 (checkpoints).
"""

from collections.abc import Callable
from functools import partial
from math import ceil, log2
from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from jaxlag._core._buffer_entries import set_entry
from jaxlag._gradient._recorded_motion import (
    InputTangents,
    RecordedMotion,
    SolveTangents,
    all_saved,
    arrived,
    at,
    pick,
)
from jaxlag._integration._record import Record


def _add(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.add, a, b)


def _zeros(state: PyTree, size: Any) -> PyTree:
    return jax.tree.map(lambda x: jnp.zeros((size, *x.shape), x.dtype), state)


def _step_of_save_time(record: Record, r: Array) -> Array:
    """The step that save time r precedes; save times after the last are beyond all steps."""
    assert record.save_step is not None
    return jnp.where(r < 0, -1, at(record.save_step, r))


def tangent_sweep(path: RecordedMotion, change: InputTangents, points: bool) -> SolveTangents:
    """The derivative in one direction: forward variational equations."""
    clock, record = path.clock, path.clock.record
    anchors, dues = clock.times.anchors(), clock.times.dues()
    dues_dot = None
    if change.saves is not None:
        dues_dot = jnp.concatenate([change.saves[1:-1], jnp.zeros_like(change.saves[:1])])
    start = path.start
    dy0 = jax.tree.map(jnp.zeros_like, start) if change.y0 is None else (change.y0, None)
    count = 0 if record.points is None else jax.tree.leaves(record.points)[0].shape[0]
    zero = jnp.zeros((), jnp.int32)
    saved = None if record.save_step is None else _zeros(start, record.save_step.shape[0])
    # Save times are reached from the state before the last step, with its dy.
    base = None if saved is None else (start, dy0)
    init = (zero, zero, start, dy0, base, saved, _zeros(start, count) if points else None)

    def body_fun(carry: tuple) -> tuple:
        """One step, or one to a save time if a lane takes none or must first reach it."""
        k, r, y, dy, base, saved, stored = carry
        t, step_end = clock.time(k - 1, anchors), clock.time(k, anchors)
        use, end = (k < record.steps) & (step_end > t), step_end
        to_save, save, i = jnp.array(False), jnp.array(False), k
        if points:
            at_point = (k < record.steps) & (k % record.stride == 0)
            stored = set_entry(stored, jnp.where(at_point, k // record.stride, count - 1), dy)
        before = (y, dy)
        if saved is not None:
            j = _step_of_save_time(record, r)
            left = (j < k) & (j < record.steps)
            to_save = eqxi.unvmap_any(left & use)
            use, save = use & ~to_save, left & (~use | to_save)
            i, before = jnp.where(save, j, k), pick(save, base, before)
            t, step_end = clock.time(i - 1, anchors), clock.time(i, anchors)
            end = jnp.where(save, at(dues, r), step_end)
        reach = clock.reach(step_end, anchors, *(() if saved is None else (save, r)))
        jump, end_dot = clock.jump(i), None
        if change.anchors is not None:
            end_dot = change.anchors[clock.anchor(i)]
            if saved is not None:
                assert dues_dot is not None
                end_dot = jnp.where(save, dues_dot[r], end_dot)
        if end_dot is None:
            step = lambda y, moved: path.ahead(  # noqa: E731
                path.with_args(moved), t, end, jump, y, reach, step_end
            )
            y1, dy1 = jax.jvp(step, (before[0], path.moved()), (before[1], change.args))
        else:
            assert change.anchors is not None
            step = lambda y, moved, t, end, *step_end: path.ahead(  # noqa: E731
                path.with_args(moved), t, end, jump, y, reach, *step_end
            )
            given = (before[0], path.moved(), t, end)
            dots = (before[1], change.args, change.anchors[clock.anchor(i - 1)], end_dot)
            if reach is not None:
                given, dots = (*given, step_end), (*dots, change.anchors[clock.anchor(i)])
            y1, dy1 = jax.jvp(step, given, dots)
        if saved is not None:
            assert record.save_step is not None
            saved = set_entry(saved, jnp.where(save, r, record.save_step.shape[0] - 1), dy1)
            r, base = r + save.astype(jnp.int32), pick(use, (y, dy), base)
        y, dy = pick(use, (y1, dy1), (y, dy))
        return k + (~to_save).astype(jnp.int32), r, y, dy, base, saved, stored

    def cond_fun(carry: tuple) -> Array:
        k, r, *_ = carry
        left = k < record.steps
        if saved is not None:
            left = left | (_step_of_save_time(record, r) < record.steps)
        return eqxi.unvmap_any(left)

    loop = partial(jax.lax.while_loop, cond_fun, body_fun)
    *_, dy, _, saved, stored = path.native(loop, init)
    time = jnp.zeros_like(clock.times.stop)
    if change.anchors is not None:
        time = change.anchors[clock.anchor(clock.last)]
    return SolveTangents(dy, time, all_saved(dy0, saved, dy, arrived(path, anchors)), stored)


def adjoint_sweep(
    path: RecordedMotion, change: InputTangents, wanted: SolveTangents
) -> InputTangents:
    """The transposed map: the adjoint equations, from the last step to the first.

    Args:
        path: the motion.
        change: marks the parts of `InputTangents` that exist.
        wanted: cotangents.
    """
    clock, record = path.clock, path.clock.record
    anchors, dues = clock.times.anchors(), clock.times.dues()
    assert record.points is not None
    between = None if record.save_step is None else jax.tree.map(lambda x: x[1:], wanted.saved)
    moves = change.anchors is not None
    any_lane = eqxi.unvmap_any if path.lockstep else lambda x: x
    zero = jnp.zeros((), jnp.int32)
    reached = arrived(path, anchors)
    end_bar = jax.tree.map(lambda x: jnp.where(reached, x[-1], 0.0), wanted.saved)
    bars = (
        [jnp.zeros_like(x) for x in path.moved()],
        _added_at(jnp.zeros_like(anchors), clock.anchor(clock.last), wanted.time)
        if moves
        else None,
        jnp.zeros_like(dues) if moves else None,
    )

    def save_left(r: Array) -> Array:
        """The step of the last remaining save time."""
        return jnp.array(-1) if between is None else _step_of_save_time(record, r - 1)

    def body_fun(first: Array, state_before: Callable, carry: tuple) -> tuple:
        """One iteration back: step k - 1, or save times reached from the state before step k.

        The cotangent belongs to the state before step k. A lane that does not take step k - 1 takes
        a save time reached from the state before its last step; `pending` is its contribution
        there.
        """
        k, r, bar, pending, (args_bar, anchors_bar, dues_bar) = carry
        j, now = save_left(r), clock.time(k - 1, anchors)
        here = j == k
        to_save = any_lane(here)
        k = jnp.where(to_save, k, k - 1)
        t, step_end = clock.time(k - 1, anchors), clock.time(k, anchors)
        use, save, i, given = (k < record.steps) & (step_end > t) & ~to_save, here, k, bar
        end, reached = step_end, clock.reach(step_end, anchors)
        if between is not None:
            save = here | (~use & (j >= first) & (clock.time(j, anchors) == now))
            i = jnp.where(save, j, k)
            t, step_end = clock.time(i - 1, anchors), clock.time(i, anchors)
            end = jnp.where(save, at(dues, r - 1), end)
            reached = clock.reach(step_end, anchors, save, r - 1)
            given = pick(save, at(between, r - 1), bar)
        y, jump, takes = state_before(i), clock.jump(i), use | save
        with_moved, moved, starts = path.local(t)
        if not moves:
            step = lambda y, moved: path.ahead(  # noqa: E731
                with_moved(moved), t, end, jump, y, reached, step_end
            )
            before, more = path.evaluate(_transposed(step), given, y, moved)
        else:
            step = lambda y, moved, t, end, *step_end: path.ahead(  # noqa: E731
                with_moved(moved), t, end, jump, y, reached, *step_end
            )
            times = (t, end) if reached is None else (t, end, step_end)
            before, more, *times_bar = path.evaluate(_transposed(step), given, y, moved, *times)
            t_bar, end_bar, *step_end_bar = (jnp.where(takes, x, 0.0) for x in times_bar)
            at_save = jnp.where(save, end_bar, 0.0)
            anchors_bar = _added_at(anchors_bar, clock.anchor(i - 1), t_bar)
            anchors_bar = _added_at(
                anchors_bar, clock.anchor(i), sum(step_end_bar, end_bar - at_save)
            )
            if between is not None:
                dues_bar = _added_at(dues_bar, r - 1, at_save)
        more = [jnp.where(takes, x, 0.0) for x in more]
        args_bar = [_added(*pair) for pair in zip(args_bar, more, starts, strict=True)]
        if between is None:
            bar = pick(use, before, bar)
        else:
            zeros = jax.tree.map(jnp.zeros_like, bar)
            summed = _add(before, pick(here, bar, pending))
            bar = pick(use | here, summed, bar)
            pending = pick(use, zeros, pick(save & ~here, summed, pending))
            r = r - save.astype(jnp.int32)
        if wanted.points is not None:
            at_point = ~to_save & (k % record.stride == 0) & (k < record.steps)
            bar = pick(at_point, _add(bar, at(wanted.points, k // record.stride)), bar)
        return k, r, bar, pending, (args_bar, anchors_bar, dues_bar)

    def back(first: Array, state_before: Callable, carry: tuple) -> tuple:
        """All steps after the first, and the save times of the first."""

        def left(carry: tuple) -> Array:
            k, r, *_ = carry
            return (k > first) | any_lane(save_left(r) == k)

        return jax.lax.while_loop(left, partial(body_fun, first, state_before), carry)

    # Lanes that were recorded together have one stride; all have points at the longest stride.
    stride = eqxi.unvmap_max(record.stride)
    room = jax.tree.leaves(record.points)[0].shape[0] - 1
    slots = record.offsets.shape[0]
    longest = 2 * -(-slots // room)  # an upper bound, for a symbol of jax.export
    if isinstance(slots, int):
        longest = 2 ** ceil(log2(slots / room))

    def segment(carry: tuple) -> tuple:
        """All steps since the last point before step k; all steps if each has a point."""
        k = carry[0]
        first = jnp.where(stride == 1, 0, (k - 1) // stride * stride)
        y = at(record.points, first // record.stride)
        states = set_entry(_zeros(y, longest), zero, y)

        def ahead(carry: tuple) -> tuple:
            j, y, states = carry
            t, end = clock.time(j - 1, anchors), clock.time(j, anchors)
            use = (j < record.steps) & (end > t)
            y = pick(use, path.recompute(j, anchors, y), y)
            return j + 1, y, set_entry(states, j + 1 - first, y)

        init = (first, y, states)
        missing = lambda c: (stride > 1) & (c[0] < k - 1)  # noqa: E731
        states = jax.lax.while_loop(missing, ahead, init)[2]

        def state_before(j: Array) -> PyTree:
            return pick(stride == 1, at(record.points, j), at(states, j - first))

        return back(first, state_before, carry)

    def all_back(carry: tuple) -> tuple:
        if longest == 1:
            return back(zero, partial(at, record.points), carry)
        return jax.lax.while_loop(lambda c: c[0] > 0, segment, carry)

    most = eqxi.unvmap_max(record.steps) if path.lockstep else record.steps
    saves_left = zero
    if record.save_step is not None:
        saves_left = jnp.sum(record.save_step < record.steps, dtype=jnp.int32)
    bar = _add(wanted.last, end_bar)
    pending = None if between is None else jax.tree.map(jnp.zeros_like, bar)
    ended = path.native(all_back, (most, saves_left, bar, pending, bars))
    _, _, bar, _, (args_bar, anchors_bar, dues_bar) = ended
    bar = _add(bar, jax.tree.map(lambda x: x[0], wanted.saved))
    saves_bar = None
    if moves:
        ends = jnp.zeros_like(clock.times.saves[:1])
        saves_bar = jnp.concatenate([ends, dues_bar[:-1], ends])
    return InputTangents(None if change.y0 is None else bar[0], args_bar, anchors_bar, saves_bar)


def _transposed(step: Callable) -> Callable:
    """(cotangent of the result, *args) -> cotangents of the arguments."""
    return lambda bar, *args: jax.vjp(step, *args)[1](bar)


def _added(bar: Array, more: Array, start: Array | None) -> Array:
    """The cotangent of a leaf plus a contribution; two entries of a table go to their place."""
    if start is None:
        return bar + more
    for k in range(more.shape[0]):
        bar = _added_at(bar, start + k, more[k])
    return bar


def _added_at(bar: Array, index: Array, more: Array) -> Array:
    """A contribution added to one entry."""
    return set_entry(bar, index, at(bar, index) + more)
