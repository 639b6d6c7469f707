"""Derivatives along those arguments that have a tangent."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad

from jaxlag._core._tangents import derivative, from_jax, to_jax


def test_only_arguments_with_a_tangent_are_differentiated():
    seen = []

    def function(x, n, y):
        seen.extend(isinstance(a, jax.core.Tracer) for a in (x, n, y))
        return [x * y, n + 1, x - x]

    x, y = jnp.array([1.0, 2.0]), jnp.array([3.0, 5.0])
    results, dots = derivative(function, [x, jnp.array(4), y], [jnp.array([1.0, -1.0]), None, None])
    assert seen == [True, False, False]
    np.testing.assert_array_equal(results[0], [3.0, 10.0])
    assert int(results[1]) == 5
    np.testing.assert_array_equal(dots[0], [3.0, -5.0])
    assert dots[1] is None  # of integers
    np.testing.assert_array_equal(dots[2], [0.0, 0.0])


def test_tangents_of_constants_are_those_of_jax_and_back():
    x, n = jnp.ones(3), jnp.arange(2)
    zeros = to_jax([x, n, x], [None, None, 2.0 * x])
    assert [type(dot) is ad.Zero for dot in zeros] == [True, True, False]
    assert zeros[0].aval.dtype == x.dtype
    assert zeros[1].aval.dtype == jax.dtypes.float0
    found = from_jax(zeros)
    assert found[:2] == [None, None]
    np.testing.assert_array_equal(found[2], 2.0 * x)
