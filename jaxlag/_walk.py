"""Along a recorded motion and back: derivatives of states and rows, in loops that end where it did.

With y_{k+1} = step(y_k, args, t_k, t_{k+1}) at recorded times the derivative is

    dy_{k+1} = J_k dy_k + B_k dargs + c_k dt_k + e_k dt_{k+1},

and the same for a row, which is a step from y_k to its own time: a linear map from (dy_0, dargs,
danchors, dsaves) to what is wanted of dy_0, dy_1, ..., and of the rows. Forwards dy is carried
beside y. Backwards the transposed steps are taken from the last to the first, at the recorded
points, or at states found anew from them where points are further apart than a step. Neither
depends on the step-size control, whose error estimates round differently in another program.

Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. II.6 (variational
equations); Griewank, Walther, Evaluating Derivatives, ch. 12 (checkpoints).
"""

from collections.abc import Callable, Sequence
from functools import partial
from math import ceil, log2
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from jaxlag import _xla
from jaxlag._drive import CHUNK
from jaxlag._record import Record, Times


class Walk(NamedTuple):
    """What is wanted of a motion or of its derivative.

    Attributes:
        last: state after the last step.
        time: of it.
        rows: the rows, (s, ...).
        points: states at the points of the record; None where nobody asks.
    """

    last: PyTree
    time: Array
    rows: PyTree
    points: PyTree | None


class Change(NamedTuple):
    """A direction of what a motion depends on; None for what does not move.

    Attributes:
        y0: of the start, an array.
        args: of some leaves of the arguments.
        anchors: of `Times.anchors`.
        saves: of `Times.saves`; moves where the anchors do.
    """

    y0: Array | None
    args: list[Array]
    anchors: Array | None
    saves: Array | None


class Clock(NamedTuple):
    """When the turns of a recorded motion ended; time -1 is that of the start."""

    times: Times
    record: Record

    def time(self, k: Array, anchors: Array) -> Array:
        """Time after turn k."""
        offset, anchor = _at(self.record.offsets, k), self.anchor(k)
        moved = anchors[anchor] + jnp.where(jnp.isinf(offset), 0.0, offset)
        return jnp.where(k < 0, anchors[0], moved)

    def anchor(self, k: Array) -> Array:
        """The anchor that it moves with."""
        if self.record.anchors is not None:
            return jnp.where(k < 0, 0, _at(self.record.anchors, k))
        return ((k >= 0) & jnp.isinf(_at(self.record.offsets, k))).astype(jnp.int32)

    def jump(self, k: Array) -> Array | None:
        """Whether the vector field jumps where turn k starts."""
        return None if self.record.jumps is None else _at(self.record.jumps, k)

    @property
    def last(self) -> Array:
        """The last turn."""
        return self.record.turns - 1


class Path(NamedTuple):
    """A recorded motion: what was given to the loop and what it kept.

    Attributes:
        step: (args, t0, t1, state, jump) -> state.
        between: the same in a form that takes less to compile.
        start: the state before the first step, as the step takes it.
        args: leaves of the arguments.
        tree: of the arguments.
        moving: indices of the leaves that may move.
        windows: (args, t0) -> (args as a step from t0 reads them: of each table two rows; where
            these rows start in the leaves that may move, None for those that are no tables).
        clock: times of the steps.
        stages: number of them in a step, 0 where it has none.
    """

    step: Callable
    between: Callable
    start: PyTree
    args: list
    tree: Any
    moving: tuple[int, ...]
    windows: Callable
    clock: Clock
    stages: int

    def with_args(self, moved: Sequence[Array], leaves: Sequence[Any] | None = None) -> Any:
        """The arguments with other values of the leaves that may move."""
        leaves = list(self.args if leaves is None else leaves)
        for i, leaf in zip(self.moving, moved, strict=True):
            leaves[i] = leaf
        return jax.tree.unflatten(self.tree, leaves)

    def ahead(self, args: Any, t: Array, end: Array, jump: Array | None, state: PyTree) -> PyTree:
        """The state one step on."""
        return self.step(args, t, end, state, jnp.array(False) if jump is None else jump)

    def found(self, t: Array, end: Array, jump: Array | None, state: PyTree) -> PyTree:
        """The same between points."""
        args = self.with_args(self.moved())
        return self.between(args, t, end, state, jnp.array(False) if jump is None else jump)

    def moved(self) -> list[Array]:
        """The leaves of the arguments that may move."""
        return [self.args[i] for i in self.moving]

    def local(self, t: Array) -> tuple[Callable, list[Array], list[Array | None]]:
        """What a step from t reads of the arguments.

        Returns:
            moved -> arguments, what moves of them (of tables two rows), where these rows start.
        """
        args, starts = self.windows(self.with_args(self.moved()), t)
        leaves = jax.tree.leaves(args, is_leaf=lambda x: x is None)
        moved = [leaves[i] for i in self.moving]
        return partial(self.with_args, leaves=leaves), moved, [starts[i] for i in self.moving]


def _at(buffer: PyTree, k: Array) -> PyTree:
    index = partial(jax.lax.dynamic_index_in_dim, index=jnp.maximum(k, 0), keepdims=False)
    return jax.tree.map(index, buffer)


def _put(buffer: PyTree, k: Array, row: PyTree) -> PyTree:
    put = partial(jax.lax.dynamic_update_index_in_dim, index=k, axis=0)
    return jax.tree.map(put, buffer, row)


def _pick(use: Array, new: PyTree, old: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(use, a, b), new, old)


def _add(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.add, a, b)


def _zeros(state: PyTree, size: int) -> PyTree:
    return jax.tree.map(lambda x: jnp.zeros((size, *x.shape), x.dtype), state)


def _joined(first: PyTree, rows: PyTree | None, last: PyTree, reached: Array) -> PyTree:
    """All rows, from those between the first and the last; zero where there was none."""

    def of(a: Array, between: Array | None, b: Array) -> Array:
        parts = [a[None], jnp.where(reached, b, 0.0)[None]]
        if between is not None:
            parts.insert(1, between[:-1])
        return jnp.concatenate(parts)

    if rows is None:
        return jax.tree.map(lambda a, b: of(a, None, b), first, last)
    return jax.tree.map(of, first, rows, last)


def _reached(path: Path, anchors: Array) -> Array:
    """Whether the last row was."""
    clock = path.clock
    return clock.time(clock.last, anchors) >= clock.times.saves[-1]


def _turn_of_row(record: Record, r: Array) -> Array:
    """The turn of row r between the first and the last; none beyond these."""
    assert record.row_turn is not None
    return jnp.where(r < 0, -1, _at(record.row_turn, r))


def forwards(path: Path, change: Change, points: bool) -> Walk:
    """The derivative in one direction."""
    clock, record = path.clock, path.clock.record
    anchors, dues = clock.times.anchors(), clock.times.dues()
    dues_dot = None
    if change.saves is not None:
        dues_dot = jnp.concatenate([change.saves[1:-1], jnp.zeros_like(change.saves[:1])])
    start = path.start
    dy0 = jax.tree.map(jnp.zeros_like, start) if change.y0 is None else (change.y0, None)
    count = 0 if record.points is None else jax.tree.leaves(record.points)[0].shape[0]
    zero = jnp.zeros((), jnp.int32)
    rows = None if record.row_turn is None else _zeros(start, record.row_turn.shape[0])
    begin = (zero, zero, start, dy0, rows, _zeros(start, count) if points else None)

    def turn(carry: tuple) -> tuple:
        k, r, y, dy, rows, kept = carry
        t, end, jump = clock.time(k - 1, anchors), clock.time(k, anchors), clock.jump(k)
        use, to_row = (k < record.turns) & (end > t), jnp.array(False)
        if points:
            slot = jnp.where(k % record.stride == 0, k // record.stride, count - 1)
            kept = _put(kept, slot, dy)
        end_dot = None if change.anchors is None else change.anchors[clock.anchor(k)]
        if rows is not None:
            here = _turn_of_row(record, r) == k
            to_row = eqxi.unvmap_any(here)
            end = jnp.where(here, dues[r], end)
            if dues_dot is not None and end_dot is not None:
                end_dot = jnp.where(here, dues_dot[r], end_dot)
        if end_dot is None:
            step = lambda y, moved: path.ahead(path.with_args(moved), t, end, jump, y)  # noqa: E731
            y1, dy1 = jax.jvp(step, (y, path.moved()), (dy, change.args))
        else:
            assert change.anchors is not None
            step = lambda y, moved, t, end: path.ahead(  # noqa: E731
                path.with_args(moved), t, end, jump, y
            )
            moves = change.anchors[clock.anchor(k - 1)], end_dot
            y1, dy1 = jax.jvp(step, (y, path.moved(), t, end), (dy, change.args, *moves))
        if rows is not None:
            assert record.row_turn is not None
            rows = _put(rows, jnp.where(here, r, record.row_turn.shape[0] - 1), dy1)
            r = r + here.astype(jnp.int32)
        y, dy = _pick(use & ~to_row, (y1, dy1), (y, dy))
        return k + (~to_row).astype(jnp.int32), r, y, dy, rows, kept

    def goes_on(carry: tuple) -> Array:
        return eqxi.unvmap_any(carry[0] < record.turns)

    loop = partial(jax.lax.while_loop, goes_on, turn)
    _, _, _, dy, rows, kept = _xla.native(loop, begin, stages=path.stages)
    time = jnp.zeros_like(clock.times.stop)
    if change.anchors is not None:
        time = change.anchors[clock.anchor(clock.last)]
    return Walk(dy, time, _joined(dy0, rows, dy, _reached(path, anchors)), kept)


def backwards(path: Path, change: Change, wanted: Walk) -> Change:
    """The transposed map.

    Args:
        path: the motion.
        change: which parts of `Change` there are.
        wanted: cotangents.
    """
    clock, record = path.clock, path.clock.record
    anchors, dues = clock.times.anchors(), clock.times.dues()
    assert record.points is not None
    between = None if record.row_turn is None else jax.tree.map(lambda x: x[1:-1], wanted.rows)
    moves = change.anchors is not None
    zero = jnp.zeros((), jnp.int32)
    reached = _reached(path, anchors)
    end_bar = jax.tree.map(lambda x: jnp.where(reached, x[-1], 0.0), wanted.rows)
    bars = (
        [jnp.zeros_like(x) for x in path.moved()],
        jnp.zeros_like(anchors).at[clock.anchor(clock.last)].add(wanted.time) if moves else None,
        jnp.zeros_like(dues) if moves else None,
    )

    def row_here(k: Array, fresh: Array, r: Array) -> Array:
        """Whether a row that is left, r - 1, is reached from the state before turn k."""
        if between is None:
            return jnp.array(False)
        return ~fresh & (_turn_of_row(record, r - 1) == k)

    def turn(state_before: Callable, carry: tuple) -> tuple:
        """From the cotangent of the state after turn k - 1 to that of the state before it.

        `fresh` says that turn k has not been gone back yet, which it is not for the first one.
        """
        k, r, bar, (args_bar, anchors_bar, dues_bar) = carry
        here = row_here(k, jnp.array(False), r)
        to_row = eqxi.unvmap_any(here)
        k = jnp.where(to_row, k, k - 1)
        y = state_before(k)
        t, end, jump = clock.time(k - 1, anchors), clock.time(k, anchors), clock.jump(k)
        use = (k < record.turns) & (end > t)
        given = bar
        if between is not None:
            use = jnp.where(to_row, here, use)
            end = jnp.where(here, dues[r - 1], end)
            given = _pick(to_row, _at(between, r - 1), bar)
        with_moved, moved, starts = path.local(t)
        if not moves:
            step = lambda y, moved: path.ahead(with_moved(moved), t, end, jump, y)  # noqa: E731
            before, more = jax.vjp(step, y, moved)[1](given)
        else:
            step = lambda y, moved, t, end: path.ahead(  # noqa: E731
                with_moved(moved), t, end, jump, y
            )
            before, more, t_bar, end_bar = jax.vjp(step, y, moved, t, end)[1](given)
            t_bar, end_bar = (jnp.where(use, x, 0.0) for x in (t_bar, end_bar))
            at_row = jnp.where(here, end_bar, 0.0)
            anchors_bar = anchors_bar.at[clock.anchor(k - 1)].add(t_bar)
            anchors_bar = anchors_bar.at[clock.anchor(k)].add(end_bar - at_row)
            if between is not None:
                dues_bar = dues_bar.at[r - 1].add(at_row)
        more = [jnp.where(use, x, 0.0) for x in more]
        args_bar = [_added(*pair) for pair in zip(args_bar, more, starts, strict=True)]
        if between is None:
            bar = _pick(use, before, bar)
        else:
            summed = _add(bar, before)
            bar = _pick(use, _pick(to_row, summed, before), bar)
            r = r - here.astype(jnp.int32)
        if wanted.points is not None:
            at_point = ~to_row & (k % record.stride == 0) & (k < record.turns)
            bar = _pick(at_point, _add(bar, _at(wanted.points, k // record.stride)), bar)
        return k, r, bar, (args_bar, anchors_bar, dues_bar)

    def back(first: Array, state_before: Callable, carry: tuple) -> tuple:
        """All turns after the first, that one and its rows."""

        def left(carry: tuple) -> Array:
            k, r, *_ = carry
            return (k > first) | eqxi.unvmap_any(row_here(k, jnp.array(False), r))

        return jax.lax.while_loop(left, partial(turn, state_before), carry)

    # Lanes that were recorded together have one stride; all have points at those of the longest.
    stride = eqxi.unvmap_max(record.stride)
    room = jax.tree.leaves(record.points)[0].shape[0] - 1
    longest = 2 ** ceil(log2(record.offsets.shape[0] / room))

    def segment(carry: tuple) -> tuple:
        """All turns since the last point before turn k."""
        k = carry[0]
        first = (k - 1) // stride * stride
        y = _at(record.points, first // record.stride)
        states = _put(_zeros(y, longest), zero, y)

        def ahead(carry: tuple) -> tuple:
            j, y, states = carry
            t, end = clock.time(j - 1, anchors), clock.time(j, anchors)
            use = (j < record.turns) & (end > t)
            y = _pick(use, path.found(t, end, clock.jump(j), y), y)
            return j + 1, y, _put(states, j + 1 - first, y)

        begin = (first, y, states)
        states = jax.lax.while_loop(lambda c: c[0] < k - 1, ahead, begin)[2]
        return back(first, lambda j: _at(states, j - first), carry)

    def all_back(carry: tuple) -> tuple:
        if longest == 1:
            return back(zero, partial(_at, record.points), carry)
        return jax.lax.while_loop(lambda c: c[0] > 0, segment, carry)

    most = eqxi.unvmap_max(record.turns)  # shared by lanes
    rows_left = zero
    if record.row_turn is not None:
        rows_left = jnp.sum(record.row_turn < record.turns, dtype=jnp.int32)
    begin = (most, rows_left, _add(wanted.last, end_bar), bars)
    ended = _xla.native(all_back, begin, stages=path.stages)
    _, _, bar, (args_bar, anchors_bar, dues_bar) = ended
    bar = _add(bar, jax.tree.map(lambda x: x[0], wanted.rows))
    saves_bar = None
    if moves:
        ends = jnp.zeros_like(clock.times.saves[:1])
        saves_bar = jnp.concatenate([ends, dues_bar[:-1], ends])
    return Change(None if change.y0 is None else bar[0], args_bar, anchors_bar, saves_bar)


def _added(bar: Array, more: Array, start: Array | None) -> Array:
    """The cotangent of a leaf with more of it, of two rows of a table at their place."""
    if start is None:
        return bar + more
    rows = jax.lax.dynamic_slice_in_dim(bar, start, more.shape[0])
    return jax.lax.dynamic_update_slice_in_dim(bar, rows + more, start, 0)


class _Slots(NamedTuple):
    """Steps and rows in one sequence, a row before the step that it lies in."""

    begins: Array
    ends: Array
    used: Array
    to_row: Array
    jumps: Array | None


def _slots(path: Path, anchors: Array, saves: Array) -> tuple[_Slots, Array, Array | None]:
    """The sequence, and the places of turns and of rows in it."""
    clock, record = path.clock, path.clock.record
    index = jnp.arange(record.offsets.shape[0], dtype=jnp.int32)
    ends = jax.vmap(lambda k: clock.time(k, anchors))(index)
    begins = jnp.concatenate([anchors[:1], ends[:-1]])
    used = (index < record.turns) & (ends > begins)
    if record.row_turn is None:
        still = jnp.zeros_like(used)
        return _Slots(begins, ends, used, still, record.jumps), index, None
    turn = record.row_turn[:-1]
    count = turn.shape[0]
    reached = turn < record.turns
    before = jnp.searchsorted(turn, index, side="right").astype(jnp.int32)
    of_turn = index + before
    of_row = jnp.where(reached, turn + jnp.arange(count, dtype=jnp.int32), 0)
    size = -(-(index.shape[0] + count) // CHUNK) * CHUNK

    def merged(steps: Array, rows: Array) -> Array:
        place = jnp.where(reached, of_row, size)
        out = jnp.zeros((size,), steps.dtype).at[of_turn].set(steps)
        return out.at[place].set(rows, mode="drop")

    safe = jnp.where(reached, turn, 0)
    slots = _Slots(
        merged(begins, begins[safe]),
        merged(ends, saves[1:-1]),
        merged(used, reached),
        merged(jnp.zeros_like(used), reached),
        None if record.jumps is None else merged(record.jumps, record.jumps[safe]),
    )
    return slots, of_turn, of_row


def again(
    path: Path,
    start: PyTree,
    moved: Sequence[Array],
    anchors: Array,
    saves: Array,
    points: bool,
) -> Walk:
    """The motion itself by a scan, which JAX differentiates in any mode and to any order.

    The scan skips whole chunks that no lane of a vmapped solve needs. Turns that are not wanted
    repeat the first step and drop its result, so that no derivative meets a state out of reach.
    """
    clock, record = path.clock, path.clock.record
    slots, of_turn, of_row = _slots(path, anchors, saves)
    first = jnp.argmax(slots.used)
    begins = jnp.where(slots.used, slots.begins, slots.begins[first])
    ends = jnp.where(slots.used, slots.ends, slots.ends[first])
    slots = slots._replace(begins=begins, ends=ends)

    @partial(jax.checkpoint, prevent_cse=False)
    def step(t: Array, end: Array, y: PyTree, jump: Array | None) -> PyTree:
        return path.ahead(path.with_args(moved), t, end, jump, y)

    def one(y: PyTree, slot: _Slots) -> tuple[PyTree, tuple[PyTree, PyTree]]:
        new = step(slot.begins, slot.ends, _pick(slot.used, y, start), slot.jumps)
        return _pick(slot.used & ~slot.to_row, new, y), (y, new)

    def chunk(y: PyTree, slots: _Slots) -> tuple[PyTree, PyTree]:
        def skip(y: PyTree) -> tuple[PyTree, PyTree]:
            same = jax.tree.map(lambda x: jnp.broadcast_to(x, (CHUNK, *x.shape)), y)
            return y, (same, same)

        def take(y: PyTree) -> tuple[PyTree, PyTree]:
            return jax.lax.scan(one, y, slots)

        return jax.lax.cond(eqxi.unvmap_any(slots.used), take, skip, y)

    parts = jax.tree.map(lambda x: x.reshape(-1, CHUNK), slots)
    last, found = _xla.native(partial(jax.lax.scan, chunk), start, parts, stages=path.stages)
    befores, afters = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), found)
    rows = point_states = None
    if of_row is not None:
        assert record.row_turn is not None
        reached = record.row_turn[:-1] < record.turns

        def gathered(x: Array) -> Array:
            wide = reached.reshape(reached.shape + (1,) * (x.ndim - 1))
            found = jnp.where(wide, x[of_row], 0.0)
            return jnp.concatenate([found, jnp.zeros_like(x[:1])])

        rows = jax.tree.map(gathered, afters)
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
    return Walk(last, time, _joined(start, rows, last, _reached(path, anchors)), point_states)
