"""Random directions in trees of arrays, and products of trees."""

import jax
import jax.numpy as jnp
import numpy as np


def direction(x, seed=0):
    leaves, treedef = jax.tree.flatten(x)
    rng = np.random.default_rng(seed)
    return jax.tree.unflatten(
        treedef, [jnp.asarray(rng.normal(size=leaf.shape)) for leaf in leaves]
    )


def dot(a, b):
    return sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
