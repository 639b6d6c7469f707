"""The differentiable solve: rows at the save times, with one derivative for every transform.

The derivative is that of the map from (state, args, times) to the rows at the FROZEN sequence of
accepted steps: step ends keep their distance from the start, knot or stop they are anchored to,
and move with it. The forward loop is never differentiated; under any derivative it records its
grid, and the steps are taken again on that grid, as a scan that JAX differentiates in any mode
and to any order.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxlag._drive import CHUNK, Grid, Outcome, Scheme, Times, drive, with_stages
from jaxlag._status import Status

# Rows interpolated at once: bounds the memory of a vmapped solve.
ROWS_AT_ONCE = 64


class Rows(NamedTuple):
    """The solution at the save times, and where the solve ended."""

    saved: PyTree  # leaves (s, ...), NaN where not reached
    state: PyTree  # last good state
    time: Float[Array, ""]  # last good time


class Setup(NamedTuple):
    """What a solve needs and no derivative is taken of."""

    first_step: Array | None
    allowed: Bool[Array, ""]
    scheme: Any  # traced half of the Scheme


class Problem(NamedTuple):
    """A start, the vector field's arguments, the times, and how to solve."""

    y0: PyTree
    args: Any
    times: Times
    setup: Setup
    scheme: Any  # static half of the Scheme
    max_steps: int


def solve(problem: Problem) -> tuple[Rows, Outcome]:
    """Integrate and save; differentiable in y0, args and times."""
    inexact, rest, setup, static = halves(problem)

    @jax.custom_jvp
    def run(inexact: Any, rest: Any, setup: Setup) -> tuple[Rows, Outcome]:
        return _forward(inexact, rest, setup, static, record=False)

    @run.defjvp
    def run_jvp(primals: Any, tangents: Any) -> Any:
        inexact, rest, setup = primals
        frozen = jax.lax.stop_gradient(inexact)
        _, outcome = _forward(frozen, rest, setup, static, record=True)
        function = partial(_replay, rest, setup, static, outcome)
        rows, rows_dot = jax.jvp(function, (inexact,), (tangents[0],))
        outcome = outcome._replace(grid=None)
        return (rows, outcome), (rows_dot, jax.tree.map(_zero_tangent, outcome))

    return run(inexact, rest, setup)


def halves(problem: Problem) -> tuple[Any, Any, Setup, Any]:
    """A problem as (differentiable leaves, other arrays, setup, static rest)."""
    inexact, rest = eqx.partition(problem[:3], eqx.is_inexact_array)
    rest, static = eqx.partition(rest, eqx.is_array)
    return inexact, rest, problem.setup, (static, problem.scheme, problem.max_steps)


def _zero_tangent(x: Array) -> Any:
    if jnp.issubdtype(x.dtype, jnp.inexact):
        return jnp.zeros_like(x)
    return jnp.zeros(x.shape, jax.dtypes.float0)


def _unpack(inexact: Any, rest: Any, setup: Setup, static: Any) -> Any:
    static_problem, static_scheme, max_steps = static
    y0, args, times = eqx.combine(inexact, rest, static_problem)
    return y0, args, times, eqx.combine(setup.scheme, static_scheme), max_steps


def _forward(
    inexact: Any, rest: Any, setup: Setup, static: Any, record: bool
) -> tuple[Rows, Outcome]:
    y0, args, times, scheme, max_steps = _unpack(inexact, rest, setup, static)
    outcome = drive(scheme, y0, args, times, setup.first_step, setup.allowed, max_steps, record)
    if outcome.row_time is None:
        states = (jax.tree.map(lambda a, b: jnp.stack([a, b]), y0, outcome.state), None)
        starts = jnp.stack([times.start, outcome.time])
    else:
        starts, states = outcome.row_time, outcome.row_state
    rows, failed = _rows(scheme, args, times, starts, states, outcome, outcome.state, outcome.time)
    lost = failed & (outcome.status == int(Status.ok))
    status = jnp.where(lost, int(Status.implicit_solve_failed), outcome.status)
    outcome = outcome._replace(status=status.astype(jnp.int32))
    return rows, outcome._replace(row_time=None, row_state=None)


def _rows(
    scheme: Scheme,
    args: Any,
    times: Times,
    starts: Float[Array, " s"],
    states: PyTree,
    outcome: Outcome,
    state: PyTree,
    time: Array,
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
            (y, _), solved = _step(scheme, args, t0, t1, state, jnp.array(False))
            finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(y)]
            return y, solved & jnp.all(jnp.stack(finite))

        def step_all(states: PyTree) -> tuple[PyTree, Array]:
            ends = jnp.where(inside, saves, starts)
            return _in_batches(step, (starts, ends, states), saves.shape[0])

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


def _in_batches(function: Callable, rows: PyTree, count: int) -> PyTree:
    """function over `count` rows, in equal batches; the last row fills the last batch up."""
    batches = -(-count // ROWS_AT_ONCE)
    size = -(-count // batches)

    def batch(leaf: Array) -> Array:
        filled = jnp.minimum(jnp.arange(batches * size), count - 1)
        return leaf[filled].reshape(batches, size, *leaf.shape[1:])

    if batches == 1:
        return jax.vmap(function)(rows)
    results = jax.lax.map(jax.vmap(function), jax.tree.map(batch, rows))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], results)


def _step(
    scheme: Scheme, args: Any, t0: Array, t1: Array, state: PyTree, jump: Array
) -> tuple[PyTree, Bool[Array, ""]]:
    """One step from (y, memory), and whether it was solved; without memory it starts afresh."""
    y, memory = state
    if not scheme.remembers:
        memory, jump = scheme.begin(t0, t1, y, args), jnp.array(True)
    y, _, memory, solved = scheme.step(t0, t1, y, args, memory, jump)
    return (y, memory if scheme.remembers else None), solved


def _like(mask: Array, leaf: Array) -> Array:
    return mask.reshape(mask.shape + (1,) * (leaf.ndim - mask.ndim))


def _replay(rest: Any, setup: Setup, static: Any, outcome: Outcome, inexact: Any) -> Rows:
    """The rows as a differentiable function of `inexact`, on the recorded grid."""
    grid = outcome.grid
    assert grid is not None
    # A trajectory that took no step depends on nothing but its start: keep NaN out of derivatives.
    moved = grid.count > 0
    inexact = jax.tree.map(lambda x: jnp.where(moved, x, jax.lax.stop_gradient(x)), inexact)
    y0, args, times, scheme, _max_steps = _unpack(inexact, rest, setup, static)
    scheme = eqx.tree_at(lambda s: s.solver, scheme, with_stages(scheme.solver, "bounded"))
    ends = times.anchors()[grid.anchor] + grid.offset
    memory = scheme.begin(times.start, times.stop, y0, args) if scheme.remembers else None
    start = (y0, memory)
    state, history = _steps(scheme, args, times.start, ends, grid, start)
    marks = jnp.concatenate([times.start[None], ends])
    states = jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest])[grid.row_step], start, history
    )
    starts = marks[grid.row_step]
    return _rows(scheme, args, times, starts, states, outcome, state[0], marks[grid.count])[0]


def _steps(
    scheme: Scheme, args: Any, t0: Array, ends: Float[Array, " N"], grid: Grid, start: PyTree
) -> tuple[PyTree, PyTree]:
    """Take the recorded steps, ending at `ends`; the last state, and the state after each.

    The scan skips whole chunks that no lane of a vmapped solve needs. Slots past the last step
    repeat the first one and drop its result, so that no derivative meets a state out of reach.
    """
    used = jnp.arange(ends.shape[0], dtype=jnp.int32) < grid.count
    begins = jnp.where(used, jnp.concatenate([t0[None], ends[:-1]]), t0)
    ends = jnp.where(used, ends, ends[0])
    start = jax.tree.map(jnp.asarray, start)

    @partial(jax.checkpoint, prevent_cse=False)
    def step(t0: Array, t1: Array, state: PyTree, jump: Array) -> PyTree:
        return _step(scheme, args, t0, t1, state, jump)[0]

    def one(state: PyTree, slot: tuple[Array, Array, Array, Array]) -> tuple[PyTree, PyTree]:
        t0, t1, use, jump = slot
        pick = partial(jax.tree.map, lambda a, b: jnp.where(use, a, b))
        state = pick(step(t0, t1, pick(state, start), jump), state)
        return state, state

    def chunk(state: PyTree, slots: Any) -> tuple[PyTree, PyTree]:
        def skip(state: PyTree) -> tuple[PyTree, PyTree]:
            return state, jax.tree.map(lambda x: jnp.broadcast_to(x, (CHUNK, *x.shape)), state)

        def take(state: PyTree) -> tuple[PyTree, PyTree]:
            return jax.lax.scan(one, state, slots)

        return jax.lax.cond(eqxi.unvmap_any(slots[2]), take, skip, state)

    slots = jax.tree.map(lambda x: x.reshape(-1, CHUNK), (begins, ends, used, grid.jump))
    last, history = jax.lax.scan(chunk, start, slots)
    return last, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), history)
