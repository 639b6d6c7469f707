"""The integration loop: steps, step-size control, knots, save times, the record, the status.

Integration runs forwards in a time tau = sigma (t - ts[0]), sigma = +1 or -1. The loop does not
depend on the direction of time, and the resolution of times is relative to the span.

Each iteration (`_iteration`) takes one step, or one step to a save time. A save time inside the
last accepted step is reached by a separate step from its start, not by interpolation:
this is as accurate as the method is, and the loop body contains one step only.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxlag._core._batching import at_most
from jaxlag._core._status import Status
from jaxlag._integration._change_points import no_crossing
from jaxlag._integration._iteration import is_due, iterate
from jaxlag._integration._loop_state import (
    Loop,
    LoopState,
    RecordBuffers,
    SaveProgress,
    StepStart,
    buffer,
    is_full,
    thin,
)
from jaxlag._integration._record import Outcome, Record, Times
from jaxlag._integration._stepper import Stepper
from jaxlag._integration._tableaus import remembers
from jaxlag._integration._vector_loop import lane_loop

# The record is a whole number of chunks of this many steps.
CHUNK = 64


def integrate(
    stepper: Stepper,
    y0: PyTree,
    args: Any,
    times: Times,
    first_step: Array | None,
    allowed: Bool[Array, ""],
    max_steps: int,
    record: bool,
    room: int = 0,
    native: Callable | None = None,
    vectorized: bool = False,
) -> Outcome:
    """Integrate from tau = 0 to `times.stop`.

    Args:
        stepper: solver, controller, vector field.
        y0: state at the start.
        args: passed to the vector field, after `stepper.windows`.
        times: anchors and save times.
        first_step: the fixed step without a controller; else the first step, None for automatic.
        allowed: False if the trajectory must not start (status set by the caller).
        max_steps: bound on attempted steps.
        record: whether to record the steps so that they can be repeated.
        room: capacity for states on the way, an even number. When it is full, every second state is
            dropped, and from then on half as many are stored.
        native: function that calls the loop with its initial state.
        vectorized: whether this is vmapped, and the loop is one vectorized loop over the lanes.
    """
    t0 = jnp.zeros_like(times.stop)
    count = times.saves.shape[0]
    # Steps that any lane takes: at most the attempts and the steps to save times of one lane.
    size = -(-(max_steps + count - 2) // CHUNK) * CHUNK
    room = (room if room < max_steps else size) if record and not remembers(stepper.solver) else 0
    if stepper.controller is not None:
        memory, sound, h, control = stepper.start(t0, times.stop, y0, args, first_step)
        # The estimate is 0/0 if atol = 0 and a component is 0.
        h = jnp.where(jnp.isfinite(h) & (h > 0), h, 1e-6 * times.stop)
        h = h if stepper.longest is None else jnp.minimum(h, stepper.longest)
    else:
        assert first_step is not None
        memory, h, control = stepper.begin(t0, times.stop, y0, args), first_step, None
        sound = stepper.is_sound(memory)
    jumps = times.knots is not None or not stepper.standard
    determinants = stepper.determinants(t0, y0, args)
    crossing = None if args.lengths is None else no_crossing(t0, args.units.size, args.units.dtype)
    reaches_beyond = crossing is not None and stepper.controller is not None
    start = StepStart(t0, y0, memory, jnp.array(False) if jumps else None, determinants, crossing)
    zero = jnp.zeros((), jnp.int32)
    status = jnp.where(sound, int(Status.ok), int(Status.nonfinite))
    saved = buffers = None
    if not at_most(count, 2):
        places = jnp.full((count - 1,), size, jnp.int32) if record else None
        values = buffer(count - 1, y0, jnp.nan)
        reaches = jnp.zeros_like(places) if reaches_beyond and places is not None else None
        saved = SaveProgress(start, zero, zero, values, places, reaches, zero)
    if record:
        buffers = RecordBuffers(
            offsets=buffer(size, t0, 0.0),
            anchors=None if times.knots is None else buffer(size, zero, 0),
            jumps=buffer(size, zero > 0, 0) if jumps else None,
            points=buffer(room + 1, (y0, None), 0.0) if room else None,
            stride=jnp.ones((), jnp.int32),
        )
    carry = LoopState(
        at=start,
        h=jnp.asarray(h, t0.dtype),
        control=control,
        mark=zero,
        anchor=zero,
        status=status.astype(jnp.int32),
        done=~(allowed & sound) | (times.stop <= 0),
        tried=t0,
        accepted=zero,
        attempted=zero,
        recorded=zero,
        saved=saved,
        buffers=buffers,
        reach=zero if reaches_beyond else None,
    )
    carry = jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_array_like(x) else x, carry)
    dynamic, static = eqx.partition(carry, eqx.is_array)
    fixed = (times, times.anchors(), times.dues(), jnp.asarray(h, t0.dtype), max_steps)
    loop = Loop(stepper, args, *fixed)

    def body_fun(dynamic: Any) -> Any:
        c = iterate(loop, eqx.combine(dynamic, static))
        return eqx.partition(c, eqx.is_array)[0]

    def goes_on(c: Any) -> Array:
        return ~c.done | is_due(loop, c)

    def cond_fun(c: Any) -> Array:
        return eqxi.unvmap_any(goes_on(c))

    never_full = room in (0, size)

    def run(dynamic: Any) -> Any:
        if never_full:
            return jax.lax.while_loop(cond_fun, body_fun, dynamic)
        until_full = lambda c: cond_fun(c) & ~eqxi.unvmap_any(is_full(c, room))  # noqa: E731
        fill = lambda c: jax.lax.while_loop(until_full, body_fun, c)  # noqa: E731
        return jax.lax.while_loop(cond_fun, lambda c: fill(thin(c, room)), dynamic)

    def ended(dynamic: Any) -> Outcome:
        return _outcome(eqx.combine(dynamic, static), times, y0, allowed)

    if vectorized:
        pause = () if never_full else (partial(is_full, room=room), partial(thin, room=room))
        return lane_loop(goes_on, body_fun, ended, dynamic, *pause)
    final = run(dynamic) if native is None else native(run, dynamic)
    return ended(final)


def _outcome(c: LoopState, times: Times, y0: PyTree, allowed: Array) -> Outcome:
    arrived = allowed & (times.saves[-1] <= c.at.t)
    last = jax.tree.map(lambda y: jnp.where(arrived, y, jnp.nan), c.at.y)
    parts = [jax.tree.map(lambda y: y[None], y0)]
    if c.saved is not None:
        parts.append(jax.tree.map(lambda x: x[:-1], c.saved.values))
    parts.append(jax.tree.map(lambda y: y[None], last))
    saved = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    record = None
    if c.buffers is not None:
        save_step = None if c.saved is None else c.saved.steps
        save_reach = None if c.saved is None else c.saved.reaches
        record = Record(*c.buffers, c.recorded, save_step, save_reach, c.reach)
    ends = (c.status, c.at.t, c.at.y, c.tried, c.accepted, c.attempted)
    missed = jnp.zeros((), jnp.int32) if c.saved is None else c.saved.missed
    return Outcome(*ends, saved, missed, record, jnp.zeros((), jnp.int32))
