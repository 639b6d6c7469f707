"""Sine and cosine by polynomials, compared with the library."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from jaxlag._lowering._emit._sincos import _COSINE, _SINE, by_polynomials, sincos

EPS = np.finfo(float).eps
RNG = np.random.default_rng(0)
NEAR = np.concatenate(
    [k * np.pi / 2 + np.array([-1e-3, -1e-9, 0.0, 1e-9, 1e-3]) for k in range(-40, 41)]
)


@pytest.mark.parametrize(
    "x", [RNG.uniform(-10, 10, 20000), RNG.uniform(-1e6, 1e6, 20000), NEAR, NEAR * 1e3]
)
@pytest.mark.parametrize("compiled", [True, False], ids=["fused", "one by one"])
def test_values_equal_those_of_the_library(x, compiled):
    """Sines within 2 eps of their size, also near zeros; cosines within 2 eps."""
    with jax.disable_jit(not compiled):
        s, c = sincos(jnp.asarray(x))
    assert np.max(np.abs(s - np.sin(x)) / np.maximum(np.abs(np.sin(x)), 1e-300)) <= 2 * EPS
    assert np.max(np.abs(c - np.cos(x))) <= 2 * EPS
    np.testing.assert_allclose(np.square(s) + np.square(c), 1.0, rtol=4 * EPS)


@pytest.mark.parametrize("compiled", [True, False], ids=["fused", "one by one"])
def test_values_do_not_exceed_one(compiled):
    """Otherwise sqrt(1 - sin^2) and arcsin would be NaN at 90 degrees."""
    x = np.pi * (np.arange(-2001, 2003, 2) / 2)[:, None] + np.linspace(-2e-8, 2e-8, 101)
    with jax.disable_jit(not compiled):
        s, c = sincos(jnp.asarray(x))
    assert np.max(np.abs(s)) == 1.0
    assert np.max(np.abs(sincos(jnp.asarray(x + np.pi / 2))[1])) == 1.0
    assert np.max(np.abs(c)) <= 2.1e-8


@pytest.mark.parametrize("size", [1e8, 1e11, 1e13])
def test_errors_at_large_arguments_are_their_rounding(size):
    x = jnp.asarray(size * RNG.uniform(1.0, 2.0, 2000))
    s, c = sincos(x)
    for found, exact in ((s, np.sin(x)), (c, np.cos(x))):
        assert np.max(np.abs(found - exact)) <= 2 * EPS * 2 * size
    np.testing.assert_allclose(np.square(s) + np.square(c), 1.0, rtol=4 * EPS)


def test_signed_zeros_infinities_and_huge_arguments_are_handled():
    s, c = sincos(jnp.array([0.0, -0.0, np.inf, -np.inf, np.nan]))
    np.testing.assert_array_equal(s, [0.0, 0.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(c, [1.0, 1.0, np.nan, np.nan, np.nan])
    huge = jnp.array([1e16, -1e19, 1e60, 1e300])
    assert np.max(np.abs(sincos(huge))) <= 1
    assert sincos(jnp.float32(0.3))[0].dtype == jnp.float32


def test_derivatives_are_cosine_and_sine():
    """Forward, reverse and second, without differentiating the polynomial."""
    x = jnp.asarray(RNG.uniform(-10, 10, 100))
    for first in (jax.jacfwd, jax.jacrev):
        slopes = jax.vmap(first(sincos))(x)
        np.testing.assert_allclose(slopes[0], np.cos(x), atol=2 * EPS)
        np.testing.assert_allclose(slopes[1], -np.sin(x), atol=2 * EPS)
        curvature = jax.vmap(first(first(lambda x: sincos(x)[0])))(x)
        np.testing.assert_allclose(curvature, -np.sin(x), atol=2 * EPS)


def test_polynomials_have_the_right_derivatives():
    """JAX differentiates them where it drops the rule: in second derivatives of loops."""
    x = jnp.asarray(RNG.uniform(-10, 10, 1000))
    ones = jnp.ones_like(x)
    (s, c), (s_dot, c_dot) = jax.jvp(by_polynomials, (x,), (ones,))
    np.testing.assert_allclose(s_dot, c, atol=16 * EPS)
    np.testing.assert_allclose(c_dot, -s, atol=16 * EPS)


def test_polynomials_have_the_stated_accuracy():
    """sin r to 5.3e-18 of its size, cos r to 1.4e-17, for r up to pi/2."""
    with mpmath.workdps(40):
        for r in np.linspace(1e-3, np.pi / 2, 400).tolist():
            z, sine, cosine = mpmath.mpf(r) ** 2, mpmath.sin(r), mpmath.cos(r)
            s = r + r * z * mpmath.polyval(_SINE[::-1], z)
            c = 1 - z / 2 + z**2 * mpmath.polyval(_COSINE[::-1], z)
            assert abs(s / sine - 1) <= 5.3e-18
            assert abs(c - cosine) <= 1.4e-17
