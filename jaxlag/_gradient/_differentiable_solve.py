"""The differentiable solve: states at the save times, with one derivative for every transform.

It is the derivative of the map from (state, args, times) to the saved states at the FROZEN
sequence of accepted steps. The end of a step keeps its distance from its anchor (the start, a knot
or the stop) and moves with it. The loop of steps itself is never differentiated. Under a
derivative it records its steps, and the derivative follows this record.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxlag._core import _batching, _xla
from jaxlag._core._batching import LANES, Chunks, at_once_implicit, in_lanes
from jaxlag._core._custom_jvp import CustomJVP
from jaxlag._core._status import Status
from jaxlag._gradient._modes import GradientMode
from jaxlag._gradient._rescan import again
from jaxlag._gradient._split_problem import Problem, SplitProblem, split
from jaxlag._gradient._tangent_map import changed, changes, filled, in_loops, path_of
from jaxlag._gradient._unreached_saves import unreached
from jaxlag._integration._loop import integrate
from jaxlag._integration._record import Outcome
from jaxlag._integration._tableaus import remembers
from jaxlag._integration._vector_loop import NotVectorizable, may_vectorize


class SavedStates(NamedTuple):
    """The solution at the save times, and the end of the solve."""

    saved: PyTree  # leaves (s, ...), NaN where not reached
    state: PyTree  # last good state
    time: Float[Array, ""]  # last good time


def solve(problem: Problem) -> tuple[SavedStates, Outcome]:
    """Integrate and save; differentiable in y0, args and times."""
    whole = split(problem)
    problem_static = whole.static

    @CustomJVP
    def run(*traced: Any) -> tuple[SavedStates, Outcome]:
        return _ended(_integrated(SplitProblem._make((*traced, problem_static)), record=False))

    @partial(run.defjvp, symbolic_zeros=True)
    def run_jvp(primals: Any, tangents: Any) -> Any:
        whole = SplitProblem._make((*primals, problem_static))
        outcome = _recorded(whole)
        change = changes(tangents[0], outcome)
        assert outcome.record is not None
        if remembers(whole.stepper.solver):
            given, function = whole.differentiable, partial(_replay, whole, outcome)
            states, states_dot = jax.jvp(function, (given,), (filled(change, given),))
            ended = _ended(outcome)[1]
        else:
            walk = changed(whole, outcome.record, change)
            states, ended = _ended(outcome)
            states_dot = SavedStates(walk.saved[0], walk.last[0], walk.time)
        ended = ended._replace(gradient=_mode(outcome, whole))
        reached = jnp.all(jnp.isfinite(outcome.saved), axis=tuple(range(1, outcome.saved.ndim)))
        states_dot = states_dot._replace(
            saved=unreached(reached, whole.differentiable, change, states_dot.saved)
        )
        return (states, ended), (states_dot, jax.tree.map(lambda _: None, ended))

    return run(*whole.traced)


def _ended(outcome: Outcome) -> tuple[SavedStates, Outcome]:
    """The saved states, and the outcome of a solve without its record."""
    lost = (outcome.missed != int(Status.ok)) & (outcome.status == int(Status.ok))
    status = jnp.where(lost, outcome.missed, outcome.status).astype(jnp.int32)
    states = SavedStates(outcome.saved, outcome.state, outcome.time)
    return states, outcome._replace(status=status, saved=None, record=None)


def _mode(outcome: Outcome, problem: SplitProblem) -> Array:
    """The mode of the reverse derivatives."""
    assert outcome.record is not None
    if problem.static.capacity == 0 and not remembers(problem.stepper.solver):
        return jnp.full_like(outcome.gradient, int(GradientMode.forward))
    checkpointed = outcome.record.stride > 1
    modes = int(GradientMode.checkpoints), int(GradientMode.recorded)
    return jnp.where(checkpointed, *modes).astype(jnp.int32) + jnp.zeros_like(outcome.gradient)


def _recorded(problem: SplitProblem) -> Outcome:
    """The loop with its record; states at points and saved ones are differentiable."""
    static = problem.static

    @CustomJVP
    def run(*traced: Any) -> Outcome:
        return _integrated(SplitProblem._make((*traced, static)), record=True)

    @partial(run.defjvp, symbolic_zeros=True)
    def run_jvp(primals: Any, tangents: Any) -> Any:
        problem = SplitProblem._make((*primals, static))
        outcome = _recorded(problem)
        dots = jax.tree.map(lambda _: None, outcome)
        if not remembers(problem.stepper.solver):
            change = changes(tangents[0], outcome)
            record = outcome.record
            assert record is not None
            with_points = record.points is not None  # none for forward derivatives
            walk = changed(problem, record, change, points=with_points)
            record = dots.record._replace(points=walk.points)
            dots = dots._replace(
                state=walk.last[0], time=walk.time, saved=walk.saved[0], record=record
            )
        return outcome, dots

    outcome = run(*problem.traced)
    assert outcome.record is not None
    # Times are constant, or move with their anchors.
    record = outcome.record._replace(offsets=jax.lax.stop_gradient(outcome.record.offsets))
    return outcome._replace(record=record)


def _integrated(problem: SplitProblem, record: bool) -> Outcome:
    """The loop of steps; scalar programs and implicit methods are vmapped in chunks."""
    static = problem.static

    def single(*traced: Any, form: str = "alone") -> Outcome:
        problem = SplitProblem._make((*traced, static))
        (y0, args, times), setup, stepper = problem.motion, problem.setup, problem.stepper
        if record:
            stepper = stepper.for_derivatives(y0, args)
        fast = stepper.on_scalars(lanes=form == "lanes")
        if record and form == "lanes":  # unrolled, this part would take most of the compile time
            fast = None if fast is None else in_loops(fast)
        bounds = setup.first_step, setup.allowed, static.max_steps, record, static.capacity
        native = None if fast is None else _xla.native
        vectorized = form == "vectorized"
        return integrate(fast or stepper, y0, args, times, *bounds, native, vectorized)

    y0, stepper = problem.motion[0], problem.stepper
    on_scalars = stepper.on_scalars() is not None
    if jax.default_backend() != "cpu" or not (on_scalars or stepper.implicit):
        return single(*problem.traced)
    in_rows = partial(single, form="lanes")
    at_once = LANES if on_scalars else at_once_implicit(y0.size)
    chunks = Chunks(in_rows, at_once, even=not on_scalars)

    def vectorized(*traced: Any) -> Outcome:
        try:
            return single(*traced, form="vectorized")
        except NotVectorizable:
            return in_lanes(single, lambda _: chunks, *traced)

    large = Chunks(vectorized, _batching.VECTORIZED, even=True)
    suits = may_vectorize(stepper)

    def divided(count: Any) -> Chunks:
        return (
            large if suits and _batching.is_faster_vectorized(count, static.max_steps) else chunks
        )

    return in_lanes(single, divided, *problem.traced)


def _replay(problem: SplitProblem, outcome: Outcome, differentiable: Any) -> SavedStates:
    """The saved states as a function of the differentiable leaves, with all steps repeated."""
    problem = problem._replace(differentiable=differentiable)
    y0, args, times = problem.motion
    assert outcome.record is not None
    path = path_of(problem.stepper, y0, args, times, outcome.record, ())
    walk = again(path, path.start, [], times.anchors(), times.saves, False)
    # States that were not reached, or failed, are NaN again.
    found = jnp.isfinite(outcome.saved)
    return SavedStates(jnp.where(found, walk.saved[0], jnp.nan), walk.last[0], walk.time)
