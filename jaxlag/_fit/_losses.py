"""Losses: residuals r, over sigma, are replaced by g(r), so that 1/2 g^2 is what a fit sums up."""

from collections.abc import Callable, Mapping

import jax.numpy as jnp
from jaxtyping import Array


def squares(r: Array) -> Array:
    """1/2 r^2."""
    return r


def soft_l1(r: Array) -> Array:
    """(1 + r^2)^(1/2) - 1: as |r| for large r."""
    return r * jnp.sqrt(2.0 / (1.0 + jnp.sqrt(1.0 + r * r)))


def huber(r: Array) -> Array:
    """1/2 r^2 up to |r| = 1.345, linear beyond."""
    k = 1.345
    large = jnp.abs(r) > k
    safe = jnp.where(large, r, k)
    return jnp.where(large, jnp.sign(r) * jnp.sqrt(2 * k * jnp.abs(safe) - k * k), r)


def cauchy(r: Array) -> Array:
    """1/2 log(1 + r^2)."""
    small = r * r < 1e-12
    x = jnp.where(small, 1.0, r * r)
    return r * jnp.where(small, 1.0, jnp.sqrt(jnp.log1p(x) / x))


LOSSES: Mapping[str, Callable[[Array], Array]] = {
    "squares": squares,
    "soft_l1": soft_l1,
    "huber": huber,
    "cauchy": cauchy,
}
