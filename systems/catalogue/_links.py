"""Uniform slender links in the plane, joined head to tail from the origin."""

import jax.numpy as jnp
from jax import Array

import jaxlag as jl


def along(lengths: Array, angles: Array) -> Array:
    """Each link from its tail to its head, shape (k, 2) [m]; angles from x towards y."""
    return lengths[:, None] * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)


def heads(lengths: Array, angles: Array) -> Array:
    """Positions of the heads, shape (k, 2) [m]."""
    return jnp.cumsum(along(lengths, angles), axis=0)


def centers(lengths: Array, angles: Array) -> Array:
    """Positions of the mass centers, shape (k, 2) [m]."""
    return heads(lengths, angles) - 0.5 * along(lengths, angles)


def kinetic(masses: Array, lengths: Array, angles: Array, rates: Array) -> Array:
    """T of the mass centers and of the rotations about them, with inertias m l^2/12 [J]."""

    def position(t: Array, q: Array, params: None) -> Array:
        return centers(lengths, q)

    moving = jl.energy.particles(position, masses, 0.0, angles, rates, None)
    return moving + 0.5 * jnp.sum(masses * lengths**2 / 12 * rates**2)


def potential(masses: Array, lengths: Array, angles: Array, g: Array) -> Array:
    """V of the weights [J], y upward, zero at the height of the origin."""
    return g * jnp.sum(masses * centers(lengths, angles)[:, 1])
