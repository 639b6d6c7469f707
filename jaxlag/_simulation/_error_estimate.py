"""The error of a motion, by a finer one beside it."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxlag._core._errors import invalid
from jaxlag._simulation._solution import Solution

# Room for what is left of the error in the finer motion.
SHARE = 1.5
# A method of higher order at a tenth of the tolerance leaves a hundredth of the error, or less.
LEFT = 0.02
# What rounding leaves, over eps sqrt(steps) |y|: both motions round, and their difference may be 0.
ROUNDED = 32.0


def check_estimate(estimate_error: Any, method: Any) -> None:
    """Raise where there is no finer motion to be had."""
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
    """The motion with the estimate of its error, the difference of the two and half as much.

    Where the difference passes through 0 the error need not: it is at least what is left of the
    largest so far in the finer motion, and what rounding leaves of steps that magnify nothing. It
    is nan where the finer motion did not get.

    Args:
        motion: what was asked for.
        beside: the finer motion.
        left: the part of the error in it: LEFT of another order; 1, to be safe, of the same, where
            a tenth of the tolerance leaves about an eighth (its power p / (p + 1)) and half a step
            2^-p.
    """
    steps = jnp.asarray(motion.stats["accepted"])[..., None, None]

    def estimate(fine: Array, coarse: Array) -> Array:
        difference, axis = jnp.abs(fine - coarse), fine.ndim - 2
        so_far, size = (jax.lax.cummax(x, axis=axis) for x in (difference, jnp.abs(coarse)))
        rounding = ROUNDED * jnp.finfo(size.dtype).eps * jnp.sqrt(steps.astype(size.dtype)) * size
        at_first = jnp.arange(size.shape[axis])[:, None] == 0
        rounding = jnp.where(at_first, 0.0, rounding)
        return jnp.maximum(SHARE * jnp.maximum(difference, left * so_far), rounding)

    return replace(motion, error=(estimate(motion.q, beside.q), estimate(motion.v, beside.v)))
