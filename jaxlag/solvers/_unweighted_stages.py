"""What the error estimate of an explicit step does not see: stages without weight in it."""

from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

# Parts of the largest rate of three stages. Steps that the estimate accepts in a smooth field stay
# far below: at tolerances of 1e-6 and less none of 1,800 motions (pendulums, Kepler orbits up to
# e = 0.97, oscillators of two rates, coupled ones) had a step turned back by either.
_APART = 0.3
_KICK = 3.0


def unweighted_stages(b: Any, e: Any) -> tuple[int, ...]:
    """Stages that have no weight in the step nor in its error estimate, without the last.

    Args:
        b: weights of the step.
        e: weights of the error estimate.
    """
    nothing = (np.asarray(b) == 0.0) & (np.asarray(e) == 0.0)
    return tuple(np.flatnonzero(nothing[:-1]).tolist())


def unseen(k: Sequence[Any], stages: tuple[int, ...]) -> Any:
    """What an error estimate takes no notice of: it is at least this, where it is not 0.

    Early stages of methods of high order weigh nothing in the step and in its estimate. Where they
    alone meet a short, stiff force (a wall, a cord that goes taut), it throws the stages after them
    out again, and the estimate is that of a motion without it. Component by component this is the
    larger of

        |k_s - k_{s-1}|    where it is above 0.3 of the largest of |k_1|, |k_{s-1}|, |k_s|,
        |k_i|              where it is above 3 times that, of stages i without weight:

    k_s and k_{s-1} are both of the end of the step, from the end itself and from a stage that the
    ones before led to. The former applies where two stages or more weigh nothing: one alone does
    not throw all others out.

    Args:
        k: dy/dt of every stage, pytrees of arrays; the last at the end of the step.
        stages: of `unweighted_stages`, not empty.
    """

    def of(first: Array, before: Array, end: Array, *without: Array) -> Array:
        largest = reduce(jnp.maximum, map(jnp.abs, (first, before, end)))
        kick = reduce(jnp.maximum, map(jnp.abs, without))
        found = jnp.where(kick > _KICK * largest, kick, 0.0)
        if len(without) > 1:
            apart = jnp.abs(end - before)
            found = jnp.maximum(found, jnp.where(apart > _APART * largest, apart, 0.0))
        return found

    return jax.tree.map(of, k[0], k[-2], k[-1], *(k[i] for i in stages))


def at_least(error: Any, unseen: Any) -> Any:
    """The error estimate with what it takes no notice of; as it is where that is None."""
    if unseen is None:
        return error
    return jax.tree.map(lambda e, x: jnp.where(x > jnp.abs(e), x, e), error, unseen)


def unstacked(k: Any) -> list[Any]:
    """The stages one by one, of all of them along a first axis."""
    count = jax.tree.leaves(k)[0].shape[0]
    return [jax.tree.map(lambda x: x[i], k) for i in range(count)]  # noqa: B023
