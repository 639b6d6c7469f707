"""Derivatives at save times that a motion did not reach: not known, as the states are not."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxlag._core._linear_map import LinearMap, linear


def unreached(reached: Bool[Array, " s"], given: PyTree, change: PyTree, saved: PyTree) -> PyTree:
    """The derivative of saved states along `change`, NaN where they were not reached.

    Backwards NaN comes to everything that moves as soon as one of these states is asked for, by a
    cotangent that is not zero: a loss that leaves them out, by `jnp.where(reached, ..., 0.0)`,
    keeps the derivative of what it counts.

    Args:
        reached: whether a save time was reached.
        given: what the saved states are functions of: derivatives of these derivatives are not
            known, either.
        change: directions in it, None for what does not move.
        saved: their derivative, leaves (s, ...).
    """
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), change)

    def forward(r: tuple[Array, PyTree], x: tuple[PyTree, PyTree]) -> PyTree:
        reached, unknown = r[0], _unknown(*r)

        def known(x: Array) -> Array:
            return jnp.where(_of(reached, x), x, unknown.astype(x.dtype))

        return jax.tree.map(known, x[1])

    def backward(r: tuple[Array, PyTree], y: PyTree) -> tuple[PyTree, PyTree]:
        reached, unknown = r[0], _unknown(*r)
        asked = [jnp.any(~_of(reached, x) & (x != 0)) for x in jax.tree.leaves(y)]
        lost = jnp.where(jnp.any(jnp.stack(asked)), unknown, 0.0)
        moves = jax.tree.map(lambda x: jnp.broadcast_to(lost, x.shape).astype(x.dtype), like)
        return moves, jax.tree.map(lambda x: jnp.where(_of(reached, x), x, 0.0), y)

    form = LinearMap(forward, backward, forward, backward, at_once=None)
    return linear(form, (reached, given), (change, saved))


def _unknown(reached: Array, given: PyTree) -> Array:
    """NaN, with NaN for its derivatives by anything of this; 0 where all was reached."""
    total = jnp.sum(jnp.stack([jnp.sum(x).astype(float) for x in jax.tree.leaves(given)]))
    return jnp.where(jnp.all(reached), 0.0, jnp.nan) * total


def _of(reached: Array, x: Array) -> Array:
    """As wide as the states."""
    return reached.reshape(reached.shape + (1,) * (x.ndim - 1))
