"""The differentiable solve: states at the save times, with one derivative for every transform.

The derivative is that of the map from (state, args, times) to the saved states at the FROZEN
sequence of accepted steps: step ends keep their distance from the start, knot or stop they are
anchored to, and move with it. The loop of steps is never differentiated; under any derivative it
records where it went, and the derivative goes the same way again.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxlag._core import _xla
from jaxlag._core._batching import LANES, at_once_implicit, in_lanes
from jaxlag._core._custom_jvp import CustomJVP
from jaxlag._core._status import Status
from jaxlag._gradient._modes import CheckpointPlan, GradientMode
from jaxlag._gradient._rescan import again
from jaxlag._gradient._tangent_map import Setup, changed, changes, filled, in_loops, path_of, unpack
from jaxlag._gradient._unreached_saves import unreached
from jaxlag._integration._loop import integrate
from jaxlag._integration._record import Outcome, Times


class SavedStates(NamedTuple):
    """The solution at the save times, and where the solve ended."""

    saved: PyTree  # leaves (s, ...), NaN where not reached
    state: PyTree  # last good state
    time: Float[Array, ""]  # last good time


class Problem(NamedTuple):
    """A start, the vector field's arguments, the times, and how to solve."""

    y0: PyTree
    args: Any
    times: Times
    setup: Setup
    stepper: Any  # static half of the Stepper
    max_steps: int
    keep: CheckpointPlan


def solve(problem: Problem) -> tuple[SavedStates, Outcome]:
    """Integrate and save; differentiable in y0, args and times."""
    inexact, rest, setup, static = halves(problem)

    @CustomJVP
    def run(inexact: Any, rest: Any, setup: Setup) -> tuple[SavedStates, Outcome]:
        outcome = _driven(inexact, rest, setup, static, record=False)
        return _ended(outcome)

    @partial(run.defjvp, symbolic_zeros=True)
    def run_jvp(primals: Any, tangents: Any) -> Any:
        inexact, rest, setup = primals
        outcome = _recorded(inexact, rest, setup, static)
        change = changes(tangents[0], outcome)
        assert outcome.record is not None
        if static[1].remembers:
            function = partial(_replay, rest, setup, static, outcome)
            states, states_dot = jax.jvp(function, (inexact,), (filled(change, inexact),))
            ended = _ended(outcome)[1]
        else:
            walk = changed(inexact, rest, setup, static, outcome.record, change)
            states, ended = _ended(outcome)
            states_dot = SavedStates(walk.saved[0], walk.last[0], walk.time)
        ended = ended._replace(gradient=_mode(outcome, static))
        reached = jnp.all(jnp.isfinite(outcome.saved), axis=tuple(range(1, outcome.saved.ndim)))
        states_dot = states_dot._replace(
            saved=unreached(reached, inexact, change, states_dot.saved)
        )
        return (states, ended), (states_dot, jax.tree.map(lambda _: None, ended))

    return run(inexact, rest, setup)


def halves(problem: Problem) -> tuple[Any, Any, Setup, Any]:
    """A problem as (differentiable leaves, other arrays, setup, static rest)."""
    inexact, rest = eqx.partition(problem[:3], eqx.is_inexact_array)
    rest, static = eqx.partition(rest, eqx.is_array)
    return inexact, rest, problem.setup, (static, problem.stepper, problem.max_steps, problem.keep)


def _ended(outcome: Outcome) -> tuple[SavedStates, Outcome]:
    """The saved states, and what is said of a solve without what was kept on the way."""
    lost = (outcome.missed != int(Status.ok)) & (outcome.status == int(Status.ok))
    status = jnp.where(lost, outcome.missed, outcome.status).astype(jnp.int32)
    states = SavedStates(outcome.saved, outcome.state, outcome.time)
    return states, outcome._replace(status=status, saved=None, record=None)


def _mode(outcome: Outcome, static: Any) -> Array:
    """How reverse derivatives go through the steps."""
    assert outcome.record is not None
    if static[3].room == 0 and not static[1].remembers:
        return jnp.full_like(outcome.gradient, int(GradientMode.forward))
    apart = outcome.record.stride > 1
    modes = int(GradientMode.checkpoints), int(GradientMode.recorded)
    return jnp.where(apart, *modes).astype(jnp.int32) + jnp.zeros_like(outcome.gradient)


def _recorded(inexact: Any, rest: Any, setup: Setup, static: Any) -> Outcome:
    """The loop with its record; states on the way and saved ones are differentiable."""

    @CustomJVP
    def run(inexact: Any, rest: Any, setup: Setup) -> Outcome:
        return _driven(inexact, rest, setup, static, record=True)

    @partial(run.defjvp, symbolic_zeros=True)
    def run_jvp(primals: Any, tangents: Any) -> Any:
        inexact, rest, setup = primals
        outcome = _recorded(inexact, rest, setup, static)
        dots = jax.tree.map(lambda _: None, outcome)
        if not static[1].remembers:
            change = changes(tangents[0], outcome)
            record = outcome.record
            assert record is not None
            kept = record.points is not None  # none where derivatives go forwards
            walk = changed(inexact, rest, setup, static, record, change, points=kept)
            record = dots.record._replace(points=walk.points)
            dots = dots._replace(
                state=walk.last[0], time=walk.time, saved=walk.saved[0], record=record
            )
        return outcome, dots

    outcome = run(inexact, rest, setup)
    assert outcome.record is not None
    # Times stay where they are, or move with their anchors.
    still = outcome.record._replace(offsets=jax.lax.stop_gradient(outcome.record.offsets))
    return outcome._replace(record=still)


def _driven(inexact: Any, rest: Any, setup: Setup, static: Any, record: bool) -> Outcome:
    """The loop of steps; of scalar programs and implicit methods, vmapped, in chunks."""

    def single(inexact: Any, rest: Any, setup: Setup, lanes: bool = False) -> Outcome:
        y0, args, times, stepper, max_steps = unpack(inexact, rest, setup, static)
        if record:
            stepper = stepper.for_derivatives(y0, args)
        fast = stepper.on_scalars(lanes)
        if record and lanes:  # written out, this half would take most of the time to compile
            fast = None if fast is None else in_loops(fast)
        rest_of_it = setup.first_step, setup.allowed, max_steps, record, static[3].room
        native = None if fast is None else _xla.native
        return integrate(fast or stepper, y0, args, times, *rest_of_it, native)

    y0, _, _, stepper, _ = unpack(inexact, rest, setup, static)
    on_scalars = stepper.on_scalars() is not None
    if jax.default_backend() != "cpu" or not (on_scalars or stepper.implicit):
        return single(inexact, rest, setup)
    at_once = LANES if on_scalars else at_once_implicit(y0.size)
    vmapped, given = partial(single, lanes=True), (inexact, rest, setup)
    return in_lanes(single, vmapped, *given, at_once=at_once, even=not on_scalars)


def _replay(rest: Any, setup: Setup, static: Any, outcome: Outcome, inexact: Any) -> SavedStates:
    """The saved states as a function of `inexact` alone, all steps taken again."""
    y0, args, times, stepper, _ = unpack(inexact, rest, setup, static)
    assert outcome.record is not None
    path = path_of(stepper, y0, args, times, outcome.record, ())
    walk = again(path, path.start, [], times.anchors(), times.saves, False)
    # What was not reached, or failed, is so again.
    found = jnp.isfinite(outcome.saved)
    return SavedStates(jnp.where(found, walk.saved[0], jnp.nan), walk.last[0], walk.time)
