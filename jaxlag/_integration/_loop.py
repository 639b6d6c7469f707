"""The integration loop: steps, step-size control, knots, save times, the record, the status.

Integration runs forwards in a time tau = sigma (t - ts[0]), sigma = +1 or -1, so that nothing here
knows about direction, and times are as fine as the span allows.

Each turn takes one step, or one step to a save time. A save time that lies inside the last accepted
step is reached by a separate step from its start, not by interpolation: this is as accurate as the
method is, and the loop body contains one step only.
"""

from collections.abc import Callable
from typing import Any, cast

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxlag._core._batching import at_most
from jaxlag._core._buffer_entries import set_entry
from jaxlag._core._status import Status
from jaxlag._integration._change_points import UNLIKE, Crossing, is_across, no_crossing
from jaxlag._integration._loop_state import (
    Loop,
    LoopState,
    RecordBuffers,
    SaveProgress,
    StepStart,
    buffer,
    is_full,
    select,
    thin,
    write_turn,
)
from jaxlag._integration._record import Outcome, Reach, Record, Times, reached_time
from jaxlag._integration._stepper import SINGULAR, Estimate, Stepper, all_finite, resolution
from jaxlag._integration._tableaus import remembers

# The record is a whole number of chunks of this many turns.
CHUNK = 64


def integrate(
    stepper: Stepper,
    y0: PyTree,
    args: Any,
    times: Times,
    first_step: Array | None,
    allowed: Bool[Array, ""],
    max_steps: int,
    record: bool,
    room: int = 0,
    native: Callable | None = None,
) -> Outcome:
    """Integrate from tau = 0 to `times.stop`.

    Args:
        stepper: solver, controller, vector field.
        y0: state at the start.
        args: passed to the vector field, after `stepper.windows`.
        times: anchors and save times.
        first_step: the fixed step without a controller; else the first step, None for automatic.
        allowed: False where the trajectory must not start (status set by the caller).
        max_steps: bound on attempted steps.
        record: whether to keep what is needed to go the same way again.
        room: for so many states on the way, an even number. When it is full every other one is
            dropped, and from then on half as many are kept.
        native: what calls the loop, with its start.
    """
    t0 = jnp.zeros_like(times.stop)
    count = times.saves.shape[0]
    # Turns in which any lane takes a step: at most those in which one attempts it or goes to a save
    # time.
    size = -(-(max_steps + count - 2) // CHUNK) * CHUNK
    room = (room if room < max_steps else size) if record and not remembers(stepper.solver) else 0
    if stepper.controller is not None:
        memory, sound, h, control = stepper.start(t0, times.stop, y0, args, first_step)
        # The estimate is 0/0 where atol = 0 meets a component that is 0.
        h = jnp.where(jnp.isfinite(h) & (h > 0), h, 1e-6 * times.stop)
        h = h if stepper.longest is None else jnp.minimum(h, stepper.longest)
    else:
        assert first_step is not None
        memory, h, control = stepper.begin(t0, times.stop, y0, args), first_step, None
        sound = stepper.is_sound(memory)
    jumps = times.knots is not None or not stepper.standard
    determinants = stepper.determinants(t0, y0, args)
    crossing = None if args.lengths is None else no_crossing(t0, args.units.size, args.units.dtype)
    reaches_beyond = crossing is not None and stepper.controller is not None
    start = StepStart(t0, y0, memory, jnp.array(False) if jumps else None, determinants, crossing)
    zero = jnp.zeros((), jnp.int32)
    status = jnp.where(sound, int(Status.ok), int(Status.nonfinite))
    saved = kept = None
    if not at_most(count, 2):
        places = jnp.full((count - 1,), size, jnp.int32) if record else None
        values = buffer(count - 1, y0, jnp.nan)
        reaches = jnp.zeros_like(places) if reaches_beyond and places is not None else None
        saved = SaveProgress(start, zero, zero, values, places, reaches, zero)
    if record:
        kept = RecordBuffers(
            offsets=buffer(size, t0, 0.0),
            anchors=None if times.knots is None else buffer(size, zero, 0),
            jumps=buffer(size, zero > 0, 0) if jumps else None,
            points=buffer(room + 1, (y0, None), 0.0) if room else None,
            stride=jnp.ones((), jnp.int32),
        )
    carry = LoopState(
        at=start,
        h=jnp.asarray(h, t0.dtype),
        control=control,
        mark=zero,
        anchor=zero,
        status=status.astype(jnp.int32),
        done=~(allowed & sound) | (times.stop <= 0),
        tried=t0,
        accepted=zero,
        attempted=zero,
        turn=zero,
        saved=saved,
        kept=kept,
        reach=zero if reaches_beyond else None,
    )
    carry = jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_array_like(x) else x, carry)
    dynamic, static = eqx.partition(carry, eqx.is_array)
    fixed = (times, times.anchors(), times.dues(), jnp.asarray(h, t0.dtype), max_steps)
    loop = Loop(stepper, args, *fixed)

    def turn(dynamic: Any) -> Any:
        c = _turn(loop, eqx.combine(dynamic, static))
        return eqx.partition(c, eqx.is_array)[0]

    def cond_fun(c: Any) -> Array:
        return eqxi.unvmap_any(~c.done | _is_due(loop, c))

    def turns(dynamic: Any) -> Any:
        if room in (0, size):
            return jax.lax.while_loop(cond_fun, turn, dynamic)
        until_full = lambda c: cond_fun(c) & ~eqxi.unvmap_any(is_full(c, room))  # noqa: E731
        fill = lambda c: jax.lax.while_loop(until_full, turn, c)  # noqa: E731
        return jax.lax.while_loop(cond_fun, lambda c: fill(thin(c, room)), dynamic)

    final = turns(dynamic) if native is None else native(turns, dynamic)
    return _outcome(eqx.combine(final, static), times, y0, allowed)


def _outcome(c: LoopState, times: Times, y0: PyTree, allowed: Array) -> Outcome:
    arrived = allowed & (times.saves[-1] <= c.at.t)
    last = jax.tree.map(lambda y: jnp.where(arrived, y, jnp.nan), c.at.y)
    parts = [jax.tree.map(lambda y: y[None], y0)]
    if c.saved is not None:
        parts.append(jax.tree.map(lambda x: x[:-1], c.saved.values))
    parts.append(jax.tree.map(lambda y: y[None], last))
    saved = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    record = None
    if c.kept is not None:
        save_turn = None if c.saved is None else c.saved.turns
        save_reach = None if c.saved is None else c.saved.reaches
        record = Record(*c.kept, c.turn, save_turn, save_reach, c.reach)
    ends = (c.status, c.at.t, c.at.y, c.tried, c.accepted, c.attempted)
    missed = jnp.zeros((), jnp.int32) if c.saved is None else c.saved.missed
    return Outcome(*ends, saved, missed, record, jnp.zeros((), jnp.int32))


def _is_due(loop: Loop, c: Any) -> Array:
    """Whether a save time lies inside the last accepted step."""
    if c.saved is None:
        return jnp.array(False)
    return (loop.dues[c.saved.next] <= c.at.t) & (c.accepted > 0)


def _turn(loop: Loop, c: LoopState) -> LoopState:
    """One attempted step, or one to a save time."""
    stepper, times, t = loop.stepper, loop.times, c.at.t
    # Where the step would end, and whether it lands on a knot or on the stop instead.
    fixed = stepper.controller is None
    h = c.h
    if c.at.crossing is not None and not fixed:
        following = jnp.inf if c.saved is None else loop.dues[c.saved.next]
        h = c.at.crossing.step(t, c.h, stepper.gap, times.stop, following)
    goal = (c.mark + 1).astype(t.dtype) * loop.dt if fixed else t + h
    boundary, boundary_anchor = _next_boundary(times, t)
    slack = jnp.maximum(1e-10 * (goal - t), resolution(boundary))
    lands = goal >= boundary - slack
    t1, cut = jnp.where(lands, boundary, goal), lands | (h < c.h)

    begin, to_save, due = c.at, jnp.array(False), None
    if c.saved is not None:
        due = loop.dues[c.saved.next]
        to_save = _is_due(loop, c)
        begin = select(to_save, c.saved.base, c.at)
        t1 = jnp.where(to_save, due, t1)
    end, reach = t1, None  # of the step, and how the state at t1 follows from it
    if c.reach is not None:
        # A motion may end at such a place: saves of its last step are then reached alike.
        assert begin.crossing is not None
        there = (t1 >= times.stop) & begin.crossing.is_at(begin.t, t1)
        beyond = jnp.where(to_save, c.reach == Reach.beyond, there)
        reach = jnp.where(beyond, int(Reach.beyond), int(Reach.step))
        end = reached_time(reach, begin.t, t1, t1)
    jumped = False if begin.jump is None else begin.jump
    args = stepper.within(loop.args, begin.t)
    step = (begin.t, end, begin.y, args, begin.memory, jumped, begin.crossing)
    y1, estimate, memory, solved = stepper.step(*step)
    finite = all_finite(y1)
    ends = (begin.t, end, begin.y, y1, args, estimate, begin.crossing, lands | to_save)
    settled, checks, estimate, crossing = stepper.settled_with_error(*ends)
    step = (begin.t, end, begin.y, settled, args, estimate.turn)
    passage = stepper.passage(*step, begin.determinants)
    regular, share, determinants = (jnp.array(True), None, None) if passage is None else passage
    crossable = independent = stepper.same_sense(*step)
    met = jnp.array(False)  # a change point, by a stage
    if crossing is not None:
        # A step from such a place, or one of equal steps to it, has a stage there.
        assert begin.crossing is not None
        stands = begin.crossing.stands | (crossing.stands if fixed else False)
        met = fixed & ~finite & (begin.crossing.time < t1 + (t1 - begin.t))
        crossable, independent = crossing.passes & ~stands & ~met, ~crossing.depends
    good = finite & solved & ((regular & crossable) | to_save) & checks.good
    rest = (estimate, good, cut, share, regular | to_save)
    keep, h, control, jump, stuck = _next_step(loop, c, t1, y1, *rest)
    across = jnp.array(False)
    if reach is not None:
        sound = good & stepper.is_small(begin.y, y1, estimate.error, UNLIKE)
        known = cast(tuple[Crossing, Crossing, Crossing], (begin.crossing, c.at.crossing, crossing))
        across = to_save & (reach == Reach.step) & is_across(*known, sound) & finite
        reach = jnp.where(across, int(Reach.within), reach)
        end, last = jnp.where(across, c.at.t, end), select(across, c.at.y, settled)
        settled = stepper.reached(begin.t, begin.y, end, last, t1, reach != Reach.step, args)

    active = ~c.done & ~to_save
    take = active & keep
    attempted = c.attempted + active.astype(jnp.int32)
    arrived = take & (t1 >= times.stop)
    failure = jnp.full((), int(Status.step_below_resolution))
    smooth = jnp.array(True)
    if c.saved is not None:
        smooth = ~to_save | across | stepper.is_small(begin.y, y1, estimate.error, SINGULAR)
    for right, kind in (
        (smooth | (not stepper.moves), Status.projection_failed),
        (checks.contacts_valid, Status.no_reaction_solution),
        (regular, Status.kinematics_singular),
        (checks.redundant_rows_hold, Status.rank_change),
        (crossable & independent, Status.rank_change),
        (checks.projected | met, Status.projection_failed),
        (solved | met, Status.implicit_solve_failed),
        (finite | met, Status.nonfinite),
    ):
        failure = jnp.where(right, failure, int(kind))
    exhausted = active & ~stuck & ~arrived & (attempted >= loop.max_steps)
    status = jnp.where(active & stuck, failure, c.status)
    status = jnp.where(exhausted, int(Status.max_steps), status).astype(jnp.int32)

    saved = c.saved
    if saved is not None:
        assert due is not None
        if saved.turns is None:  # for derivatives a save must move with its own time
            to_save = to_save | (take & (jnp.abs(due - t1) <= resolution(t1)))
        slot = jnp.where(to_save, saved.next, times.saves.shape[0] - 2)
        known = (good & smooth) | across
        value = jax.tree.map(lambda y: jnp.where(known, y, jnp.nan), settled)
        turns, reaches = saved.turns, saved.reaches
        if reaches is not None:
            assert reach is not None
            reaches = set_entry(reaches, slot, jnp.where(to_save, reach, 0))
        if turns is not None:
            # The slot after the last save is that of nothing: it stays beyond all turns.
            beyond = turns[-1]
            turns = set_entry(turns, slot, jnp.where(to_save, saved.turn, beyond))
        saved = SaveProgress(
            base=select(take, c.at, saved.base),
            turn=jnp.where(take, c.turn, saved.turn),
            next=saved.next + to_save.astype(jnp.int32),
            values=set_entry(saved.values, slot, value),
            turns=turns,
            reaches=reaches,
            missed=jnp.where(to_save & ~known, failure, saved.missed).astype(jnp.int32),
        )

    passed = t1 >= goal - slack
    own_anchor = jnp.zeros_like(c.anchor) if fixed else c.anchor
    anchor = jnp.where(take, jnp.where(lands, boundary_anchor, own_anchor), c.anchor)
    jump = None if c.at.jump is None else jump | lands
    end = StepStart(t1, settled, memory, jump, determinants, crossing)
    at = select(take, end, c.at)
    kept = None if c.kept is None else write_turn(loop, c, c.kept, at.t, anchor)
    return LoopState(
        at=at,
        h=jnp.where(active, h, c.h),
        control=select(active, control, c.control),
        mark=c.mark + (take & passed).astype(jnp.int32),
        anchor=anchor,
        status=status,
        done=c.done | (active & (stuck | arrived | exhausted)),
        tried=jnp.where(active, t1, c.tried),
        accepted=c.accepted + take.astype(jnp.int32),
        attempted=attempted,
        turn=c.turn + eqxi.unvmap_any(take).astype(jnp.int32),
        saved=saved,
        kept=kept,
        reach=None if reach is None else select(take, reach, c.reach),
    )


def _next_step(
    loop: Loop,
    c: LoopState,
    t1: Array,
    y1: PyTree,
    estimate: Estimate,
    good: Array,
    cut: Array,
    share: Array | None,
    regular: Array,
) -> tuple[Array, Array, Any, Array, Array]:
    """Whether to keep this step, and the next one.

    Returns:
        whether to keep it, length of the next, the controller's state, whether the field jumps,
        whether there is no next one.
    """
    stepper, t, y = loop.stepper, c.at.t, c.at.y
    if stepper.controller is None:
        return good, c.h, None, jnp.zeros_like(good), ~good
    order: Any = stepper.solver.error_order(stepper.term)
    # What derivatives need must not use up the steps of the motion: as many as get through it.
    stop = loop.times.stop
    spare = c.attempted.astype(t.dtype) * stop < loop.max_steps * jnp.maximum(0.25 * stop, 0.9 * t)
    error = stepper.held_to(t, t1, y, y1, loop.args, estimate, spare)
    if share is not None:
        error = jax.tree.map(lambda e: e / share, error)
    error = jax.tree.map(lambda e: jnp.where(good & ~jnp.isnan(e), e, jnp.inf), error)
    y1 = select(good, y1, y)  # an infinite one would make the scale of the error infinite, too
    proposal: Any = stepper.controller.adapt_step_size(
        t, t1, y, y1, loop.args, error, order, c.control
    )
    keep, next0, next1, jump, control, result = proposal
    keep = keep & good
    h = jnp.asarray(next1 - next0, t.dtype)
    # A step cut short says nothing against the length proposed before it.
    cut = keep & cut
    h = jnp.where(cut, jnp.maximum(h, c.h), h)
    if stepper.standard:
        control = _uncut(stepper.controller, cut, h, c.control, control)
    h = h if stepper.longest is None else jnp.minimum(h, stepper.longest)
    least = jnp.maximum(resolution(t), jnp.finfo(h.dtype).eps ** 2 * loop.times.stop)
    if share is not None:  # before a singular place a state in fewer digits would stand still
        coarse = 64 * float(jnp.finfo(share.dtype).eps) * loop.times.stop
        least = jnp.where(regular, least, jnp.maximum(least, coarse))
    refused = (result != diffrax.RESULTS.successful) & ~cut
    # A controller with a least step proposes it again where no shorter one is left to try.
    again = ~good & ~(h < t1 - t)
    stuck = (~keep & ~(h > least)) | refused | again
    return keep & ~refused, h, control, jnp.asarray(jump), stuck


def _uncut(controller: Any, cut: Array, h: Array, before: Any, after: Any) -> Any:
    """The state of a PID control, which takes no notice of a step that was cut short.

    Its last part says that the step proposed is the least there is, and to be kept as it comes.
    """
    control = select(cut, before, after)
    if controller.dtmin is None:
        return control
    *errors, at_least = control
    return (*errors, at_least & (~cut | (h <= controller.dtmin)))


def _next_boundary(times: Times, t: Array) -> tuple[Array, Array]:
    """The first knot after t or the stop, whichever comes first, and its index as an anchor."""
    stop_anchor = jnp.ones((), jnp.int32)
    if times.knots is None:
        return times.stop, stop_anchor
    size = times.knots.shape[0]
    after = jnp.searchsorted(times.knots, t, side="right").astype(jnp.int32)
    knot = times.knots[jnp.minimum(after, size - 1)]
    inside = (after < size) & (knot < times.stop)
    return jnp.where(inside, knot, times.stop), jnp.where(inside, 2 + after, stop_anchor)
