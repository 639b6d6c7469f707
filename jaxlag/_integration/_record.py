"""Times of a motion, the record of its steps, and the outcome of the loop."""

import enum
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree


class Times(NamedTuple):
    """Times that anchor the grid of steps, in tau, which is 0 at the start.

    Attributes:
        stop: end of the integration: the last save time, or an earlier end of an input's table.
        knots: times where inputs jump, sorted.
        saves: the save times, the first one at the start.
    """

    stop: Float[Array, ""]
    knots: Float[Array, " k"] | None
    saves: Float[Array, " s"]

    def anchors(self) -> Float[Array, " a"]:
        """Start, stop and knots in one array; `Record.anchors` index it."""
        ends = jnp.stack([jnp.zeros_like(self.stop), self.stop])
        return ends if self.knots is None else jnp.concatenate([ends, self.knots])

    def dues(self) -> Float[Array, " r"]:
        """Save times between the first and the last, followed by the largest number."""
        never = jnp.full((1,), jnp.finfo(self.saves.dtype).max, self.saves.dtype)
        return jnp.concatenate([self.saves[1:-1], never])


class Reach(enum.IntEnum):
    """How a state is computed from the start of a step: see `_change_points`."""

    step = 0
    """By a step to it."""
    within = 1
    """By the polynomial through the ends of the step that contains it."""
    beyond = 2
    """By the polynomial through the ends of a step of half the length."""


def reached_time(reach: Array, t0: Array, t1: Array, end: Array) -> Array:
    """The end of the step that gives the state at t1.

    Args:
        reach: a `Reach`.
        t0: start of the step.
        t1: time of the required state.
        end: end of the accepted step that contains t1.
    """
    half = jnp.where(reach == Reach.beyond, t0 + 0.5 * (t1 - t0), t1)
    return jnp.where(reach == Reach.within, end, half)


class Record(NamedTuple):
    """The steps of a loop, recorded so that they are repeated without control.

    A step is recorded if any lane takes it. In a lane that does not take it, its end equals that of
    the step before.

    Attributes:
        offsets: time after every step, from its anchor; the time moves with the anchor.
        anchors: index of the anchor in `Times.anchors`. None without knots: the anchor is the start
            or, for a negative offset, the stop, and the step ends there.
        jumps: whether the vector field jumps at the start of the step; None if it never does.
        points: states before step 0, `stride`, 2 `stride`, ...; None if they are not needed.
        stride: a power of 2.
        steps: number of recorded steps.
        save_step: save time i + 1 is reached from the state before this step; beyond all steps
            if it was not reached, and after the last. None if there are no save times between
            the first and the last.
        save_reach: how it is reached, see `Reach`; None if no change points are passed.
        last_reach: the same for the last step.
    """

    offsets: Float[Array, " N"]
    anchors: Int[Array, " N"] | None
    jumps: Bool[Array, " N"] | None
    points: PyTree | None
    stride: Int[Array, ""]
    steps: Int[Array, ""]
    save_step: Int[Array, " r"] | None
    save_reach: Int[Array, " r"] | None = None
    last_reach: Int[Array, ""] | None = None


class Outcome(NamedTuple):
    """The end of the integration, and the states at the save times."""

    status: Int[Array, ""]
    time: Float[Array, ""]
    state: PyTree
    tried: Float[Array, ""]  # end of the last attempted step
    accepted: Int[Array, ""]
    attempted: Int[Array, ""]
    saved: PyTree  # leaves (s, ...), NaN where not reached
    missed: Int[Array, ""]  # the Status of a failed step to a save time
    record: Record | None
    gradient: Int[Array, ""]  # a GradientMode
