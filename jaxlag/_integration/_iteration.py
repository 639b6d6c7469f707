"""One iteration of the loop: one attempted step, or one step to a save time.

The phases, in the order of `iterate`: `aimed`, where the step is to end; `attempt`, the step itself
and its checks; `accept`, whether it counts and how long the next one is; `beside_change_points`,
states near a change point; `advance`, the new state of the loop, with the states saved.
"""

from typing import Any, NamedTuple, cast

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxlag._core._buffer_entries import set_entry
from jaxlag._core._status import Status
from jaxlag._integration._change_points import UNLIKE, Crossing, is_across
from jaxlag._integration._loop_state import (
    Loop,
    LoopState,
    SaveProgress,
    StepStart,
    select,
    write_step,
)
from jaxlag._integration._record import Reach, Times, reached_time
from jaxlag._integration._step_arguments import StepChecks
from jaxlag._integration._stepper import SINGULAR, Estimate, all_finite, resolution


class Aim(NamedTuple):
    """Where a step starts and ends.

    Attributes:
        start: start of the step.
        tnext: time at which a state is required.
        end: time at which the step ends; it differs from tnext only near change points.
        reach: how the step gives the state at tnext; None if no change points are passed.
        to_save: whether it goes to a save time inside the last accepted step.
        due: the next save time; None without any.
        lands: whether it ends on a knot or on the stop.
        cut: whether it is shorter than proposed.
        on_grid: whether it reaches the next time of the fixed grid.
        anchor: index of the next knot, or of the stop.
    """

    start: StepStart
    tnext: Array
    end: Array
    reach: Array | None
    to_save: Array
    due: Array | None
    lands: Array
    cut: Array
    on_grid: Array
    anchor: Array


class Attempt(NamedTuple):
    """An attempted step and its checks.

    Attributes:
        y1: state by the method alone.
        settled: the same after the projection.
        memory: the solver's own state.
        estimate: error estimate.
        checks: checks of constraints and contacts.
        crossing: detection of change points at its end.
        determinants: determinants of quasi-velocities at its end.
        share: fraction of the allowed error near a singularity of these; None elsewhere.
        finite: whether y1 is finite.
        solved: whether implicit equations were solved.
        regular: whether quasi-velocities stay regular.
        crossable: whether no change point forbids the step.
        independent: whether rows stay independent.
        met: whether a stage met a change point.
        good: whether the step is acceptable apart from its error.
    """

    y1: PyTree
    settled: PyTree
    memory: Any
    estimate: Estimate
    checks: StepChecks
    crossing: Crossing | None
    determinants: Array | None
    share: Array | None
    finite: Array
    solved: Array
    regular: Array
    crossable: Array
    independent: Array
    met: Array
    good: Array


def is_due(loop: Loop, c: Any) -> Array:
    """Whether a save time lies inside the last accepted step."""
    if c.saved is None:
        return jnp.array(False)
    return (loop.dues[c.saved.next] <= c.at.t) & (c.accepted > 0)


def iterate(loop: Loop, c: LoopState) -> LoopState:
    """One attempted step, or one to a save time."""
    aim = aimed(loop, c)
    step = attempt(loop, c, aim)
    keep_step, *following = accept(loop, c, aim, step)
    aim, settled, across = beside_change_points(loop, c, aim, step)
    return advance(loop, c, aim, step._replace(settled=settled), across, keep_step, *following)


# ---- Aim ----------------------------------------------------------------------------------------


def aimed(loop: Loop, c: LoopState) -> Aim:
    """Choose the end of the step: the proposed length, a knot, the stop, or a save time."""
    stepper, times, t = loop.stepper, loop.times, c.at.t
    fixed = stepper.controller is None
    h = c.h
    if c.at.crossing is not None and not fixed:
        following = jnp.inf if c.saved is None else loop.dues[c.saved.next]
        h = c.at.crossing.step(t, c.h, stepper.gap, times.stop, following)
    goal = (c.mark + 1).astype(t.dtype) * loop.dt if fixed else t + h
    boundary, anchor = _next_boundary(times, t)
    slack = jnp.maximum(1e-10 * (goal - t), resolution(boundary))
    lands = goal >= boundary - slack
    tnext, cut = jnp.where(lands, boundary, goal), lands | (h < c.h)

    start, to_save, due = c.at, jnp.array(False), None
    if c.saved is not None:
        due = loop.dues[c.saved.next]
        to_save = is_due(loop, c)
        start = select(to_save, c.saved.base, c.at)
        tnext = jnp.where(to_save, due, tnext)
    end, reach = tnext, None
    if c.reach is not None:
        # The motion may end at a change point: saves of its last step are treated in the same way.
        assert start.crossing is not None
        ends_at_crossing = (tnext >= times.stop) & start.crossing.is_at(start.t, tnext)
        beyond = jnp.where(to_save, c.reach == Reach.beyond, ends_at_crossing)
        reach = jnp.where(beyond, int(Reach.beyond), int(Reach.step))
        end = reached_time(reach, start.t, tnext, tnext)
    on_grid = tnext >= goal - slack
    return Aim(start, tnext, end, reach, to_save, due, lands, cut, on_grid, anchor)


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


# ---- Take it ------------------------------------------------------------------------------------


def attempt(loop: Loop, c: LoopState, aim: Aim) -> Attempt:
    """Take the step, project it onto the constraints, and check it."""
    stepper, (start, tnext, end, *_) = loop.stepper, aim
    made_jump = False if start.jump is None else start.jump
    args = stepper.within(loop.args, start.t)
    step = (start.t, end, start.y, args, start.memory, made_jump, start.crossing)
    y1, estimate, memory, solved = stepper.step(*step)
    finite = all_finite(y1)
    ends = (start.t, end, start.y, y1, args, estimate, start.crossing, aim.lands | aim.to_save)
    settled, checks, estimate, crossing = stepper.settled_with_error(*ends)
    step = (start.t, end, start.y, settled, args, estimate.slope_drop)
    passage = stepper.passage(*step, start.determinants)
    regular, share, determinants = (jnp.array(True), None, None) if passage is None else passage
    crossable = independent = stepper.same_sense(*step)
    met = jnp.array(False)
    if crossing is not None:
        # A step from a change point, or a step of fixed length to it, has a stage there.
        assert start.crossing is not None
        fixed = stepper.controller is None
        stands = start.crossing.stands | (crossing.stands if fixed else False)
        met = fixed & ~finite & (start.crossing.time < tnext + (tnext - start.t))
        crossable, independent = crossing.passes & ~stands & ~met, ~crossing.depends
    good = finite & solved & ((regular & crossable) | aim.to_save) & checks.good
    return Attempt(
        y1,
        settled,
        memory,
        estimate,
        checks,
        crossing,
        determinants,
        share,
        finite,
        solved,
        regular,
        crossable,
        independent,
        met,
        good,
    )


def beside_change_points(
    loop: Loop, c: LoopState, aim: Aim, step: Attempt
) -> tuple[Aim, PyTree, Array]:
    """(the aim, the state at tnext, whether it is interpolated within the last accepted step).

    Near a change point states are computed from a polynomial through both ends of a short step.
    """
    if aim.reach is None:
        return aim, step.settled, jnp.array(False)
    stepper, start, reach, end = loop.stepper, aim.start, aim.reach, aim.end
    args = stepper.within(loop.args, start.t)
    sound = step.good & stepper.is_small(start.y, step.y1, step.estimate.error, UNLIKE)
    known = cast(
        tuple[Crossing, Crossing, Crossing], (start.crossing, c.at.crossing, step.crossing)
    )
    across = aim.to_save & (reach == Reach.step) & is_across(*known, sound) & step.finite
    reach = jnp.where(across, int(Reach.within), reach)
    end, last = jnp.where(across, c.at.t, end), select(across, c.at.y, step.settled)
    settled = stepper.reached(start.t, start.y, end, last, aim.tnext, reach != Reach.step, args)
    return aim._replace(reach=reach), settled, across


# ---- Accept or reject ---------------------------------------------------------------------------


def accept(
    loop: Loop, c: LoopState, aim: Aim, step: Attempt
) -> tuple[Array, Array, Any, Array, Array]:
    """Decide whether to keep this step, and choose the next one.

    Returns:
        whether to keep it, length of the next, the controller's state, whether the field jumps,
        whether there is no next one.
    """
    stepper, t, y = loop.stepper, c.at.t, c.at.y
    t1, y1, good, share, cut = aim.tnext, step.y1, step.good, step.share, aim.cut
    if stepper.controller is None:
        return good, c.h, None, jnp.zeros_like(good), ~good
    order: Any = stepper.solver.error_order(stepper.term)
    # Derivatives must not use up the steps that the motion itself needs.
    stop = loop.times.stop
    spare = c.attempted.astype(t.dtype) * stop < loop.max_steps * jnp.maximum(0.25 * stop, 0.9 * t)
    error = stepper.held_to(t, t1, y, y1, loop.args, step.estimate, spare)
    if share is not None:
        error = jax.tree.map(lambda e: e / share, error)
    error = jax.tree.map(lambda e: jnp.where(good & ~jnp.isnan(e), e, jnp.inf), error)
    y1 = select(good, y1, y)  # an infinite y1 would make the scale of the error infinite
    proposal: Any = stepper.controller.adapt_step_size(
        t, t1, y, y1, loop.args, error, order, c.control
    )
    keep, next0, next1, jump, control, result = proposal
    keep = keep & good
    h = jnp.asarray(next1 - next0, t.dtype)
    # A step that was cut short does not reduce the length proposed before it.
    cut = keep & cut
    h = jnp.where(cut, jnp.maximum(h, c.h), h)
    if stepper.standard:
        control = _uncut(stepper.controller, cut, h, c.control, control)
    h = h if stepper.longest is None else jnp.minimum(h, stepper.longest)
    least = jnp.maximum(resolution(t), jnp.finfo(h.dtype).eps ** 2 * loop.times.stop)
    if share is not None:  # tiny steps would not change a state of fewer digits
        coarse = 64 * float(jnp.finfo(share.dtype).eps) * loop.times.stop
        least = jnp.where(step.regular | aim.to_save, least, jnp.maximum(least, coarse))
    refused = (result != diffrax.RESULTS.successful) & ~cut
    # A controller with a minimum step proposes it again if no shorter one is possible.
    again = ~good & ~(h < t1 - t)
    stuck = (~keep & ~(h > least)) | refused | again
    return keep & ~refused, h, control, jnp.asarray(jump), stuck


def _uncut(controller: Any, cut: Array, h: Array, before: Any, after: Any) -> Any:
    """The state of a PID controller without the effect of a step that was cut short.

    Its last entry is whether the proposed step is the minimum one, which is always accepted.
    """
    control = select(cut, before, after)
    if controller.dtmin is None:
        return control
    *errors, at_least = control
    return (*errors, at_least & (~cut | (h <= controller.dtmin)))


def failure_of(loop: Loop, aim: Aim, step: Attempt, smooth: Array) -> Array:
    """The status of a motion that ends with this step; later causes below override earlier ones."""
    checks, met = step.checks, step.met
    status = jnp.full((), int(Status.step_below_resolution))
    for right, kind in (
        (smooth | (not loop.stepper.moves), Status.projection_failed),
        (checks.contacts_valid, Status.no_reaction_solution),
        (step.regular, Status.kinematics_singular),
        (checks.redundant_rows_hold, Status.rank_change),
        (step.crossable & step.independent, Status.rank_change),
        (checks.projected | met, Status.projection_failed),
        (step.solved | met, Status.implicit_solve_failed),
        (step.finite | met, Status.nonfinite),
    ):
        status = jnp.where(right, status, int(kind))
    return status


# ---- Save and advance ---------------------------------------------------------------------------


def saved_on(
    loop: Loop,
    c: LoopState,
    aim: Aim,
    step: Attempt,
    take: Bool[Array, ""],
    smooth: Array,
    across: Array,
    failure: Array,
) -> SaveProgress | None:
    """Store the state if it is one at a save time; NaN if the step failed."""
    saved, to_save, tnext = c.saved, aim.to_save, aim.tnext
    if saved is None:
        return None
    assert aim.due is not None
    if saved.steps is None:  # for derivatives a save must move with its own time
        to_save = to_save | (take & (jnp.abs(aim.due - tnext) <= resolution(tnext)))
    known = (step.good & smooth) | across
    slot = jnp.where(to_save, saved.next, loop.times.saves.shape[0] - 2)
    value = jax.tree.map(lambda y: jnp.where(known, y, jnp.nan), step.settled)
    steps, reaches = saved.steps, saved.reaches
    if reaches is not None:
        assert aim.reach is not None
        reaches = set_entry(reaches, slot, jnp.where(to_save, aim.reach, 0))
    if steps is not None:
        # The slot after the last save is unused: it stays beyond all steps.
        assert c.buffers is not None
        beyond = jnp.full((), c.buffers.offsets.shape[0], jnp.int32)
        steps = set_entry(steps, slot, jnp.where(to_save, saved.step, beyond))
    return SaveProgress(
        base=select(take, c.at, saved.base),
        step=jnp.where(take, c.recorded, saved.step),
        next=saved.next + to_save.astype(jnp.int32),
        values=set_entry(saved.values, slot, value),
        steps=steps,
        reaches=reaches,
        missed=jnp.where(to_save & ~known, failure, saved.missed).astype(jnp.int32),
    )


def advance(
    loop: Loop,
    c: LoopState,
    aim: Aim,
    step: Attempt,
    across: Array,
    keep_step: Array,
    h: Array,
    control: Any,
    jump: Array,
    stuck: Array,
) -> LoopState:
    """The state of the loop after the step: its start, its status, its records."""
    stepper, start, tnext = loop.stepper, aim.start, aim.tnext
    active = ~c.done & ~aim.to_save
    take = active & keep_step
    attempted = c.attempted + active.astype(jnp.int32)
    arrived = take & (tnext >= loop.times.stop)
    smooth = jnp.array(True)
    if c.saved is not None:
        small = stepper.is_small(start.y, step.y1, step.estimate.error, SINGULAR)
        smooth = ~aim.to_save | across | small
    failure = failure_of(loop, aim, step, smooth)
    exhausted = active & ~stuck & ~arrived & (attempted >= loop.max_steps)
    status = jnp.where(active & stuck, failure, c.status)
    status = jnp.where(exhausted, int(Status.max_steps), status).astype(jnp.int32)
    saved = saved_on(loop, c, aim, step, take, smooth, across, failure)

    own_anchor = jnp.zeros_like(c.anchor) if stepper.controller is None else c.anchor
    anchor = jnp.where(take, jnp.where(aim.lands, aim.anchor, own_anchor), c.anchor)
    made_jump = None if c.at.jump is None else jump | aim.lands
    end = StepStart(tnext, step.settled, step.memory, made_jump, step.determinants, step.crossing)
    at = select(take, end, c.at)
    buffers = None if c.buffers is None else write_step(loop, c, c.buffers, at.t, anchor)
    return LoopState(
        at=at,
        h=jnp.where(active, h, c.h),
        control=select(active, control, c.control),
        mark=c.mark + (take & aim.on_grid).astype(jnp.int32),
        anchor=anchor,
        status=status,
        done=c.done | (active & (stuck | arrived | exhausted)),
        tried=jnp.where(active, tnext, c.tried),
        accepted=c.accepted + take.astype(jnp.int32),
        attempted=attempted,
        recorded=c.recorded + eqxi.unvmap_any(take).astype(jnp.int32),
        saved=saved,
        buffers=buffers,
        reach=None if aim.reach is None else select(take, aim.reach, c.reach),
    )
