"""Where the steps of a motion go, and what a loop of steps tells of where it went."""

import enum
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree


class Times(NamedTuple):
    """What the grid of steps is anchored to, in tau, which is 0 at the start.

    Attributes:
        stop: where integration ends: the last save time, or the end of an input's table before it.
        knots: where inputs jump, sorted.
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
        """Save times between the first and the last, and then never."""
        never = jnp.full((1,), jnp.finfo(self.saves.dtype).max, self.saves.dtype)
        return jnp.concatenate([self.saves[1:-1], never])


class Reach(enum.IntEnum):
    """How a state is reached from the start of a step: see `_change_points`."""

    step = 0
    """By a step to it."""
    within = 1
    """By the polynomial through the ends of the step that it lies in."""
    beyond = 2
    """By that through the ends of a step half the way to it."""


def reached_time(reach: Array, t0: Array, t1: Array, end: Array) -> Array:
    """Where the step ends by which t1 is reached from t0.

    Args:
        reach: a `Reach`.
        t0: where the step starts.
        t1: time of the state that is wanted.
        end: of the accepted step that t1 lies in.
    """
    half = jnp.where(reach == Reach.beyond, t0 + 0.5 * (t1 - t0), t1)
    return jnp.where(reach == Reach.within, end, half)


class Record(NamedTuple):
    """What a loop did, turn by turn: enough to go the same way again without step-size control.

    Lanes share turns; a turn that takes a lane nowhere is one whose end is that of the last.

    Attributes:
        offsets: time after every turn, from its anchor, with which it moves.
        anchors: which of `Times.anchors` that is. None without knots: the start, or where the
            offset is negative the stop, at which the turn ends.
        jumps: whether the vector field jumps where the turn starts; None where it never does.
        points: states before turn 0, `stride`, 2 `stride`, ...; None where nobody needs them.
        stride: a power of 2.
        turns: how many there were.
        save_turn: save time i + 1 is reached from the state before this turn; beyond all turns
            where it was not reached, and after the last. None where there are no save times between
            the first and the last.
        save_reach: how, see `Reach`; None where no change points are passed.
        last_reach: the same of the last turn.
    """

    offsets: Float[Array, " N"]
    anchors: Int[Array, " N"] | None
    jumps: Bool[Array, " N"] | None
    points: PyTree | None
    stride: Int[Array, ""]
    turns: Int[Array, ""]
    save_turn: Int[Array, " r"] | None
    save_reach: Int[Array, " r"] | None = None
    last_reach: Int[Array, ""] | None = None


class Outcome(NamedTuple):
    """Where integration ended, and the states at the save times."""

    status: Int[Array, ""]
    time: Float[Array, ""]
    state: PyTree
    tried: Float[Array, ""]  # end of the last attempted step
    accepted: Int[Array, ""]
    attempted: Int[Array, ""]
    saved: PyTree  # leaves (s, ...), NaN where not reached
    missed: Int[Array, ""]  # how the step to one of them failed: a Status
    record: Record | None
    gradient: Int[Array, ""]  # a GradientMode
