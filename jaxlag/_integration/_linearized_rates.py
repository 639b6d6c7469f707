"""How fast perturbations of a state turn and grow: its linearised equations and their rates."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_UNSEEN = 1e3  # tolerances: an error estimate that sees no more says nothing of perturbations


def linearized(field: Callable, y: Array) -> tuple[Array, Array]:
    """(f, df/dy) at y by differences: half the digits, and compiled in a fraction of the time."""
    beside = jnp.sqrt(jnp.finfo(y.dtype).eps) * (1.0 + jnp.abs(y))
    states = jnp.concatenate([y[None], y[None] + jnp.diag(beside)])
    f, *others = jax.lax.map(field, states)
    return f, (jnp.stack(others, 1) - f[:, None]) / beside[None]


def spectral_size(J: Array) -> tuple[Array, Array]:
    """(rate, J^16 / rate^16): about the spectral radius, the 16th root of the size of that power.

    Units hardly matter to it. Scaled on the way, as the power of a rate may leave the range of
    numbers.
    """
    power, rate = J, jnp.ones((), J.dtype)
    for k in range(5):
        power = power if k == 0 else power @ power
        size = jnp.max(jnp.abs(power))
        power = power / jnp.where(size > 0, size, 1.0)
        rate = rate * size ** (0.5**k)
    return rate, power


def turning_rate(J: Array) -> Array:
    """The largest eigenvalue in size among those that do not merely decay."""
    finite = jnp.all(jnp.isfinite(J))
    values = jnp.linalg.eigvals(jnp.where(finite, J, 0.0))
    turning = (jnp.abs(values.imag) >= jnp.abs(values.real)) | (values.real > 0)
    return jnp.where(finite, jnp.max(jnp.where(turning, jnp.abs(values), 0.0)), jnp.nan)


def longest_step(
    field: Callable, y: Array, controller: Any, order: float, explicit: bool
) -> Float[Array, ""]:
    """In which the fastest perturbations turn or grow by what an estimate of the error would see.

    Infinite where the motion itself moves them, for `_UNSEEN` tolerances and more, so that error
    estimates of its steps tell; and where differences lead across a jump or a bend.

    Args:
        field: y -> dy/dt, and after these outcomes of comparisons.
        y: state.
        controller: its tolerances.
        order: of the error estimate.
        explicit: whether the method follows what decays, too.
    """
    f, J = linearized(field, y)
    smooth = ~jnp.any(J[y.size :] != 0)
    f, J = f[: y.size], J[: y.size]
    if explicit:
        rate, power = spectral_size(J)
        # In J^16 f only the fastest motions are left: those of half their rate to 1e-5.
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
