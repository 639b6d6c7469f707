"""The differentiable solve: rows at the save times, with one derivative for every transform.

The derivative is that of the map from (state, args, times) to the rows at the FROZEN sequence of
accepted steps: step ends keep their distance from the start, knot or stop they are anchored to,
and move with it. The loop of steps is never differentiated; under any derivative it records where
it went, and the derivative goes the same way again.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxlag import _xla
from jaxlag._drive import Outcome, Times, drive
from jaxlag._gradient import GradientMode, Keep
from jaxlag._lanes import LANES, in_batches, in_lanes, lanes_first, zero_tangent
from jaxlag._lowering import elements
from jaxlag._scheme import Scheme
from jaxlag._status import Status
from jaxlag._variations import (
    Setup,
    changed,
    changes,
    filled,
    in_loops,
    one_step,
    path_of,
    unpack,
)
from jaxlag._walk import Clock, Walk, again

# Rows reached at once. An operation on thousands of numbers is one that XLA would share among
# cores, and cannot in a loop that is one native function: it fails to link. Beside lanes and
# directions of derivatives there is one row at a time; gradients of 400 rows take as long as with
# 64 at once or less.
ROWS_AT_ONCE = LANES


class Rows(NamedTuple):
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
    scheme: Any  # static half of the Scheme
    max_steps: int
    keep: Keep


def solve(problem: Problem) -> tuple[Rows, Outcome]:
    """Integrate and save; differentiable in y0, args and times."""
    inexact, rest, setup, static = halves(problem)

    @jax.custom_jvp
    def run(inexact: Any, rest: Any, setup: Setup) -> tuple[Rows, Outcome]:
        return lanes_first(_forward(inexact, rest, setup, static))

    @partial(run.defjvp, symbolic_zeros=True)
    def run_jvp(primals: Any, tangents: Any) -> Any:
        inexact, rest, setup = primals
        outcome = _recorded(inexact, rest, setup, static)
        change = changes(tangents[0], outcome)
        assert outcome.record is not None
        if static[1].remembers:
            function = partial(_replay, rest, setup, static, outcome)
            rows, rows_dot, failed = jax.jvp(
                function, (inexact,), (filled(change, inexact),), has_aux=True
            )
        else:
            on = Walk((outcome.state, None), outcome.row_state, None)
            on_dot = changed(inexact, rest, setup, static, outcome.record, change)
            function = partial(_reached, rest, setup, static, outcome)
            rows, rows_dot, failed = jax.jvp(
                function, (inexact, on), (filled(change, inexact), on_dot), has_aux=True
            )
        mode = _mode(outcome, static)
        outcome = _judged(outcome, rows, failed, static[1])._replace(gradient=mode)
        rows, outcome = lanes_first((rows, outcome))
        return (rows, outcome), (rows_dot, jax.tree.map(zero_tangent, outcome))

    return run(inexact, rest, setup)


def halves(problem: Problem) -> tuple[Any, Any, Setup, Any]:
    """A problem as (differentiable leaves, other arrays, setup, static rest)."""
    inexact, rest = eqx.partition(problem[:3], eqx.is_inexact_array)
    rest, static = eqx.partition(rest, eqx.is_array)
    return inexact, rest, problem.setup, (static, problem.scheme, problem.max_steps, problem.keep)


def _forward(inexact: Any, rest: Any, setup: Setup, static: Any) -> tuple[Rows, Outcome]:
    outcome = _driven(inexact, rest, setup, static, record=False)
    fast = static[1].by_element(lanes=True, in_loop=False)

    def saved(
        inexact: Any, rest: Any, setup: Setup, outcome: Outcome, at_once: int = ROWS_AT_ONCE
    ) -> tuple[Rows, Array]:
        y0, args, times, scheme, _ = unpack(inexact, rest, setup, static)
        fast = scheme.by_element(lanes=True, in_loop=False)
        y0 = y0 if fast is None else tuple(elements(y0))
        if outcome.row_time is None:
            states = (jax.tree.map(lambda a, b: jnp.stack([a, b]), y0, outcome.state), None)
            starts = jnp.stack([times.start, outcome.time])
        else:
            starts, states = outcome.row_time, outcome.row_state
        on = fast or scheme, args, times, starts, states, outcome, outcome.state, outcome.time
        rows, failed = _rows(*on, at_once=at_once)
        if fast is not None:
            rows = rows._replace(saved=jnp.stack(rows.saved, -1), state=jnp.stack(rows.state))
        return rows, failed

    given = inexact, rest, setup, outcome
    if fast is None or jax.default_backend() != "cpu" or outcome.row_time is None:
        rows, failed = saved(*given)
    else:
        rows, failed = in_lanes(saved, partial(saved, at_once=1), *given)
    return rows, _judged(outcome, rows, failed, static[1])


def _judged(outcome: Outcome, rows: Rows, failed: Array, scheme: Scheme) -> Outcome:
    """What is said of a solve, without what was kept on the way."""
    lost = failed & (outcome.status == int(Status.ok))
    fault = Status.projection_failed if scheme.moves else Status.implicit_solve_failed
    status = jnp.where(lost, int(fault), outcome.status)
    outcome = outcome._replace(status=status.astype(jnp.int32), state=rows.state)
    return outcome._replace(row_time=None, row_state=None, record=None)


def _mode(outcome: Outcome, static: Any) -> Array:
    """How reverse derivatives go through the steps."""
    assert outcome.record is not None
    if static[3].room == 0 and not static[1].remembers:
        return jnp.full_like(outcome.gradient, int(GradientMode.forward))
    apart = outcome.record.stride > 1
    modes = int(GradientMode.checkpoints), int(GradientMode.recorded)
    return jnp.where(apart, *modes).astype(jnp.int32) + jnp.zeros_like(outcome.gradient)


def _recorded(inexact: Any, rest: Any, setup: Setup, static: Any) -> Outcome:
    """The loop with its record; states on the way are differentiable."""

    @jax.custom_jvp
    def run(inexact: Any, rest: Any, setup: Setup) -> Outcome:
        return lanes_first(_driven(inexact, rest, setup, static, record=True))

    @partial(run.defjvp, symbolic_zeros=True)
    def run_jvp(primals: Any, tangents: Any) -> Any:
        inexact, rest, setup = primals
        outcome = _recorded(inexact, rest, setup, static)
        dots = jax.tree.map(zero_tangent, outcome)
        if not static[1].remembers:
            change = changes(tangents[0], outcome)
            record = outcome.record
            assert record is not None
            on = changed(inexact, rest, setup, static, record, change, points=True)
            record = dots.record._replace(points=on.points)
            dots = dots._replace(state=on.last[0], row_state=on.rows, record=record)
        return outcome, dots

    outcome = run(inexact, rest, setup)
    assert outcome.record is not None
    # Times stay where they are, or move with their anchors.
    still = outcome.record._replace(offsets=jax.lax.stop_gradient(outcome.record.offsets))
    row_time = jax.lax.stop_gradient(outcome.row_time)
    return outcome._replace(record=still, row_time=row_time)


def _driven(inexact: Any, rest: Any, setup: Setup, static: Any, record: bool) -> Outcome:
    """The loop of steps, on elements where there is a form for them; vmapped, in chunks then."""

    def single(inexact: Any, rest: Any, setup: Setup, lanes: bool = False) -> Outcome:
        y0, args, times, scheme, max_steps = unpack(inexact, rest, setup, static)
        if record:
            scheme = scheme.for_derivatives(times.start, y0, args)
        fast = scheme.by_element(lanes)
        if fast is not None:
            scheme, y0 = fast, tuple(elements(y0))
        # Buffers that lanes write to at places of their own are no plain operations.
        plain = fast is not None and not (lanes and times.saves.shape[0] > 2)
        rest_of_it = setup.first_step, setup.allowed, max_steps, record, static[3].room
        native = _xla.native if plain else None
        return drive(scheme, y0, args, times, *rest_of_it, native, lanes or fast is None)

    scheme = unpack(inexact, rest, setup, static)[3]
    if scheme.by_element() is None or jax.default_backend() != "cpu":
        return single(inexact, rest, setup)
    return in_lanes(single, partial(single, lanes=True), inexact, rest, setup)


def _rows(
    scheme: Scheme,
    args: Any,
    times: Times,
    starts: Float[Array, " s"],
    states: PyTree,
    outcome: Outcome,
    state: PyTree,
    time: Array,
    differentiable: bool = False,
    at_once: int = ROWS_AT_ONCE,
) -> tuple[Rows, Bool[Array, ""]]:
    """Reach every save time by one step of the solver itself from the last state before it.

    A step shorter than an accepted one is at least as accurate, whatever the solver: saved rows
    keep its order, which its interpolant need not. The flag says whether one of these steps
    failed; its row is NaN.
    """
    saves, reached, inside = times.saves, outcome.reached, outcome.inside
    if saves.shape[0] > 2:

        def step(row: tuple[Array, Array, PyTree]) -> tuple[PyTree, Array]:
            t0, t1, state = row
            (y, _), solved = one_step(scheme, args, t0, t1, state, jnp.array(False), differentiable)
            finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(y)]
            return y, solved & jnp.all(jnp.stack(finite))

        def step_all(states: PyTree) -> tuple[PyTree, Array]:
            ends = jnp.where(inside, saves, starts)
            return in_batches(step, (starts, ends, states), saves.shape[0], at_once)

        # Rows that need no step must not see one: the field may not be finite where they are.
        safe = jax.tree.map(lambda s: jnp.where(_like(inside, s), s, s[:1]), states)
        stepped, good = jax.lax.cond(
            eqxi.unvmap_any(jnp.any(inside)),
            step_all,
            lambda states: (states[0], jnp.ones_like(inside)),
            safe,
        )
        y = jax.tree.map(lambda a, b: jnp.where(_like(inside, a), a, b), stepped, states[0])
        missed = inside & ~good
        reached = reached & ~missed
    else:
        y, missed = states[0], jnp.zeros_like(inside)
    saved = jax.tree.map(lambda s: jnp.where(_like(reached, s), s, jnp.nan), y)
    return Rows(saved, state, time), jnp.any(missed)


def _like(mask: Array, leaf: Array) -> Array:
    return mask.reshape(mask.shape + (1,) * (leaf.ndim - mask.ndim))


def _reached(
    rest: Any, setup: Setup, static: Any, outcome: Outcome, inexact: Any, on: Walk
) -> tuple[Rows, Array]:
    """The rows as a differentiable function of `inexact` and of the states on the way."""
    y0, args, times, scheme, _ = unpack(inexact, rest, setup, static)
    scheme, record = in_loops(scheme), outcome.record
    assert record is not None

    def stacked(y: Any) -> Any:
        return jnp.stack(y, -1) if isinstance(y, tuple) else y

    clock, anchors = Clock(times, record), times.anchors()
    last, time = stacked(on.last[0]), clock.time(record.turns - 1, anchors)
    if on.rows is None:
        states = (jnp.stack([y0, last]), None)
        starts = jnp.stack([times.start, time])
    else:
        assert record.row_turn is not None
        states = (stacked(on.rows[0]), on.rows[1])
        starts = jax.vmap(lambda k: clock.time(k, anchors))(record.row_turn - 1)
    given = scheme, args, times, starts, states, outcome, last, time
    return _rows(*given, differentiable=True, at_once=1)


def _replay(
    rest: Any, setup: Setup, static: Any, outcome: Outcome, inexact: Any
) -> tuple[Rows, Array]:
    """The rows as a function of `inexact` alone, all steps taken again."""
    y0, args, times, scheme, _ = unpack(inexact, rest, setup, static)
    assert outcome.record is not None
    path = path_of(scheme, y0, args, times, outcome.record, ())
    on = again(path, path.start, [], times.anchors(), False)
    return _reached(rest, setup, static, outcome, inexact, on)
