"""The one loop: steps, step-size control, landing on knots, rows to save, recorded grid, status.

Integration runs forwards in a time tau = sigma t, sigma = +1 or -1, so that nothing here knows
about direction. Time, step, acceptance and status are elementwise and may carry a trailing lane
shape that the state's leaves end in as well; a finished lane keeps its values while others go on.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxlag._status import Status
from jaxlag.solvers import AbstractUnrolled

# The recorded grid is a whole number of chunks of this many steps.
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


class Scheme(eqx.Module):
    """How one step is taken and the next one chosen; with no controller steps are fixed."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController | None
    term: diffrax.AbstractTerm
    intervals: Callable = eqx.field(static=True)  # (args, tau) -> args of a step around tau

    @property
    def remembers(self) -> bool:
        """Whether the solver's state is more than a function of (t, y), as in multistep methods."""
        return not isinstance(self.solver, diffrax.AbstractRungeKutta | AbstractUnrolled)

    def begin(self, t0: Array, t1: Array, y: PyTree, args: Any) -> Any:
        """Solver state with nothing carried over from a step before."""
        return self.solver.init(self.term, t0, t1, y, self.intervals(args, t0 + resolution(t0)))

    def step(
        self, t0: Array, t1: Array, y: PyTree, args: Any, memory: Any, jump: Any
    ) -> tuple[PyTree, PyTree, Any, Bool[Array, "..."]]:
        """(y1, error estimate or None, solver state, whether implicit equations were solved)."""
        args = self.intervals(args, t0 + 0.5 * (t1 - t0))
        y1, error, _, memory, result = self.solver.step(self.term, t0, t1, y, args, memory, jump)
        return y1, error, memory, result == diffrax.RESULTS.successful

    def first_step(
        self, t0: Array, t1: Array, y: PyTree, args: Any, guess: Array | None
    ) -> tuple[Array, Any]:
        """Length of the first adaptive step, and the controller's state."""
        assert self.controller is not None
        args = self.intervals(args, t0 + resolution(t0))
        order = self.solver.error_order(self.term)
        dtype = jnp.result_type(*jax.tree.leaves(y))
        if dtype == t0.dtype:
            end, state = self.controller.init(
                self.term, t0, t1, y, guess, args, self.solver.func, order
            )
            return jnp.asarray(end - t0), state

        # diffrax estimates a first step only where time and state share a dtype: count from t0.
        def func(term: Any, elapsed: Any, y: PyTree, args: Any) -> PyTree:
            return self.solver.func(term, t0 + jnp.asarray(elapsed, t0.dtype), y, args)

        guess = None if guess is None else guess.astype(dtype)
        zero = jnp.zeros_like(t0, dtype)
        span = (t1 - t0).astype(dtype)
        end, state = self.controller.init(self.term, zero, span, y, guess, args, func, order)
        return jnp.asarray(end, t0.dtype), state


def with_stages(solver: Any, kind: str) -> Any:
    """A Runge-Kutta solver, wrapped or not, with its loop over stages of the given kind.

    "lax" for solving, "bounded" (a scan, which every derivative passes) for replaying, where
    stages written out would be compiled many times over.
    """
    if isinstance(solver, diffrax.HalfSolver):
        return eqx.tree_at(lambda s: s.solver, solver, with_stages(solver.solver, kind))
    if isinstance(solver, AbstractUnrolled):
        return solver if kind == "lax" else with_stages(solver.stock, kind)
    if not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


class Grid(NamedTuple):
    """The accepted steps: step k ends `offset[k]` after anchor `anchor[k]`, and moves with it."""

    offset: Float[Array, " N"]
    anchor: Int[Array, " N"]
    jump: Bool[Array, " N"]  # whether step k starts where the vector field jumps
    row_step: Int[Array, " s"]  # row i is reached from the state after row_step[i] steps
    count: Int[Array, ""]


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
    grid: Grid | None


class _Carry(NamedTuple):
    t: Array
    y: PyTree
    h: Array
    memory: Any  # the solver's own state
    control_state: Any
    jump: Array
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
    row_step: Array | None
    ends: Array | None
    ends_anchor: Array | None
    jumps: Array | None


def resolution(t: Array) -> Array:
    """Below this a difference of times near t means nothing: 8 eps |t|."""
    return 8 * jnp.finfo(t.dtype).eps * jnp.abs(t)


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
        record: whether to keep the grid of accepted steps, for `replay`.
    """
    t0 = times.start
    if times.saves.ndim == 1:  # shared by all lanes
        saves = times.saves.reshape((-1,) + (1,) * t0.ndim)
        times = times._replace(saves=jnp.broadcast_to(saves, times.saves.shape + t0.shape))
    count = times.saves.shape[0]
    keep_rows = count > 2
    size = -(-max_steps // CHUNK) * CHUNK
    memory = scheme.begin(t0, times.stop, y0, args)
    if scheme.controller is not None:
        h, control_state = scheme.first_step(t0, times.stop, y0, args, first_step)
        # The estimate is 0/0 where atol = 0 meets a component that is 0.
        h = jnp.where(jnp.isfinite(h) & (h > 0), h, 1e-6 * (times.stop - t0))
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
        jump=jnp.zeros(t0.shape, bool),
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
        row_step=_buffer(count, zero, 0) if keep_rows and record else None,
        ends=_buffer(size, t0, 0.0) if record else None,
        ends_anchor=_buffer(size, zero, 0) if record else None,
        jumps=_buffer(size, zero > 0, 0) if record else None,
    )
    carry = jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_array_like(x) else x, carry)
    dynamic, static = eqx.partition(carry, eqx.is_array)

    def turn(dynamic: Any) -> Any:
        c = _turn(scheme, args, times, h, max_steps, eqx.combine(dynamic, static))
        return eqx.partition(c, eqx.is_array)[0]

    final = jax.lax.while_loop(lambda c: eqxi.unvmap_any(~c.done), turn, dynamic)
    c: _Carry = eqx.combine(final, static)
    rows = _filled(c) if keep_rows else (None, None, jnp.stack([zero, c.accepted]))
    reached = (times.saves <= c.t) & allowed
    reached = reached.at[0].set(True)
    inside = jnp.zeros_like(reached)
    if rows[0] is not None:
        inside = reached & (times.saves - rows[0] > resolution(times.saves))
    grid = None
    if record:
        assert c.ends is not None
        assert c.ends_anchor is not None
        assert c.jumps is not None
        assert rows[2] is not None
        offset = c.ends - jnp.take_along_axis(times.anchors(), c.ends_anchor, axis=0)
        grid = Grid(offset, c.ends_anchor, c.jumps, rows[2], c.accepted)
    ends = (c.status, c.t, c.y, c.tried, c.accepted, c.attempted)
    return Outcome(*ends, *rows[:2], reached, inside, grid)


def _turn(scheme: Scheme, args: Any, times: Times, dt: Array, max_steps: int, c: _Carry) -> _Carry:
    """One attempted step."""
    # Where the step would end, and whether it lands on a knot or on the stop instead.
    goal = times.start + (c.mark + 1).astype(c.t.dtype) * dt if scheme.controller is None else None
    goal = c.t + c.h if goal is None else goal
    boundary, boundary_anchor = _next_boundary(times, c.t)
    slack = jnp.maximum(1e-10 * (goal - c.t), resolution(boundary))
    lands = goal >= boundary - slack
    t1 = jnp.where(lands, boundary, goal)

    y1, error, memory, solved = scheme.step(c.t, t1, c.y, args, c.memory, c.jump)
    finite = _all_finite(y1, c.t.ndim)
    good = finite & solved
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
        span = times.stop - times.start
        least = jnp.maximum(resolution(c.t), jnp.finfo(h.dtype).eps ** 2 * span)
        stuck = ~keep & ~(h > least)

    active = ~c.done
    take = active & keep
    t = jnp.where(take, t1, c.t)
    attempted = c.attempted + active.astype(jnp.int32)
    accepted = c.accepted + take.astype(jnp.int32)
    arrived = t >= times.stop
    failure = jnp.where(
        finite,
        jnp.where(solved, int(Status.step_below_resolution), int(Status.implicit_solve_failed)),
        int(Status.nonfinite),
    )
    exhausted = active & ~stuck & ~arrived & (attempted >= max_steps)
    status = jnp.where(active & stuck, failure, c.status)
    status = jnp.where(exhausted, int(Status.max_steps), status).astype(jnp.int32)

    row_time, row_state, row_step, rows = c.row_time, c.row_state, c.row_step, c.rows
    if row_time is not None:
        size = times.saves.shape[0]
        rows = jnp.where(take, jnp.sum(times.saves <= t, axis=0, dtype=jnp.int32), c.rows)
        # Rows inside this step continue from its start; a row at its end is the end itself.
        first = jnp.where(rows > c.rows, c.rows, size)
        last_save = jnp.take_along_axis(times.saves, rows[None] - 1, axis=0)[0]
        at_end = (rows > c.rows) & (t - last_save <= resolution(t))
        if row_step is not None:
            # For derivatives the row must move with its own time, not with the end of the step.
            at_end = jnp.zeros_like(at_end)
        last = jnp.where(at_end, rows - 1, size)
        row_time = _write(_write(row_time, first, c.t), last, t)
        row_state = _write(row_state, first, _whole(scheme, c.y, c.memory))
        row_state = _write(row_state, last, _whole(scheme, y1, memory))
        if row_step is not None:
            row_step = _write(_write(row_step, first, c.accepted), last, accepted)

    passed = t1 >= goal - slack
    own_anchor = jnp.zeros_like(c.anchor) if scheme.controller is None else c.anchor
    anchor = jnp.where(take, jnp.where(lands, boundary_anchor, own_anchor), c.anchor)
    ends, ends_anchor, jumps = c.ends, c.ends_anchor, c.jumps
    if ends is not None:
        slot = jnp.where(take, c.accepted, ends.shape[0])
        ends = _write(ends, slot, t1)
        ends_anchor = _write(ends_anchor, slot, anchor)
        jumps = _write(jumps, slot, c.jump)
    return _Carry(
        t=t,
        y=_select(take, y1, c.y),
        h=jnp.where(active, h, c.h),
        memory=_select(take, memory, c.memory),
        control_state=_select(active, control_state, c.control_state),
        jump=jnp.where(take, jump | lands, c.jump),
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
        row_step=row_step,
        ends=ends,
        ends_anchor=ends_anchor,
        jumps=jumps,
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
    """Row time, state and step with every row not written taken from the last one written."""
    assert c.row_time is not None
    index = jnp.arange(c.row_time.shape[0], dtype=jnp.int32).reshape((-1,) + (1,) * c.t.ndim)
    source = jax.lax.cummax(jnp.where(jnp.isnan(c.row_time), 0, index), axis=0)

    def fill(leaf: Array) -> Array:
        wide = source.reshape(source.shape[:1] + (1,) * (leaf.ndim - source.ndim) + c.t.shape)
        return jnp.take_along_axis(leaf, wide, axis=0)

    return fill(c.row_time), jax.tree.map(fill, c.row_state), jax.tree.map(fill, c.row_step)
