"""Rates of perturbations, from the Jacobian of the vector field at a state."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_UNSEEN = 1e3  # tolerances: below this change, error estimates do not bound perturbations


def linearized(field: Callable, y: Array) -> tuple[Array, Array]:
    """(f, df/dy) at y by differences: half the digits, compiled in a fraction of the time."""
    beside = jnp.sqrt(jnp.finfo(y.dtype).eps) * (1.0 + jnp.abs(y))
    states = jnp.concatenate([y[None], y[None] + jnp.diag(beside)])
    f, *others = jax.lax.map(field, states)
    return f, (jnp.stack(others, 1) - f[:, None]) / beside[None]


def spectral_size(J: Array) -> tuple[Array, Array]:
    """(rate, J^16 / rate^16): rate is the 16th root of the norm of J^16, about the spectral radius.

    It hardly depends on units. The powers are scaled, as they may overflow.
    """
    power, rate = J, jnp.ones((), J.dtype)
    for k in range(5):
        power = power if k == 0 else power @ power
        size = jnp.max(jnp.abs(power))
        power = power / jnp.where(size > 0, size, 1.0)
        rate = rate * size ** (0.5**k)
    return rate, power


def turning_rate(J: Array) -> Array:
    """The largest |eigenvalue| among those that oscillate or grow."""
    finite = jnp.all(jnp.isfinite(J))
    values = jnp.linalg.eigvals(jnp.where(finite, J, 0.0))
    turning = (jnp.abs(values.imag) >= jnp.abs(values.real)) | (values.real > 0)
    return jnp.where(finite, jnp.max(jnp.where(turning, jnp.abs(values), 0.0)), jnp.nan)


def longest_step(
    field: Callable, y: Array, controller: Any, order: float, explicit: bool
) -> Float[Array, ""]:
    """Step in which the fastest perturbations turn or grow by an amount that an estimate detects.

    It is infinite if the motion itself changes along them by `_UNSEEN` tolerances or more: the
    error estimates then detect them. It is also infinite if the differences cross a jump or a kink.

    Args:
        field: y -> dy/dt, followed by the outcomes of comparisons.
        y: state.
        controller: step-size controller with the tolerances.
        order: order of the error estimate.
        explicit: whether the method must also resolve decay.
    """
    f, J = linearized(field, y)
    smooth = ~jnp.any(J[y.size :] != 0)
    f, J = f[: y.size], J[: y.size]
    if explicit:
        rate, power = spectral_size(J)
        # J^16 f contains only the fastest modes: those of half their rate to 1e-5.
        seen = jnp.abs(power @ f)
    else:
        rate = turning_rate(J)
        seen = jnp.abs(J @ f) / rate
    allowed = _UNSEEN * (controller.atol + controller.rtol * jnp.abs(y))
    unseen = jnp.all(seen < rate * allowed) & jnp.isfinite(rate) & smooth
    part = (jnp.maximum(controller.rtol, jnp.finfo(y.dtype).eps) * math.gamma(order + 1)) ** (
        1 / order
    )
    return jnp.where(unseen, part / rate, jnp.inf)
