"""GradientMode: the storage scheme of a derivative, its choice and its memory."""

import math
from enum import IntEnum
from typing import Any

import numpy as np

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid

MODES = ("auto", "forward", "recorded", "checkpoints")
# States that "auto" keeps: with this many steps none is repeated backwards, and the states fit into
# the caches of a processor for 16 lanes at once.
ROOM = 512


class GradientMode(IntEnum):
    """How reverse derivatives are computed, stored as int32 in `Solution.gradient_mode`.

    `none` is for a motion without derivatives.
    """

    none = 0
    forward = 1
    recorded = 2
    checkpoints = 3


def most_steps(max_steps: int, ts: Any, dt: Any, knots: Any) -> int:
    """Bound on the steps of a motion, for the size of its record.

    It is `max_steps`, or less if ts and the fixed step dt have values: the steps of this length in
    the span of ts, one more for each knot, and two for rounding. This is rounded up to a power of
    2, at least 64, so that few programs serve all steps and times.

    Args:
        max_steps: bound given by the user.
        ts: save times, s.
        dt: fixed step, s; None for adaptive steps.
        knots: times at which steps must end, s; None for none.
    """
    if dt is None or not concrete(ts, dt):
        return max_steps
    steps = abs(float(ts[-1]) - float(ts[0])) / float(dt)
    if not steps < max_steps:
        return max_steps
    most = math.ceil(steps) + 2 + (0 if knots is None else np.shape(knots)[0])
    return min(max_steps, 1 << max(6, (most - 1).bit_length()))


def capacity_for(
    mode: str,
    memory: int | float | None,
    max_steps: int,
    saves: Any,
    state: int,
    itemsize: int,
    knots: bool = False,
) -> int:
    """Number of states to keep for `max_steps` steps; 0 if derivatives are computed forwards.

    Args:
        mode: the requested mode.
        memory: bytes that one trajectory may keep; None for no bound.
        max_steps: bound on the steps.
        saves: number of save times, or a symbol of `jax.export`.
        state: numbers in a state.
        itemsize: bytes of a number.
        knots: whether inputs have knots.
    """
    least = max(2, 2 ** math.ceil(math.log2(max(max_steps, 1)) / 2))
    rooms = {"recorded": 2 * math.ceil(max_steps / 2), "checkpoints": least, "forward": 0}
    if memory is None:
        return min(ROOM, rooms["recorded"]) if mode == "auto" else rooms[mode]
    if not isinstance(saves, int):
        was = f"it was {memory} for {saves} times"
        raise invalid("gradient_memory", "be left out if the number of times is symbolic", was)
    steps = max_steps + saves - 2  # upper bound, for all lanes
    needs = {
        name: needed(steps if name == "recorded" else room, steps, state, itemsize, knots)
        for name, room in sorted(rooms.items(), key=lambda item: -item[1])
    }
    if mode == "auto":
        room = min(ROOM, rooms["recorded"])
        if needed(room, steps, state, itemsize, knots) <= memory:
            return room
        fitting = [name for name, need in needs.items() if need <= memory]
        if fitting:
            return rooms[fitting[0]]
        must = f"be at least {needs['forward']} bytes for max_steps={max_steps}"
        raise invalid("gradient_memory", must, f"it was {memory}", "Lower max_steps.")
    if needs[mode] > memory:
        fits = [f"{name!r} ({need} bytes)" for name, need in needs.items() if need <= memory]
        fix = f"Use gradient={' or '.join(fits)}." if fits else "Lower max_steps."
        must = f"be at least {needs[mode]} bytes for gradient={mode!r} and max_steps={max_steps}"
        raise invalid("gradient_memory", must, f"it was {memory}", fix)
    return rooms[mode]


def needed(room: int, steps: int, state: int, itemsize: int, knots: bool = False) -> int:
    """Bytes stored for one trajectory: times of all steps, states at points and between two points.

    With knots also, for every step, its anchor and whether it begins with a jump.
    """
    states = room + 1 + math.ceil(steps / room) if room else 0
    return steps * (8 + 5 * knots) + states * state * itemsize
