"""The one loop: steps, step-size control, landing on knots, rows to save, record, status.

Integration runs forwards in a time tau = sigma t, sigma = +1 or -1, so that nothing here knows
about direction. Time, step, acceptance and status are elementwise and may carry a trailing lane
shape that the state's leaves end in as well; a finished lane keeps its values while others go on.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxlag._scheme import Scheme, resolution
from jaxlag._status import Status

# The record is a whole number of chunks of this many turns.
CHUNK = 64


class Times(NamedTuple):
    """What the grid of steps is anchored to, in tau.

    `stop` is where integration ends: the last save time, or the end of an input's table before
    it. `knots` are sorted.
    """

    start: Float[Array, "..."]
    stop: Float[Array, "..."]
    knots: Float[Array, " k"] | None
    saves: Float[Array, "s ..."]

    def anchors(self) -> Float[Array, "a ..."]:
        """Start, stop and knots in one row; `Grid.anchor` indexes it."""
        ends = jnp.stack([self.start, self.stop])
        return ends if self.knots is None else jnp.concatenate([ends, self.knots])


class Record(NamedTuple):
    """What a loop did, turn by turn: enough to go the same way again without step-size control.

    Lanes share turns; a turn that takes a lane nowhere is one whose end is that of the last.

    Attributes:
        offsets: time after every turn, from its anchor, with which it moves.
        anchors: which of `Times.anchors` that is. None without knots: the start, or where the
            offset is infinite the stop, at which the turn ends.
        jumps: whether the vector field jumps where the turn starts; None where it never does.
        points: states before turn 0, `stride`, 2 `stride`, ...; None where nobody needs them.
        stride: a power of 2.
        turns: how many there were.
        row_turn: row i is reached from the state before this turn; None where there are no rows
            between the first and the last.
    """

    offsets: Float[Array, " N"]
    anchors: Int[Array, " N"] | None
    jumps: Bool[Array, " N"] | None
    points: PyTree | None
    stride: Int[Array, ""]
    turns: Int[Array, ""]
    row_turn: Int[Array, " s"] | None


class Outcome(NamedTuple):
    """Where a drive ended, and for each row the state from which one more step reaches it."""

    status: Int[Array, "..."]
    time: Float[Array, "..."]
    state: PyTree
    tried: Float[Array, "..."]  # end of the last attempted step
    accepted: Int[Array, "..."]
    attempted: Int[Array, "..."]
    row_time: Float[Array, "s ..."] | None
    row_state: PyTree | None  # (y, solver memory where the solver remembers)
    reached: Bool[Array, "s ..."]  # rows that were reached
    inside: Bool[Array, "s ..."]  # rows that take one more step to reach
    record: Record | None
    gradient: Int[Array, "..."]  # a GradientMode


class _Carry(NamedTuple):
    t: Array
    y: PyTree
    h: Array
    memory: Any  # the solver's own state
    control_state: Any
    jump: Array | None  # None where nothing ever jumps
    mark: Array  # number of marks of the fixed grid passed
    anchor: Array
    status: Array
    done: Array
    tried: Array
    accepted: Array
    attempted: Array
    rows: Array  # number of rows passed
    row_time: Array | None
    row_state: PyTree | None
    row_turn: Array | None
    turn: Array  # shared by all lanes
    offsets: Array | None
    anchors: Array | None
    jumps: Array | None
    points: PyTree | None
    stride: Array


def _select(pick: Array, new: PyTree, old: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(pick, a, b) if eqx.is_array_like(a) else a, new, old)


def _all_finite(y: PyTree, lanes: int) -> Array:
    def finite(leaf: Array) -> Array:
        return jnp.all(jnp.isfinite(leaf), axis=tuple(range(leaf.ndim - lanes)))

    flags = [finite(leaf) for leaf in jax.tree.leaves(y)]
    return jnp.all(jnp.stack(flags), axis=0)


def _write(buffer: PyTree, index: Array, row: PyTree) -> PyTree:
    """buffer[index] = row in every lane; an index past the end writes nothing."""

    def write(b: Array, i: Array, r: Array) -> Array:
        return b.at[i].set(r.astype(b.dtype), mode="drop")

    def write_leaf(b: Array, r: Array) -> Array:
        if index.ndim == 0:
            return write(b, index, r)
        return jax.vmap(write, in_axes=-1, out_axes=-1)(b, index, r)

    return jax.tree.map(write_leaf, buffer, row)


def _whole(scheme: Scheme, y: PyTree, memory: Any) -> PyTree:
    """All that the next step depends on."""
    return (y, memory if scheme.remembers else None)


def _buffer(size: int, like: PyTree, fill: float | int) -> PyTree:
    return jax.tree.map(lambda x: jnp.full((size, *jnp.shape(x)), fill, jnp.result_type(x)), like)


def drive(
    scheme: Scheme,
    y0: PyTree,
    args: Any,
    times: Times,
    first_step: Array | None,
    allowed: Bool[Array, "..."],
    max_steps: int,
    record: bool,
    room: int = 0,
    native: Callable | None = None,
    shared: bool = True,
) -> Outcome:
    """Integrate from `times.start` to `times.stop`.

    Args:
        scheme: solver, controller, vector field.
        y0: state at the start.
        args: passed to the vector field, after `scheme.intervals`.
        times: anchors and save times, in tau.
        first_step: the fixed step without a controller; else the first step, None for automatic.
        allowed: False where the trajectory must not start (status set by the caller).
        max_steps: bound on attempted steps.
        record: whether to keep what is needed to go the same way again.
        room: for so many states on the way, an even number. When it is full every other one is
            dropped, and from then on half as many are kept.
        native: what calls the loop, with its start.
        shared: whether this is going to be vmapped, so that a record has one row for each attempt
            of any lane; else one for each accepted step.
    """
    t0 = times.start
    if times.saves.ndim == 1:  # shared by all lanes
        saves = times.saves.reshape((-1,) + (1,) * t0.ndim)
        times = times._replace(saves=jnp.broadcast_to(saves, times.saves.shape + t0.shape))
    count = times.saves.shape[0]
    keep_rows = count > 2
    size = -(-max_steps // CHUNK) * CHUNK
    room = (room if room < size else size) if record and not scheme.remembers else 0
    memory = scheme.begin(t0, times.stop, y0, args)
    if scheme.controller is not None:
        h, control_state = scheme.first_step(t0, times.stop, y0, args, first_step)
        # The estimate is 0/0 where atol = 0 meets a component that is 0.
        h = jnp.where(jnp.isfinite(h) & (h > 0), h, 1e-6 * (times.stop - t0))
        h = h if scheme.longest is None else jnp.minimum(h, scheme.longest)
    else:
        assert first_step is not None
        h, control_state = first_step, None
    memory = jax.tree.map(lambda x: jnp.broadcast_to(x, jnp.shape(x) or t0.shape), memory)
    whole = _whole(scheme, y0, memory)
    zero = jnp.zeros(t0.shape, jnp.int32)
    ok = zero + int(Status.ok)
    carry = _Carry(
        t=t0,
        y=y0,
        h=jnp.asarray(h, t0.dtype) + jnp.zeros_like(t0),
        memory=memory,
        control_state=control_state,
        jump=jnp.zeros(t0.shape, bool) if _jumps(scheme, times) else None,
        mark=zero,
        anchor=zero,
        status=ok,
        done=~allowed | (times.stop <= t0),
        tried=t0,
        accepted=zero,
        attempted=zero,
        rows=zero + 1,
        row_time=_write(_buffer(count, t0, jnp.nan), zero, t0) if keep_rows else None,
        row_state=_write(_buffer(count, whole, 0.0), zero, whole) if keep_rows else None,
        row_turn=_buffer(count, zero, 0) if keep_rows and record else None,
        turn=jnp.zeros((), jnp.int32),
        offsets=_buffer(size, t0, 0.0) if record else None,
        anchors=_buffer(size, zero, 0) if record and times.knots is not None else None,
        jumps=_buffer(size, zero > 0, 0) if record and _jumps(scheme, times) else None,
        # One more for what is not kept.
        points=_buffer(room + 1, (y0, None), 0.0) if room else None,
        stride=jnp.ones((), jnp.int32),
    )
    carry = jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_array_like(x) else x, carry)
    dynamic, static = eqx.partition(carry, eqx.is_array)

    def turn(dynamic: Any) -> Any:
        c = _turn(scheme, args, times, h, max_steps, shared, eqx.combine(dynamic, static))
        return eqx.partition(c, eqx.is_array)[0]

    def goes_on(c: Any) -> Array:
        return eqxi.unvmap_any(~c.done)

    def loop(dynamic: Any) -> Any:
        if room in (0, size):
            return jax.lax.while_loop(goes_on, turn, dynamic)
        until_full = lambda c: goes_on(c) & (c.turn < room * c.stride)  # noqa: E731
        fill = lambda c: jax.lax.while_loop(until_full, turn, c)  # noqa: E731
        return jax.lax.while_loop(goes_on, lambda c: fill(_thinned(c, room)), dynamic)

    final = loop(dynamic) if native is None else native(loop, dynamic)
    c: _Carry = eqx.combine(final, static)
    rows = _filled(c) if keep_rows else (None, None, None)
    reached = (times.saves <= c.t) & allowed
    reached = reached.at[0].set(True)
    inside = jnp.zeros_like(reached)
    if rows[0] is not None:
        inside = reached & (times.saves - rows[0] > resolution(times.saves))
    kept = None
    if record:
        assert c.offsets is not None
        turns = jnp.broadcast_to(c.turn, t0.shape)
        kept = Record(c.offsets, c.anchors, c.jumps, c.points, c.stride, turns, rows[2])
    ends = (c.status, c.t, c.y, c.tried, c.accepted, c.attempted)
    return Outcome(*ends, *rows[:2], reached, inside, kept, zero)


def _jumps(scheme: Scheme, times: Times) -> bool:
    """Whether the vector field may jump during the integration."""
    return times.knots is not None or not scheme.standard


def _thinned(c: Any, room: int) -> Any:
    """Every other point dropped, if they are full."""

    def halved(leaf: Array) -> Array:
        return leaf.at[: room // 2].set(leaf[:room:2])

    def thin(c: Any) -> Any:
        return c._replace(points=jax.tree.map(halved, c.points), stride=2 * c.stride)

    return jax.lax.cond(c.turn >= room * c.stride, thin, lambda c: c, c)


def _put(buffer: PyTree, index: Array, row: PyTree) -> PyTree:
    """buffer[index] = row in all lanes."""
    put = partial(jax.lax.dynamic_update_index_in_dim, index=index, axis=0)
    return jax.tree.map(lambda b, r: put(b, r.astype(b.dtype)), buffer, row)


def _turn(
    scheme: Scheme,
    args: Any,
    times: Times,
    dt: Array,
    max_steps: int,
    shared: bool,
    c: _Carry,
) -> _Carry:
    """One attempted step."""
    # Where the step would end, and whether it lands on a knot or on the stop instead.
    goal = times.start + (c.mark + 1).astype(c.t.dtype) * dt if scheme.controller is None else None
    goal = c.t + c.h if goal is None else goal
    boundary, boundary_anchor = _next_boundary(times, c.t)
    slack = jnp.maximum(1e-10 * (goal - c.t), resolution(boundary))
    lands = goal >= boundary - slack
    t1 = jnp.where(lands, boundary, goal)

    jumped = False if c.jump is None else c.jump
    y1, error, memory, solved = scheme.step(c.t, t1, c.y, args, c.memory, jumped)
    finite = _all_finite(y1, c.t.ndim)
    settled, verdict = scheme.settled(t1, y1, args)
    good = finite & solved & verdict.good
    if scheme.controller is None:
        keep, h, control_state, jump, stuck = good, c.h, None, jnp.zeros_like(good), ~good
    else:
        order: Any = scheme.solver.error_order(scheme.term)
        error = jax.tree.map(lambda e: jnp.where(good, e, jnp.inf), error)
        keep, next0, next1, jump, control_state, _ = scheme.controller.adapt_step_size(
            c.t, t1, c.y, y1, args, error, order, c.control_state
        )
        keep = keep & good
        h = jnp.asarray(next1 - next0, c.t.dtype)
        # A step cut short by a boundary says nothing against the length proposed before it.
        h = jnp.where(keep & lands, jnp.maximum(h, c.h), h)
        h = h if scheme.longest is None else jnp.minimum(h, scheme.longest)
        span = times.stop - times.start
        least = jnp.maximum(resolution(c.t), jnp.finfo(h.dtype).eps ** 2 * span)
        stuck = ~keep & ~(h > least)

    active = ~c.done
    take = active & keep
    t = jnp.where(take, t1, c.t)
    attempted = c.attempted + active.astype(jnp.int32)
    accepted = c.accepted + take.astype(jnp.int32)
    arrived = t >= times.stop
    y1 = settled
    failure = jnp.full(t.shape, int(Status.step_below_resolution))
    for sound, kind in (
        (verdict.pressed, Status.no_reaction_solution),
        (verdict.closed, Status.rank_change),
        (verdict.found, Status.projection_failed),
        (solved, Status.implicit_solve_failed),
        (finite, Status.nonfinite),
    ):
        failure = jnp.where(sound, failure, int(kind))
    exhausted = active & ~stuck & ~arrived & (attempted >= max_steps)
    status = jnp.where(active & stuck, failure, c.status)
    status = jnp.where(exhausted, int(Status.max_steps), status).astype(jnp.int32)

    row_time, row_state, row_turn, rows = c.row_time, c.row_state, c.row_turn, c.rows
    if row_time is not None:
        size = times.saves.shape[0]
        rows = jnp.where(take, jnp.sum(times.saves <= t, axis=0, dtype=jnp.int32), c.rows)
        # Rows inside this step continue from its start; a row at its end is the end itself.
        first = jnp.where(rows > c.rows, c.rows, size)
        last_save = jnp.take_along_axis(times.saves, rows[None] - 1, axis=0)[0]
        at_end = (rows > c.rows) & (t - last_save <= resolution(t))
        if row_turn is not None:
            # For derivatives the row must move with its own time, not with the end of the step.
            at_end = jnp.zeros_like(at_end)
        last = jnp.where(at_end, rows - 1, size)
        row_time = _write(_write(row_time, first, c.t), last, t)
        row_state = _write(row_state, first, _whole(scheme, c.y, c.memory))
        row_state = _write(row_state, last, _whole(scheme, y1, memory))
        if row_turn is not None:
            row_turn = _write(row_turn, first, c.turn + jnp.zeros_like(c.accepted))

    passed = t1 >= goal - slack
    own_anchor = jnp.zeros_like(c.anchor) if scheme.controller is None else c.anchor
    anchor = jnp.where(take, jnp.where(lands, boundary_anchor, own_anchor), c.anchor)
    offsets, anchors, jumps, points = c.offsets, c.anchors, c.jumps, c.points
    if offsets is not None:
        if anchors is None:
            offset = jnp.where(anchor == 1, jnp.inf, t - times.start)
        else:
            anchors = _put(anchors, c.turn, anchor)
            offset = t - times.anchors()[anchor]
        offsets = _put(offsets, c.turn, offset)
        jumps = None if jumps is None else _put(jumps, c.turn, c.jump)
    if points is not None:
        spare = jax.tree.leaves(points)[0].shape[0] - 1
        slot = jnp.where(c.turn % c.stride == 0, c.turn // c.stride, spare)
        points = _put(points, slot, (c.y, None))
    return _Carry(
        t=t,
        y=_select(take, y1, c.y),
        h=jnp.where(active, h, c.h),
        memory=_select(take, memory, c.memory),
        control_state=_select(active, control_state, c.control_state),
        jump=None if c.jump is None else jnp.where(take, jump | lands, c.jump),
        mark=c.mark + (take & passed).astype(jnp.int32),
        anchor=anchor,
        status=status,
        done=c.done | (active & (stuck | arrived | exhausted)),
        tried=jnp.where(active, t1, c.tried),
        accepted=accepted,
        attempted=attempted,
        rows=rows,
        row_time=row_time,
        row_state=row_state,
        row_turn=row_turn,
        turn=c.turn + 1 if shared else c.turn + take.astype(jnp.int32),
        offsets=offsets,
        anchors=anchors,
        jumps=jumps,
        points=points,
        stride=c.stride,
    )


def _next_boundary(times: Times, t: Array) -> tuple[Array, Array]:
    """The first knot after t or the stop, whichever comes first, and its index as an anchor."""
    stop_anchor = jnp.ones(t.shape, jnp.int32)
    if times.knots is None:
        return times.stop, stop_anchor
    size = times.knots.shape[0]
    after = jnp.searchsorted(times.knots, t, side="right").astype(jnp.int32)
    knot = times.knots[jnp.minimum(after, size - 1)]
    inside = (after < size) & (knot < times.stop)
    return jnp.where(inside, knot, times.stop), jnp.where(inside, 2 + after, stop_anchor)


def _filled(c: _Carry) -> tuple[Array, PyTree, Array | None]:
    """Row time, state and turn with every row not written taken from the last one written."""
    assert c.row_time is not None
    index = jnp.arange(c.row_time.shape[0], dtype=jnp.int32).reshape((-1,) + (1,) * c.t.ndim)
    source = jax.lax.cummax(jnp.where(jnp.isnan(c.row_time), 0, index), axis=0)

    def fill(leaf: Array) -> Array:
        wide = source.reshape(source.shape[:1] + (1,) * (leaf.ndim - source.ndim) + c.t.shape)
        return jnp.take_along_axis(leaf, wide, axis=0)

    return fill(c.row_time), jax.tree.map(fill, c.row_state), jax.tree.map(fill, c.row_turn)
