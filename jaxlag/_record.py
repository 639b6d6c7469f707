"""Where the steps of a motion go, and what a loop of steps tells of where it went."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree


class Times(NamedTuple):
    """What the grid of steps is anchored to, in tau, which is 0 at the start.

    Attributes:
        stop: where integration ends: the last save time, or the end of an input's table before it.
        knots: where inputs jump, sorted.
        saves: when rows are saved, the first one at the start.
    """

    stop: Float[Array, ""]
    knots: Float[Array, " k"] | None
    saves: Float[Array, " s"]

    def anchors(self) -> Float[Array, " a"]:
        """Start, stop and knots in one row; `Record.anchors` index it."""
        ends = jnp.stack([jnp.zeros_like(self.stop), self.stop])
        return ends if self.knots is None else jnp.concatenate([ends, self.knots])

    def dues(self) -> Float[Array, " r"]:
        """Times of the rows between the first and the last, and then never."""
        never = jnp.full((1,), jnp.finfo(self.saves.dtype).max, self.saves.dtype)
        return jnp.concatenate([self.saves[1:-1], never])


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
        row_turn: row i + 1 is reached from the state before this turn; beyond all of them for rows
            that were not reached and after the last. None where there are no rows between the
            first and the last.
    """

    offsets: Float[Array, " N"]
    anchors: Int[Array, " N"] | None
    jumps: Bool[Array, " N"] | None
    points: PyTree | None
    stride: Int[Array, ""]
    turns: Int[Array, ""]
    row_turn: Int[Array, " r"] | None


class Outcome(NamedTuple):
    """Where a drive ended, and its rows."""

    status: Int[Array, ""]
    time: Float[Array, ""]
    state: PyTree
    tried: Float[Array, ""]  # end of the last attempted step
    accepted: Int[Array, ""]
    attempted: Int[Array, ""]
    rows: PyTree  # leaves (s, ...), NaN where not reached
    missed: Int[Array, ""]  # how the step to one of them failed: a Status
    record: Record | None
    gradient: Int[Array, ""]  # a GradientMode
