"""The state of the integration loop, with the buffers of its record."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from jaxlag._core._buffer_entries import set_entry
from jaxlag._integration._change_points import Crossing
from jaxlag._integration._record import Times
from jaxlag._integration._stepper import Stepper


class StepStart(NamedTuple):
    """Where a step starts."""

    t: Array
    y: PyTree
    memory: Any  # the solver's own state
    jump: Array | None  # whether the field jumps there; None if it never does
    determinants: Array | None  # see `Stepper.determinants`
    crossing: Crossing | None  # detection of change points; None if none are passed


class SaveProgress(NamedTuple):
    """States at the save times between the first and the last."""

    base: StepStart  # where the last accepted step started
    step: Array  # index of that step in the record
    next: Array  # index of the next save time
    values: PyTree  # with one more entry for values that are discarded
    steps: Array | None  # `Record.save_step`
    reaches: Array | None  # `Record.save_reach`
    missed: Array


class RecordBuffers(NamedTuple):
    """Buffers of the record."""

    offsets: Array
    anchors: Array | None
    jumps: Array | None
    points: PyTree | None
    stride: Array


class LoopState(NamedTuple):
    at: StepStart
    h: Array
    control: Any  # the controller's own state
    mark: Array  # number of marks of the fixed grid passed
    anchor: Array
    status: Array
    done: Array
    tried: Array
    accepted: Array
    attempted: Array
    recorded: Array  # number of recorded steps: those that any lane took
    saved: SaveProgress | None
    buffers: RecordBuffers | None
    reach: Array | None  # of the last step, see `Reach`; None if no change points are passed


class Loop(NamedTuple):
    """Constants of the loop."""

    stepper: Stepper
    args: Any
    times: Times
    anchors: Array
    dues: Array
    dt: Array
    max_steps: int


def select(pick: Array, new: PyTree, old: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(pick, a, b) if eqx.is_array_like(a) else a, new, old)


def buffer(size: Any, like: PyTree, fill: float | int) -> PyTree:
    return jax.tree.map(lambda x: jnp.full((size, *jnp.shape(x)), fill, jnp.result_type(x)), like)


def is_full(c: Any, room: int) -> Array:
    """Whether the buffer of points is full before the next step."""
    return (c.recorded >= room * c.buffers.stride) & ~c.done


def thin(c: Any, room: int) -> Any:
    """Drop every second point if the buffer is full."""

    def halved(leaf: Array) -> Array:
        return leaf.at[: room // 2].set(leaf[:room:2])

    def thinned(points: PyTree, stride: Array) -> tuple[PyTree, Array]:
        return jax.tree.map(halved, points), 2 * stride

    given = c.buffers.points, c.buffers.stride
    points, stride = jax.lax.cond(is_full(c, room), thinned, lambda *same: same, *given)
    return c._replace(buffers=c.buffers._replace(points=points, stride=stride))


def write_step(
    loop: Loop, c: LoopState, buffers: RecordBuffers, t: Array, anchor: Array
) -> RecordBuffers:
    """Write this step to the record."""
    anchors, jumps, points = buffers.anchors, buffers.jumps, buffers.points
    if anchors is None:
        offset = jnp.where(anchor == 1, -1.0, t)
    else:
        anchors = set_entry(anchors, c.recorded, anchor)
        offset = t - loop.anchors[anchor]
    offsets = set_entry(buffers.offsets, c.recorded, offset)
    jumps = None if jumps is None else set_entry(jumps, c.recorded, c.at.jump)
    if points is not None:
        spare = jax.tree.leaves(points)[0].shape[0] - 1
        slot = jnp.where(c.recorded % buffers.stride == 0, c.recorded // buffers.stride, spare)
        points = set_entry(points, slot, (c.at.y, None))
    return buffers._replace(offsets=offsets, anchors=anchors, jumps=jumps, points=points)
