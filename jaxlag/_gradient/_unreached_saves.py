"""Derivatives at save times that the motion did not reach: NaN, as the states."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxlag._core._linear_map import LinearMap, linear


def unreached(reached: Bool[Array, " s"], given: PyTree, change: PyTree, saved: PyTree) -> PyTree:
    """The derivative of saved states along `change`; NaN for unreached states.

    In reverse mode all inputs become NaN if the cotangent of one of these states is nonzero. A loss
    that excludes them, by `jnp.where(reached, ..., 0.0)`, keeps its derivative.

    Args:
        reached: whether a save time was reached.
        given: inputs of the saved states: second derivatives by them are NaN, too.
        change: tangents of these, None for inputs that do not vary.
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
    """NaN, also in its derivatives by these inputs; 0 if all states were reached."""
    total = jnp.sum(jnp.stack([jnp.sum(x).astype(float) for x in jax.tree.leaves(given)]))
    return jnp.where(jnp.all(reached), 0.0, jnp.nan) * total


def _of(reached: Array, x: Array) -> Array:
    """`reached`, broadcast to the states."""
    return reached.reshape(reached.shape + (1,) * (x.ndim - 1))
