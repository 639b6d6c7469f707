"""Error of unweighted stages: a supplement to the error estimate of an explicit step."""

from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

# Fractions of the largest rate of three stages. Steps that the estimate accepts in a smooth field
# stay far below: at tolerances of 1e-6 and less none of 1,800 motions (pendulums, Kepler orbits up
# to e = 0.97, oscillators of two rates, coupled ones) had a step rejected by either.
_DIFFERENCE = 0.3
_KICK = 3.0


def unweighted_stages(b: Any, e: Any) -> tuple[int, ...]:
    """Stages without weight in the step and in its error estimate, except the last.

    Args:
        b: weights of the step.
        e: weights of the error estimate.
    """
    nothing = (np.asarray(b) == 0.0) & (np.asarray(e) == 0.0)
    return tuple(np.flatnonzero(nothing[:-1]).tolist())


def unseen(k: Sequence[Any], stages: tuple[int, ...]) -> Any:
    """Error of stages without weight: a lower bound on the error estimate if it is not 0.

    Early stages of methods of high order have no weight in the step and in its estimate. If only
    they meet a short, stiff force (a wall, a cord that becomes taut), it deflects the later stages
    away from it, and the estimate is that of a motion without the force. For each component the
    result is the larger of

        |k_s - k_{s-1}|    if it is above 0.3 of the largest of |k_1|, |k_{s-1}|, |k_s|,
        |k_i|              if it is above 3 times that, for stages i without weight:

    k_s and k_{s-1} are both at the end of the step, from the end itself and from the last
    stage before it. The former applies if two or more stages have no weight: a single one does
    not deflect all others.

    Args:
        k: dy/dt of every stage, pytrees of arrays; the last at the end of the step.
        stages: of `unweighted_stages`, not empty.
    """

    def of(first: Array, before: Array, end: Array, *without: Array) -> Array:
        largest = reduce(jnp.maximum, map(jnp.abs, (first, before, end)))
        kick = reduce(jnp.maximum, map(jnp.abs, without))
        found = jnp.where(kick > _KICK * largest, kick, 0.0)
        if len(without) > 1:
            difference = jnp.abs(end - before)
            found = jnp.maximum(
                found, jnp.where(difference > _DIFFERENCE * largest, difference, 0.0)
            )
        return found

    return jax.tree.map(of, k[0], k[-2], k[-1], *(k[i] for i in stages))


def at_least(error: Any, unseen: Any) -> Any:
    """The error estimate, at least `unseen`; unchanged if that is None."""
    if unseen is None:
        return error
    return jax.tree.map(lambda e, x: jnp.where(x > jnp.abs(e), x, e), error, unseen)


def unstacked(k: Any) -> list[Any]:
    """A list of the stages, from arrays of all stages along a first axis."""
    count = jax.tree.leaves(k)[0].shape[0]
    return [jax.tree.map(lambda x: x[i], k) for i in range(count)]  # noqa: B023
