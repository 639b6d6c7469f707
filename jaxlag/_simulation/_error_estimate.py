"""Global error estimate of a motion, by comparison with a finer solve."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxlag._core._errors import invalid
from jaxlag._simulation._solution import Solution

# Factor for the error of the finer motion.
SHARE = 1.5
# A method of higher order at a tenth of the tolerance has a hundredth of the error, or less.
LEFT = 0.02
# Rounding, over eps sqrt(steps) |y|: both motions round, and their difference may be 0.
ROUNDED = 32.0


def check_estimate(estimate_error: Any, method: Any) -> None:
    """Raise if no finer motion can be computed."""
    if not isinstance(estimate_error, bool):
        raise invalid("estimate_error", "be True or False", f"it was {estimate_error!r}")
    if estimate_error and isinstance(method, tuple):
        must = "be False for a method with a controller of its own"
        raise invalid("estimate_error", must, "it was True", "Pass rtol= and atol=, or dt=.")


def finer(rtol: Any, atol: Any, step: Any, fixed: bool) -> tuple[Any, Any, Any]:
    """(rtol, atol, step) of the finer motion: a tenth of the tolerance, or half the fixed step."""
    if fixed:
        return rtol, atol, 0.5 * step
    least = jnp.where(rtol > 0, 10 * jnp.finfo(rtol.dtype).eps, 0.0).astype(rtol.dtype)
    return jnp.maximum(0.1 * rtol, least), 0.1 * atol, step


def with_error(motion: Solution, beside: Solution, left: float) -> Solution:
    """The motion with its error estimate: SHARE times the difference from the finer motion.

    The difference may pass through 0 although the error does not. The estimate is therefore at
    least a part of the largest difference so far, and at least the rounding of the steps. It is nan
    at times that the finer motion did not reach.

    Args:
        motion: the motion requested.
        beside: the finer motion.
        left: the error of the finer motion over the difference: LEFT if its order is another. 1, a
            safe value, for the same order, where a tenth of the tolerance leaves about an eighth
            (its power p / (p + 1)) and half a step 2^-p.
    """
    steps = jnp.asarray(motion.stats["accepted"])[..., None, None]

    def estimate(fine: Array, coarse: Array) -> Array:
        difference, axis = jnp.abs(fine - coarse), fine.ndim - 2
        so_far, size = (jax.lax.cummax(x, axis=axis) for x in (difference, jnp.abs(coarse)))
        rounding = ROUNDED * jnp.finfo(size.dtype).eps * jnp.sqrt(steps.astype(size.dtype)) * size
        at_first = jnp.arange(size.shape[axis])[:, None] == 0
        rounding = jnp.where(at_first, 0.0, rounding)
        return jnp.maximum(SHARE * jnp.maximum(difference, left * so_far), rounding)

    error: tuple[Array, ...] = estimate(motion.q, beside.q), estimate(motion.v, beside.v)
    if motion.x is not None and beside.x is not None:
        error += (estimate(motion.x, beside.x),)
    return replace(motion, error=error)
