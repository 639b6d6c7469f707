"""RecordedMotion: the recorded steps as the derivatives use them."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from jaxlag._core import _xla
from jaxlag._core._buffer_entries import entry_of
from jaxlag._integration._record import Record, Times, reached_time


class SolveTangents(NamedTuple):
    """States of a motion, or their tangents or cotangents.

    Attributes:
        last: state after the last step.
        time: its time.
        saved: states at the save times, (s, ...).
        points: states at the points of the record; None if they are not needed.
    """

    last: PyTree
    time: Array
    saved: PyTree
    points: PyTree | None


class InputTangents(NamedTuple):
    """Tangents of the inputs of a motion; None for inputs that do not vary.

    Attributes:
        y0: of the start, an array.
        args: of some leaves of the arguments.
        anchors: of `Times.anchors`.
        saves: of `Times.saves`; given if those of the anchors are.
    """

    y0: Array | None
    args: list[Array]
    anchors: Array | None
    saves: Array | None


class StepTimes(NamedTuple):
    """End times of the recorded steps of a motion; step -1 ends at the start."""

    times: Times
    record: Record

    def time(self, k: Array, anchors: Array) -> Array:
        """Time after step k."""
        offset, anchor = at(self.record.offsets, k), self.anchor(k)
        if self.record.anchors is None:
            offset = jnp.maximum(offset, 0.0)
        return jnp.where(k < 0, anchors[0], anchors[anchor] + offset)

    def anchor(self, k: Array) -> Array:
        """The anchor of this time."""
        if self.record.anchors is not None:
            return jnp.where(k < 0, 0, at(self.record.anchors, k))
        return ((k >= 0) & (at(self.record.offsets, k) < 0)).astype(jnp.int32)

    def jump(self, k: Array) -> Array | None:
        """Whether the vector field jumps at the start of step k."""
        return None if self.record.jumps is None else at(self.record.jumps, k)

    def reach(
        self, end: Array, anchors: Array, save: Array | None = None, r: Array | None = None
    ) -> Array | None:
        """How the end of a step, or save time r between the first and the last, is reached.

        Args:
            end: time after the step.
            anchors: of `Times.anchors`.
            save: whether it is a save time.
            r: its index.
        """
        if self.record.last_reach is None:
            return None
        reach = jnp.where(end >= anchors[1], self.record.last_reach, 0)
        if save is None:
            return reach
        assert r is not None
        return jnp.where(save, at(self.record.save_reach, r), reach)

    @property
    def last(self) -> Array:
        """Index of the last step."""
        return self.record.steps - 1


class RecordedMotion(NamedTuple):
    """A recorded motion: the inputs of the loop and its record.

    Attributes:
        step: (args, t0, t1, state, jump, time) -> the state at a time, by a step from t0 to t1.
        start: the state before the first step, as the step takes it.
        args: leaves of the arguments.
        tree: of the arguments.
        moving: indices of the leaves that may vary.
        windows: (args, t0) -> (args as a step from t0 reads them: of each table two entries; where
            these start in the leaves that may vary, None for leaves that are no tables).
        clock: times of the steps.
        stages: number of stages in a step, 0 if it has none.
        plain: whether XLA may compile a sweep to one native function. False if lanes gather at
            different indices: XLA overestimates the cost of such a gather, and splits it over
            threads.
        lockstep: whether all lanes of a vmap go back over steps of the same index at once, which
            are read faster, or each over its own, which need not wait for others' save times.
        evaluate: (function, *args) -> function(*args), for a function of the arrays of a step.
    """

    step: Callable
    start: PyTree
    args: list
    tree: Any
    moving: tuple[int, ...]
    windows: Callable
    clock: StepTimes
    stages: int
    plain: bool
    lockstep: bool
    evaluate: Callable

    def native(self, loop: Callable, *args: Any) -> Any:
        """loop(*args), compiled to one native function if possible."""
        return _xla.native(loop, *args, stages=self.stages) if self.plain else loop(*args)

    def with_args(self, moved: Sequence[Array], leaves: Sequence[Any] | None = None) -> Any:
        """The arguments with new values of the leaves that may vary."""
        leaves = list(self.args if leaves is None else leaves)
        for i, leaf in zip(self.moving, moved, strict=True):
            leaves[i] = leaf
        return jax.tree.unflatten(self.tree, leaves)

    def ahead(
        self,
        args: Any,
        t: Array,
        end: Array,
        jump: Array | None,
        state: PyTree,
        reach: Array | None = None,
        step_end: Array | None = None,
    ) -> PyTree:
        """The state at `end`, by a step from t, or within the step that ends at `step_end`."""
        jump = jnp.array(False) if jump is None else jump
        if reach is None:
            return self.step(args, t, end, state, jump, end)
        assert step_end is not None
        return self.step(args, t, reached_time(reach, t, end, step_end), state, jump, end)

    def recompute(self, k: Array, anchors: Array, state: PyTree) -> PyTree:
        """The state after step k, with unchanged arguments."""
        t, end = self.clock.time(k - 1, anchors), self.clock.time(k, anchors)
        reach = self.clock.reach(end, anchors)
        with_moved, moved, _ = self.local(t)
        jump = self.clock.jump(k)

        def step(state: PyTree, moved: list[Array], t: Array, end: Array) -> PyTree:
            return self.ahead(with_moved(moved), t, end, jump, state, reach, end)

        return self.evaluate(step, state, moved, t, end)

    def moved(self) -> list[Array]:
        """The leaves of the arguments that may vary."""
        return [self.args[i] for i in self.moving]

    def local(self, t: Array) -> tuple[Callable, list[Array], list[Array | None]]:
        """The parts of the arguments that a step from t reads.

        Returns:
            function from varying leaves to arguments, these leaves (of tables two entries), where
            these start.
        """
        args, starts = self.windows(self.with_args(self.moved()), t)
        leaves = jax.tree.leaves(args, is_leaf=lambda x: x is None)
        moved = [leaves[i] for i in self.moving]
        return partial(self.with_args, leaves=leaves), moved, [starts[i] for i in self.moving]


def at(buffer: PyTree, k: Array) -> PyTree:
    """Entry k of a buffer; the first one for negative k."""
    return entry_of(buffer, jnp.maximum(k, 0))


def pick(use: Array, new: PyTree, old: PyTree) -> PyTree:
    """One of two states."""
    return jax.tree.map(lambda a, b: jnp.where(use, a, b), new, old)


def all_saved(first: PyTree, saved: PyTree | None, last: PyTree, reached: Array) -> PyTree:
    """All saved states, from those between the first and the last; zero for unreached ones."""

    def of(a: Array, between: Array | None, b: Array) -> Array:
        parts = [a[None], jnp.where(reached, b, 0.0)[None]]
        if between is not None:
            parts.insert(1, between[:-1])
        return jnp.concatenate(parts)

    if saved is None:
        return jax.tree.map(lambda a, b: of(a, None, b), first, last)
    return jax.tree.map(of, first, saved, last)


def arrived(path: RecordedMotion, anchors: Array) -> Array:
    """Whether the last save time was reached."""
    clock = path.clock
    return clock.time(clock.last, anchors) >= clock.times.saves[-1]
