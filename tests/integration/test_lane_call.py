"""Calls of functions of small arrays, which `jax.vmap` runs as one map over lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxlag._integration._vector_loop import NotVectorizable, lane_call

EPS = np.finfo(float).eps


def moved_and_summed(x, k):
    """The gradient of parts of an array: pads, sums of cotangents and splits."""

    def total(x):
        a, b = jnp.split(x, [1])
        first, *_ = lax.pad(b, 0.5, [(1, 2, 1)])
        return a[0] * b[1] + first * jnp.sum(x[::-1] * a) + x[k.shape[0]] ** 2 + sum(b)

    return jax.grad(total)(x), {"k": k + 1}


@pytest.mark.parametrize("count", [1, 5, 16, 33])
def test_calls_in_lanes_equal_vmapped_ones(count):
    """Of arrays of each lane, of one for all, and of values of a closure."""
    rng = np.random.default_rng(1)
    x, scale, k = jnp.asarray(rng.normal(size=(count, 3))), jnp.asarray(rng.normal(size=count)), [2]

    def both(call):
        def function(x, scale):
            return call(lambda x, k: moved_and_summed(scale * x, k), x, jnp.array(k))

        return jax.jit(jax.vmap(function))(x, scale)

    found, right = both(lane_call), both(lambda function, *args: function(*args))
    np.testing.assert_allclose(found[0], right[0], rtol=8 * EPS, atol=8 * EPS)
    np.testing.assert_array_equal(found[1]["k"], right[1]["k"])


def test_a_call_without_a_form_on_numbers_names_the_operation():
    with pytest.raises(NotVectorizable, match="sort"):
        jax.vmap(lambda x: lane_call(jnp.sort, x))(jnp.ones((16, 3)))
