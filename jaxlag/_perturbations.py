"""How fast perturbations of a state turn and grow: its linearised equations and their rates."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array


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
