"""The derivative of the intermediate states of a solve, as one linear map."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PyTree

from jaxlag._core._batching import LANES, in_batches, is_faster_vectorized
from jaxlag._core._linear_map import LinearMap, Many, linear
from jaxlag._gradient._recorded_motion import (
    InputTangents,
    RecordedMotion,
    SolveTangents,
    StepTimes,
)
from jaxlag._gradient._rescan import again
from jaxlag._gradient._split_problem import SplitProblem, Static
from jaxlag._gradient._tangent_and_adjoint import adjoint_sweep, tangent_sweep
from jaxlag._integration._record import Outcome, Record, Times
from jaxlag._integration._stepper import Stepper
from jaxlag._integration._tableaus import remembers, with_stages
from jaxlag._integration._vector_loop import WIDTH, NotVectorizable, lane_call, may_vectorize


def changes(tangents: Any, outcome: Outcome) -> Any:
    """The tangents of the varying inputs; None for the others.

    A trajectory without steps depends on its start alone: its other derivatives, which may
    be nonfinite, are set to 0.
    """
    moved = outcome.accepted > 0
    return jax.tree.map(lambda dot: jnp.where(moved, dot, 0.0), tangents)


def filled(change: Any, like: Any) -> Any:
    """The tangents with zeros for inputs that do not vary."""

    def fill(x: Any, dot: Any) -> Any:
        return jnp.zeros_like(x) if dot is None and x is not None else dot

    return jax.tree.map(fill, like, change, is_leaf=lambda x: x is None)


def changed(
    problem: SplitProblem, record: Record, change: Any, points: bool = False
) -> SolveTangents:
    """The tangents of the states, also at the points of the record if requested."""
    y0_dot, args_dot, times_dot = change
    dots = jax.tree.leaves(args_dot, is_leaf=lambda x: x is None)
    moving = tuple(i for i, dot in enumerate(dots) if dot is not None)
    times, anchors_dot, saves_dot = problem.motion[2], None, None
    if jax.tree.leaves(times_dot):
        whole = filled(times_dot, times)
        anchors_dot, saves_dot = jax.jvp(Times.anchors, (times,), (whole,))[1], whole.saves
    x = InputTangents(y0_dot, [dots[i] for i in moving], anchors_dot, saves_dot)
    vectorizes = problem.static.capacity > 0 and may_vectorize(problem.stepper)
    parts = y0_dot is not None, anchors_dot is not None, points
    kind = _Kind(problem.static, moving, *parts, vectorizes)
    return linear(_map(kind), (*problem.traced, record), x)


class _Kind(NamedTuple):
    """The varying inputs, and the results that are needed."""

    static: Static
    moving: tuple[int, ...]
    start: bool
    times: bool
    points: bool
    vectorizes: bool


def _map(kind: _Kind, form: str = "alone") -> LinearMap:
    """The variational equations as a linear map.

    Args:
        kind: of the map.
        form: "alone", "lanes" to be vmapped, "vectorized" to be vmapped for many lanes.
    """

    def path(r: Any) -> tuple[RecordedMotion, Any]:
        differentiable, arrays, setup, record = r
        problem = SplitProblem(differentiable, arrays, setup, kind.static)
        (y0, args, times), stepper = problem.motion, problem.stepper
        fast = stepper.on_scalars(lanes=form == "lanes")
        return path_of(stepper, y0, args, times, record, kind.moving, fast, form), y0

    def forward(r: Any, x: InputTangents) -> SolveTangents:
        return tangent_sweep(path(r)[0], x, kind.points)

    def like(r: Any) -> tuple[RecordedMotion, InputTangents]:
        way, y0 = path(r)
        times = way.clock.times
        moves = (times.anchors(), times.saves) if kind.times else (None, None)
        return way, InputTangents(y0 if kind.start else None, way.moved(), *moves)

    def backward(r: Any, y: SolveTangents) -> InputTangents:
        way, change = like(r)
        return adjoint_sweep(way, change, y)

    def by_directions(r: Any, y: SolveTangents) -> InputTangents:
        """The same from `forward`, for one direction of x after another."""
        return _transposed(partial(forward, r), like(r)[1], y)

    def plain(r: Any, x: InputTangents) -> SolveTangents:
        differentiable, arrays, setup, record = r
        problem = SplitProblem(differentiable, arrays, setup, kind.static)
        y0, args, times = problem.motion
        way = path_of(problem.stepper, y0, args, times, record, kind.moving)

        def motion(y0: Array, moved: list, anchors: Array, saves: Array) -> SolveTangents:
            return again(way, (y0, None), moved, anchors, saves, kind.points)

        given = (y0, way.moved(), times.anchors(), times.saves)
        dots = (
            jnp.zeros_like(at) if dot is None else dot
            for at, dot in zip((y0, *given[2:]), (x.y0, x.anchors, x.saves), strict=True)
        )
        y0_dot, *times_dot = dots
        return jax.jvp(motion, given, (y0_dot, list(x.args), *times_dot))[1]

    reverse = backward if kind.static.capacity else by_directions
    if form != "alone":
        return LinearMap(forward, reverse, plain)
    in_lanes = _map(kind, "lanes")
    many = _vectorized(kind, in_lanes) if kind.vectorizes else None
    return LinearMap(forward, reverse, plain, in_lanes=in_lanes, many=many)


def _vectorized(kind: _Kind, in_lanes: LinearMap) -> Many:
    """The map of many trajectories, whose steps back are one vectorized loop over them."""
    vectorized = _map(kind, "vectorized")

    def backward(r: Any, y: SolveTangents) -> InputTangents:
        try:
            return vectorized.backward(r, y)
        except NotVectorizable:
            return in_lanes.backward(r, y)

    def steps(r: Any) -> Array:
        record = r[-1]
        return record.steps

    suits = partial(is_faster_vectorized, max_steps=kind.static.max_steps)
    return Many(replace(in_lanes, backward=backward, at_once=WIDTH), suits, steps)


def _transposed(function: Callable, like: Any, y: Any) -> Any:
    """A^T y of a linear function from its values in the directions of all numbers of x."""
    leaves, tree = jax.tree.flatten(like)
    ends = np.cumsum([leaf.size for leaf in leaves])
    widest = max((leaf.dtype for leaf in leaves), key=lambda dtype: dtype.itemsize)

    def split(x: Array) -> Any:
        parts = jnp.split(x, ends[:-1])
        pairs = zip(parts, leaves, strict=True)
        shaped = [part.reshape(leaf.shape).astype(leaf.dtype) for part, leaf in pairs]
        return jax.tree.unflatten(tree, shaped)

    def component(x: Array) -> Array:
        pairs = zip(jax.tree.leaves(function(split(x))), jax.tree.leaves(y), strict=True)
        parts = [jnp.sum(a * b).astype(widest) for a, b in pairs]
        return jnp.sum(jnp.stack(parts))

    count = int(ends[-1])
    return split(in_batches(component, jnp.eye(count, dtype=widest), count, LANES))


def path_of(
    stepper: Stepper,
    y0: Array,
    args: Any,
    times: Times,
    record: Record,
    moving: tuple[int, ...],
    fast: Stepper | None = None,
    form: str = "alone",
) -> RecordedMotion:
    """The recorded motion, with steps that loop over their stages unless it is vectorized.

    Unrolled, derivatives of steps of order 8 take 3 to 5 times as long to compile (double
    pendulum: a gradient 5.3 | 2.3 s, a Hessian 22 | 4.5 s, a gradient of lanes 15 | 4.5 s) and
    run 0.9 to 1.4 times as fast.
    """
    vectorized = form == "vectorized"
    taken = stepper if fast is None else fast
    taken = taken if vectorized else in_loops(taken)

    def step(args: Any, t0: Array, t1: Array, state: PyTree, jump: Array, wanted: Array) -> PyTree:
        return one_step(taken, args, t0, t1, state, jump, True, wanted)[0]

    zero = jnp.zeros_like(times.stop)
    memory = stepper.begin(zero, times.stop, y0, args) if remembers(stepper.solver) else None
    leaves, tree = jax.tree.flatten(args, is_leaf=lambda x: x is None)
    stages = getattr(getattr(stepper.solver, "tableau", None), "num_stages", 0)
    clock, start = StepTimes(times, record), (y0, memory)
    plain = form == "alone" or (form == "lanes" and record.save_step is None)
    evaluate = lane_call if vectorized else lambda function, *args: function(*args)
    parts = leaves, tree, moving, stepper.windows, clock, stages, plain
    lockstep = not vectorized or record.save_step is None
    return RecordedMotion(step, start, *parts, lockstep, evaluate)


def in_loops(stepper: Stepper) -> Stepper:
    """The stepper with loops over stages that JAX differentiates in any mode."""
    return eqx.tree_at(lambda s: s.solver, stepper, with_stages(stepper.solver, "bounded"))


def one_step(
    stepper: Stepper,
    args: Any,
    t0: Array,
    t1: Array,
    state: PyTree,
    jump: Array,
    differentiable: bool,
    wanted: Array | None = None,
) -> tuple[PyTree, Bool[Array, ""]]:
    """One step from (y, memory), and whether it was solved; without memory nothing is carried over.

    Near change points the state may be `wanted` at another time than the end of the step.
    """
    y0, memory = y, _ = state
    args = stepper.within(args, t0)
    jumped: Any = jump
    if not remembers(stepper.solver):
        memory, jumped = stepper.afresh(t0, t1, y, args)
    y, _, memory, solved = stepper.step(t0, t1, y, args, memory, jumped)
    y, verdict = stepper.settled(t1, y, args, differentiable)
    if wanted is not None and args.lengths is not None:
        y = stepper.reached(t0, y0, t1, y, wanted, wanted != t1, args)
    return (y, memory if remembers(stepper.solver) else None), solved & verdict.good
