"""Along a recorded motion again: its variational equations, forwards and backwards.

The derivative of a solve is that of its steps y_k+1 = S(y_k, args, t_k, t_k+1) at the recorded
times,

    dy_k+1 = dS/dy dy_k + dS/dargs dargs + dS/dt_k dt_k + dS/dt_k+1 dt_k+1,

a linear map from (dy_0, dargs, danchors) to what is wanted of dy_0, dy_1, .... Forwards dy is
carried beside y. Backwards the transposed steps are taken from the last to the first, at the
recorded points, or at states found anew from them where points are further apart than a step.
Neither depends on the step-size control, whose error estimates round differently in another
program.

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
from jaxlag._drive import CHUNK, Record, Times
from jaxlag._lowering import elements


class Walk(NamedTuple):
    """What is wanted of a motion or of its derivative.

    Attributes:
        last: state after the last step.
        rows: states from which one more step reaches row i; None where nobody asks.
        points: states at the points of the record; None where nobody asks.
    """

    last: PyTree
    rows: PyTree | None
    points: PyTree | None


class Change(NamedTuple):
    """A direction of what a motion depends on; None for what does not move.

    Attributes:
        y0: of the start, an array.
        args: of some leaves of the arguments.
        anchors: of `Times.anchors`.
    """

    y0: Array | None
    args: list[Array]
    anchors: Array | None


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


class Path(NamedTuple):
    """A recorded motion: what was given to the loop and what it kept.

    Attributes:
        step: (args, t0, t1, state, jump) -> state.
        between: the same in a form that takes less to compile.
        start: the state before the first step, as the step takes it.
        args: leaves of the arguments.
        tree: of the arguments.
        moving: indices of the leaves that may move.
        clock: times of the steps.
        stages: number of them in a step, 0 where it has none.
    """

    step: Callable
    between: Callable
    start: PyTree
    args: list
    tree: Any
    moving: tuple[int, ...]
    clock: Clock
    stages: int

    def with_args(self, moved: Sequence[Array]) -> Any:
        """The arguments with other values of the leaves that may move."""
        leaves = list(self.args)
        for i, leaf in zip(self.moving, moved, strict=True):
            leaves[i] = leaf
        return jax.tree.unflatten(self.tree, leaves)

    def ahead(
        self, t: Array, end: Array, jump: Array | None, state: PyTree, moved: Sequence[Array]
    ) -> PyTree:
        """The state one step on."""
        jump = jnp.array(False) if jump is None else jump
        return self.step(self.with_args(moved), t, end, state, jump)

    def found(self, t: Array, end: Array, jump: Array | None, state: PyTree) -> PyTree:
        """The same between points."""
        jump = jnp.array(False) if jump is None else jump
        return self.between(self.with_args(self.moved()), t, end, state, jump)

    def moved(self) -> list[Array]:
        """The leaves of the arguments that may move."""
        return [self.args[i] for i in self.moving]


def _at(buffer: PyTree, k: Array) -> PyTree:
    index = partial(jax.lax.dynamic_index_in_dim, index=jnp.maximum(k, 0), keepdims=False)
    return jax.tree.map(index, buffer)


def _pick(use: Array, new: PyTree, old: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(use, a, b), new, old)


def _add(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.add, a, b)


def _start(path: Path, change: Change) -> PyTree:
    """dy_0 in the form of a state."""
    if change.y0 is None:
        return jax.tree.map(jnp.zeros_like, path.start)
    return state_like(path.start, change.y0)


def state_like(state: PyTree, y: Array) -> PyTree:
    """An array in the form of a state without memory."""
    return (tuple(elements(y)) if isinstance(state[0], tuple) else y, None)


class _Groups(NamedTuple):
    """Rows that start at one turn, together."""

    of: Array  # the group of each row
    turn: Array  # of each group; -1 where there is none


def _groups(row_turn: Array) -> _Groups:
    new = jnp.concatenate([jnp.zeros((1,), bool), row_turn[1:] != row_turn[:-1]])
    of = jnp.cumsum(new.astype(jnp.int32))
    return _Groups(of, jnp.full(row_turn.shape, -1, jnp.int32).at[of].set(row_turn))


def forwards(path: Path, change: Change, points: bool) -> Walk:
    """The derivative in one direction."""
    clock, record = path.clock, path.clock.record
    anchors = clock.times.anchors()
    groups = None if record.row_turn is None else _groups(record.row_turn)

    def field(size: int) -> PyTree:
        return jax.tree.map(lambda x: jnp.zeros((size, *x.shape), x.dtype), path.start)

    count = 0 if record.points is None else jax.tree.leaves(record.points)[0].shape[0]
    kept = (
        None if groups is None else field(groups.turn.shape[0] + 1),
        field(count) if points else None,
    )
    zero = jnp.zeros((), jnp.int32)
    begin = (zero, path.start, _start(path, change), zero, kept)

    def keep(k: Array, p: Array, dy: PyTree, kept: tuple) -> tuple:
        rows, points = kept
        if groups is not None:
            hit = groups.turn[jnp.minimum(p, groups.turn.shape[0] - 1)] == k
            slot = jnp.where(hit, p, groups.turn.shape[0])
            rows = jax.tree.map(lambda b, x: b.at[slot].set(x), rows, dy)
            p = p + hit.astype(jnp.int32)
        if points is not None:
            slot = jnp.where(k % record.stride == 0, k // record.stride, count - 1)
            put = partial(jax.lax.dynamic_update_index_in_dim, index=slot, axis=0)
            points = jax.tree.map(put, points, dy)
        return p, (rows, points)

    def turn(carry: tuple) -> tuple:
        k, y, dy, p, kept = carry
        p, kept = keep(k, p, dy, kept)
        t, end, jump = clock.time(k - 1, anchors), clock.time(k, anchors), clock.jump(k)
        use = (k < record.turns) & (end > t)
        if change.anchors is None:
            step = lambda y, args: path.ahead(t, end, jump, y, args)  # noqa: E731
            y1, dy1 = jax.jvp(step, (y, path.moved()), (dy, change.args))
        else:
            step = lambda y, args, t, end: path.ahead(t, end, jump, y, args)  # noqa: E731
            moves = change.anchors[clock.anchor(k - 1)], change.anchors[clock.anchor(k)]
            y1, dy1 = jax.jvp(step, (y, path.moved(), t, end), (dy, change.args, *moves))
        y, dy = _pick(use, (y1, dy1), (y, dy))
        return k + 1, y, dy, p, kept

    def goes_on(carry: tuple) -> Array:
        return eqxi.unvmap_any(carry[0] < record.turns)

    loop = partial(jax.lax.while_loop, goes_on, turn)
    _, _, dy, _, kept = _xla.native(loop, begin, stages=path.stages)
    rows_dot = None
    if groups is not None:
        rows_dot = jax.tree.map(lambda x: x[groups.of], kept[0])
    return Walk(dy, rows_dot, kept[1])


def backwards(path: Path, change: Change, wanted: Walk) -> Change:
    """The transposed map.

    Args:
        path: the motion.
        change: which parts of `Change` there are.
        wanted: cotangents.
    """
    clock, record = path.clock, path.clock.record
    anchors = clock.times.anchors()
    assert record.points is not None
    groups, row_bars = None, ()
    if wanted.rows is not None:
        assert record.row_turn is not None
        groups = _groups(record.row_turn)
        size = groups.turn.shape[0]

        def gathered(ct: Array) -> Array:
            return jnp.zeros((size, *ct.shape[1:]), ct.dtype).at[groups.of].add(ct)

        row_bars = jax.tree.map(gathered, wanted.rows)
    zero = jnp.zeros((), jnp.int32)
    bars = (
        [jnp.zeros_like(x) for x in path.moved()],
        None if change.anchors is None else jnp.zeros_like(change.anchors),
    )

    def turn(k: Array, y: PyTree, carry: tuple) -> tuple:
        """From the cotangent of the state after turn k to that of the state before it."""
        bar, p, (args_bar, anchors_bar) = carry
        t, end, jump = clock.time(k - 1, anchors), clock.time(k, anchors), clock.jump(k)
        use = (k < record.turns) & (end > t)
        if anchors_bar is None:
            step = lambda y, args: path.ahead(t, end, jump, y, args)  # noqa: E731
            before, args_more = jax.vjp(step, y, path.moved())[1](bar)
        else:
            step = lambda y, args, t, end: path.ahead(t, end, jump, y, args)  # noqa: E731
            pullback = jax.vjp(step, y, path.moved(), t, end)[1]
            before, args_more, t_bar, end_bar = pullback(bar)
            moved = anchors_bar.at[clock.anchor(k - 1)].add(t_bar)
            moved = moved.at[clock.anchor(k)].add(end_bar)
            anchors_bar = jnp.where(use, moved, anchors_bar)
        bar = _pick(use, before, bar)
        args_bar = _pick(use, _add(args_bar, args_more), args_bar)
        if groups is not None:
            hit = (p > 0) & (groups.turn[p] == k)
            bar = _pick(hit, _add(bar, _at(row_bars, p)), bar)
            p = p - hit.astype(jnp.int32)
        if wanted.points is not None:
            at_point = (k % record.stride == 0) & (k < record.turns)
            bar = _pick(at_point, _add(bar, _at(wanted.points, k // record.stride)), bar)
        return bar, p, (args_bar, anchors_bar)

    # Lanes that were recorded together have one stride; all have points at those of the longest.
    stride = eqxi.unvmap_max(record.stride)

    def single(carry: tuple) -> tuple:
        k, inner = carry
        return k - 1, turn(k, _at(record.points, k), inner)

    room = jax.tree.leaves(record.points)[0].shape[0] - 1
    longest = 2 ** ceil(log2(record.offsets.shape[0] / room))

    def segment(carry: tuple) -> tuple:
        """All turns since the last point before turn k."""
        k, inner = carry
        first = k // stride * stride
        y = _at(record.points, first // record.stride)
        states = jax.tree.map(lambda x: jnp.zeros((longest, *x.shape), x.dtype).at[0].set(x), y)

        def ahead(carry: tuple) -> tuple:
            j, y, states = carry
            t, end = clock.time(j - 1, anchors), clock.time(j, anchors)
            use = (j < record.turns) & (end > t)
            y = _pick(use, path.found(t, end, clock.jump(j), y), y)
            put = partial(jax.lax.dynamic_update_index_in_dim, index=j + 1 - first, axis=0)
            return j + 1, y, jax.tree.map(put, states, y)

        begin = (first, y, states)
        states = jax.lax.while_loop(lambda c: eqxi.unvmap_any(c[0] < k), ahead, begin)[2]

        def back(carry: tuple) -> tuple:
            j, inner = carry
            return j - 1, turn(j, _at(states, j - first), inner)

        return jax.lax.while_loop(lambda c: eqxi.unvmap_any(c[0] >= first), back, (k, inner))

    most = eqxi.unvmap_max(record.turns)  # shared by lanes
    last = zero if groups is None else groups.of[-1]
    begin = (most - 1, (wanted.last, last, bars))
    body = single if longest == 1 else segment

    def left(carry: tuple) -> Array:
        return eqxi.unvmap_any(carry[0] >= 0)

    ended = _xla.native(partial(jax.lax.while_loop, left, body), begin, stages=path.stages)
    bar, _, (args_bar, anchors_bar) = ended[1]
    if groups is not None:
        bar = _add(bar, _at(row_bars, zero))
    y0_bar = None
    if change.y0 is not None:
        y0_bar = jnp.stack(bar[0]) if isinstance(bar[0], tuple) else bar[0]
    return Change(y0_bar, args_bar, anchors_bar)


def again(path: Path, start: PyTree, moved: Sequence[Array], anchors: Array, points: bool) -> Walk:
    """The motion itself by a scan, which JAX differentiates in any mode and to any order.

    The scan skips whole chunks that no lane of a vmapped solve needs. Turns that are not wanted
    repeat the first step and drop its result, so that no derivative meets a state out of reach.
    """
    clock, record = path.clock, path.clock.record
    index = jnp.arange(record.offsets.shape[0], dtype=jnp.int32)
    ends = jax.vmap(lambda k: clock.time(k, anchors))(index)
    begins = jnp.concatenate([anchors[:1], ends[:-1]])
    used = (index < record.turns) & (ends > begins)
    first = jnp.argmax(used)
    begins, ends = jnp.where(used, begins, begins[first]), jnp.where(used, ends, ends[first])

    @partial(jax.checkpoint, prevent_cse=False)
    def step(t: Array, end: Array, y: PyTree, jump: Array | None) -> PyTree:
        return path.ahead(t, end, jump, y, moved)

    def one(y: PyTree, slot: tuple) -> tuple[PyTree, PyTree]:
        t, end, use, jump = slot
        new = _pick(use, step(t, end, _pick(use, y, start), jump), y)
        return new, y

    def chunk(y: PyTree, slots: Any) -> tuple[PyTree, PyTree]:
        def skip(y: PyTree) -> tuple[PyTree, PyTree]:
            return y, jax.tree.map(lambda x: jnp.broadcast_to(x, (CHUNK, *x.shape)), y)

        def take(y: PyTree) -> tuple[PyTree, PyTree]:
            return jax.lax.scan(one, y, slots)

        return jax.lax.cond(eqxi.unvmap_any(slots[2]), take, skip, y)

    slots = jax.tree.map(lambda x: x.reshape(-1, CHUNK), (begins, ends, used, record.jumps))
    last, history = _xla.native(partial(jax.lax.scan, chunk), start, slots, stages=path.stages)
    history = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), history)
    row_states = point_states = None
    if record.row_turn is not None:
        row_states = jax.tree.map(lambda x: x[record.row_turn], history)
    if points:
        count = jax.tree.leaves(record.points)[0].shape[0]
        at = jnp.arange(count, dtype=jnp.int32) * record.stride
        inside = (at < record.turns) & (at // record.stride < count - 1)
        at = jnp.where(inside, at, 0)

        def gathered(x: Array) -> Array:
            wide = inside.reshape(inside.shape + (1,) * (x.ndim - 1))
            return jnp.where(wide, x[at], 0.0)

        point_states = jax.tree.map(gathered, history)
    return Walk(last, row_states, point_states)
