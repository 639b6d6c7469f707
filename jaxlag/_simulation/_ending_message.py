"""The end of a single motion as text: status, place, likely remedy."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag._core._arrays import stop_gradient
from jaxlag._core._errors import shortened
from jaxlag._core._status import (
    ADVICE,
    ADVICE_FIXED,
    ADVICE_SHARP,
    ADVICE_SPARSE,
    CONCERNS_ROW,
    Status,
)
from jaxlag._linalg._kkt import augmented
from jaxlag._linalg._mass_solve import known_definite
from jaxlag._model._states import named_states
from jaxlag._simulation._abstract_solution import AbstractSolution
from jaxlag._simulation._methods import of_components
from jaxlag._simulation._step_diagnosis import UNEVEN, about_time, counts, stiffness
from jaxlag._system._inspection import advice_on_mass
from jaxlag._system._nonfinite import nonfinite
from jaxlag._system._row_advice import advice_on_rows


def ended(motion: AbstractSolution, lost: tuple[Array, Array] | None) -> str:
    """See `Solution.message`.

    Args:
        motion: a single motion.
        lost: (time, (q, v, x)) where the equations are not finite, if it is known.
    """
    status = Status(int(motion.status))
    if status is Status.ok:
        text = f"ok at t = {motion.last_time}"
        return f"{text}, {motion.fallback}" if motion.fallback else text
    index = int(motion.where)
    labels, more = motion.system.coordinates.labels, ""
    if motion.system.states is not None:
        labels += motion.system.states.layout.labels
    if status is Status.kinematics_singular:
        assert motion.system.quasi is not None
        labels = motion.system.quasi.names
        if index < 0:
            more = " There are fewer quasi-velocities than degrees of freedom."
        else:
            more = f" {_fallen(motion, index)}"
    if status in CONCERNS_ROW:
        rows = motion.system._rows(motion._given, motion.q.dtype)
        labels = rows.labels
        if status is Status.contradictory_rows:
            more = rows.contradiction(motion.system.size)
            if motion.formulation == "quasi":
                more = " The kinematics v = B u + c do not satisfy it."
    about = f" ({labels[index]!r})" if index >= 0 else ""
    if status is Status.nonfinite:
        more = _not_finite(motion, lost)
    q, v = motion.last_state
    beside = "" if motion.last_x is None else f", x = {motion.last_x}"
    accepted, rejected = counts(motion)
    return shortened(
        f"{status.name}{about}{_failed_save(motion)}: last good state at t = {motion.last_time} of "
        f"{motion.ts[-1]}, q = {q}, v = {v}{beside}, after {accepted} accepted and {rejected} "
        f"rejected steps. {_advice(motion, status)}{more}".rstrip()
    )


def _advice(motion: AbstractSolution, status: Status) -> str:
    """Advice on the end of a single motion; on its rows if these are the cause."""
    of_rows = *CONCERNS_ROW, Status.nonfinite, Status.step_below_resolution
    if status in of_rows and motion.system.constraints:
        # Under grad its numbers are traced, but have values.
        at = stop_gradient((motion._given, motion.last_time, motion.last_state[0]))
        dependent = status is Status.projection_failed
        singular = advice_on_rows(motion.system, *at, dependent=dependent)
        if singular:
            return singular
    fixed, (accepted, rejected) = motion.tolerances is None, counts(motion)
    sharp = rejected > UNEVEN * (accepted + rejected)
    special = ADVICE_FIXED if fixed else ADVICE_SHARP if sharp else {}
    message = (ADVICE | special).get(status, "")
    if status is Status.mass_singular:
        message = f"{message} {advice_on_mass(motion._given)}".rstrip()
        if _definite_on_rows(motion):
            message = f"{message} {ADVICE_SPARSE}"
    if fixed:
        return message
    if status in (Status.max_steps, Status.step_below_resolution):
        message = f"{message} {about_time(motion)}".strip()
    if status is Status.max_steps and (rates := stiffness(motion)) is not None:
        return (
            f"The motion is stiff: a component decays at {rates.fastest:.3g} 1/s, and explicit "
            f"steps must be about as short as its time constant. Take method='kvaerno5'. {message}"
        )
    assert motion.tolerances is not None
    if status is Status.step_below_resolution and not np.all(motion.tolerances[1]):
        end = jax.tree.leaves((motion.last_state, motion.last_x))
        state = np.concatenate([np.ravel(x) for x in end])
        labels, states = motion.system.coordinates.labels, motion.system.states
        atol = np.asarray(motion.tolerances[1])
        each = np.broadcast_to(atol, (state.size - len(labels),))
        bounds = of_components(each, len(labels))
        names = (*labels, *(f"{label}'" for label in labels))
        names += () if states is None else states.layout.labels
        resting = [names[i] for i in np.flatnonzero((state == 0) & (bounds == 0))]
        if resting:
            return (
                f"With atol = 0 no error is small enough where a component is 0, here "
                f"{', '.join(resting)}: give atol > 0, or start elsewhere."
            )
    return message


def _definite_on_rows(motion: AbstractSolution) -> bool:
    """Whether M is positive definite on the constraints at the end, by whole matrices."""
    system, params = motion.system, motion._given
    if not system.constraints:
        return False
    at = stop_gradient((motion.last_time, *motion.last_state, params))
    M, A = system._terms.mass(*at), system._terms.rows(*at)[0]
    return known_definite(np.asarray(augmented(M, A)[0]), motion.q.dtype)


def _fallen(motion: AbstractSolution, index: int) -> str:
    """How a quasi-velocity has changed up to its singularity, as text."""
    quasi, (q, _) = motion.system.quasi, motion.last_state
    assert quasi is not None
    times, states = (motion.ts[0], motion.last_time), (motion.q[0], q)
    begin, end = (
        float(quasi.pivots(t, q, motion._given)[index]) for t, q in zip(times, states, strict=True)
    )
    if not (begin > 0 and end > 0) or begin == end:
        return ""
    what = "its part that is independent of the quasi-velocities before it"
    return f"Since the start {what} has changed by a factor of {end / begin:.2g}."


def _not_finite(motion: AbstractSolution, lost: tuple[Array, Array] | None) -> str:
    """The declared function that is not finite, with its line, as text; "" if it is unknown.

    Args:
        motion: one that ended as nonfinite.
        lost: (time, (q, v, x)) where the equations are not finite, if it is known.
    """
    n, states = motion.system.size, motion.system.states
    places: list[tuple[Any, ...]] = [(motion.last_time, *motion.last_state, motion.last_x)]
    if lost is not None:
        places.append((lost[0], *jnp.split(lost[1], [n, 2 * n])))
    for t, q, v, x in places:
        signals = motion.inputs | named_states(states, x)
        given = stop_gradient((motion._given, signals, t, q, v))  # with values under grad
        found = nonfinite(motion.system, *given)
        if found is not None:
            return f" {found}"
    return ""


def _failed_save(motion: AbstractSolution) -> str:
    """The first save time before the last time of which the state is NaN, as text; "" if none.

    A state is saved by a step of its own from the start of the accepted step around it, and this
    step may fail alone.
    """
    # Under grad the numbers are traced, but have values.
    values: Any = stop_gradient((motion.ts, motion.q, motion.last_time))
    ts, q, last_time = map(np.asarray, values)
    lost: np.ndarray = np.any(np.isnan(q), axis=1)
    first = (1 + np.flatnonzero(lost[1:])[:1]).tolist()
    if not first or (last_time - ts[first[0]]) * (ts[-1] - ts[0]) < 0:
        return ""
    return f" in the step to ts[{first[0]}] = {ts[first[0]]:g}"
