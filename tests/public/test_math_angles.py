"""Angles: values and derivatives to third order, also at their ends.

Tolerances are in units of EPS, about twice the largest error measured.
"""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _ladders import EPS, ONE_EACH, close, ladder, of_pair
from numpy.testing import assert_allclose, assert_array_equal

from jaxlag import math

PI = np.pi


def test_atan2_values_equal_those_of_numpy():
    """In every quadrant, on the axes with either sign of zero, and across 600 orders of magnitude.

    Scaling costs at most one rounding.
    """
    points = np.array([0.0, 1e-300, 1e-160, 0.1, 1.0, 3.0, 1e160, 1e300, np.inf])
    points = np.concatenate([points, -points])
    y, x = (p.ravel() for p in np.meshgrid(points, points))
    expected = np.arctan2(y, x)
    for value in (math.atan2(y, x), jax.jit(jax.vmap(math.atan2))(y, x)):
        assert_array_equal(np.signbit(value), np.signbit(expected))
        # Quotients below the smallest normal number, 2e-308, may be flushed to zero.
        assert_allclose(value, expected, rtol=2 * EPS, atol=3e-308)


def derivatives_of_direction(y, x):
    """Of Im log(x + i y): k-th derivatives are those of a power, with a factor i for each y."""
    scale = np.hypot(y, x)
    c, s = x / scale, y / scale
    with np.errstate(over="ignore"):
        first = np.array([c, -s]) / scale
        cos2, sin2 = (c - s) * (c + s), 2 * c * s
        second = np.array([[-sin2, -cos2], [-cos2, sin2]]) / scale / scale
        sin3, cos3 = s * (3 - 4 * s**2), c * (4 * c**2 - 3)
        yyy, yyx, yxx, xxx = np.array([-cos3, sin3, cos3, -sin3]) * 2 / scale / scale / scale
    return first, second, np.array([[[yyy, yyx], [yyx, yxx]], [[yyx, yxx], [yxx, xxx]]])


def test_atan2_is_accurate_to_third_order():
    """Largest errors 1, 2 and 15 EPS r^-k, of a third derivative up to 2 r^-3."""
    derivatives = ladder(of_pair("atan2"))
    for size in (1e-100, 1e-8, 1.0, 1e8, 1e100, 1e200, 1e300):
        for y, x in ((0.3, 0.7), (2.0, -0.1), (-1.0, -1.0), (1e-5, 1.0), (-1.0, 0.0), (-0.0, -1.0)):
            _, *orders = derivatives(size * np.array([y, x]))
            expected = derivatives_of_direction(size * y, size * x)
            for order, (values, value) in enumerate(zip(orders, expected, strict=True), start=1):
                scale = np.hypot(size * y, size * x) ** float(-order)
                close(values, value, 30, scale=max(scale, 1e-300))


@pytest.mark.parametrize("size", [1e-300, 1e-200])
def test_atan2_of_tiny_arguments_is_accurate_to_first_order(size):
    """The second derivative, of order r^-2, overflows."""
    gradient = ladder(of_pair("atan2"))(size * np.array([0.3, -0.4]))[1]
    close(gradient, np.array([-1.6, -1.2]) / size, 4)


def pair(angle, lengths=(2.0, 0.7), heading=0.4):
    """Two vectors of the plane; the second is rotated from the first by `angle`."""
    headings = np.array([heading, heading + angle])
    return np.stack([np.cos(headings), np.sin(headings)], axis=1) * np.array(lengths)[:, None]


between = of_pair("angle_between")


@pytest.mark.full
def signed_angle(ab):
    """The signed angle, as a difference of two directions."""
    return math.atan2(ab[1, 1], ab[1, 0]) - math.atan2(ab[0, 1], ab[0, 0])


def test_angle_in_the_plane_is_accurate_to_third_order():
    """The angle from a to b up to sign: no derivative loses digits near 0 and pi."""
    derivatives, expected = ladder(between), ladder(signed_angle, ONE_EACH)
    for angle in (1e-12, 1e-8, 1e-4, 0.01, 0.5, 2.0, 3.1, PI - 1e-4, PI - 1e-8, PI - 1e-12):
        for sign in (1.0, -1.0):
            ab = pair(sign * angle)
            # The angle of the rounded vectors, which need not be `angle`.
            (a, b), (c, d) = ab.tolist()
            exact = [Fraction(x) for x in (a, b, c, d)]
            cross = float(exact[0] * exact[3] - exact[1] * exact[2])
            dot = float(exact[0] * exact[2] + exact[1] * exact[3])
            value, *orders = derivatives(ab)
            close(value, np.arctan2(abs(cross), dot), 2, scale=1.0)
            for order, (values, signed) in enumerate(zip(orders, expected(ab)[1:], strict=True), 1):
                # Largest error 60 EPS |b|^-k, of a third derivative 6 |b|^-3.
                close(values, sign * np.asarray(signed), 120, scale=0.7 ** float(-order))


@pytest.mark.full
@pytest.mark.parametrize("n", [3, 5])
def test_angle_far_from_its_ends_equals_acos_in_any_dimension(n):
    """Against acos(a.b/(|a| |b|)), for which JAX is accurate there."""
    rng = np.random.default_rng(n)
    ab = rng.normal(size=(2, n))

    def plain(ab):
        return jnp.arccos(ab[0] @ ab[1] / jnp.sqrt(ab[0] @ ab[0] * (ab[1] @ ab[1])))

    pairs = zip(ladder(between, ONE_EACH)(ab), ladder(plain, ONE_EACH)(ab), strict=True)
    for values, value in pairs:
        close(values, value, 40, scale=np.abs(value).max())


@pytest.mark.parametrize("n", mostly_full([1, 2, 3, 5], 3))
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_parallel_vectors_have_angle_zero_or_pi_without_derivatives(n, dtype):
    """b = c a rounded, components of all sizes: exact, although the differences round."""
    rng = np.random.default_rng(n)
    a = rng.normal(size=(500, n)) * 10.0 ** rng.uniform(-5, 5, (500, n))
    c = rng.normal(size=(500, 1)) * 10.0 ** rng.uniform(-5, 5, (500, 1))
    a, b = a.astype(dtype), (a.astype(dtype) * c.astype(dtype)).astype(dtype)
    assert n == 1 or np.any(a[:, 0] * b[:, -1] != a[:, -1] * b[:, 0])
    ab = np.stack([a, b], axis=1)
    value, gradient = jax.jit(jax.vmap(jax.value_and_grad(between)))(ab)
    assert_array_equal(value, np.where(c[:, 0] > 0, 0, PI).astype(dtype))
    assert_array_equal(gradient, 0)
    if (n, dtype) == (2, np.float64):
        for one in ab[:5]:
            for values in ladder(between)(one)[1:]:
                assert_array_equal(values, 0.0)


def test_angle_far_below_rounding_of_the_vectors_is_exact():
    a, b = jnp.array([1.0, 0.0]), jnp.array([1.0, 1e-200])
    assert_array_equal(math.angle_between(a, b), 1e-200)
    assert_array_equal(jax.grad(math.angle_between, 1)(a, b), [-1e-200, 1.0])
    for a, b in (([1e200, 0.0], [1e200, 1e200]), ([1e-200, 0.0], [1e-200, 1e-200])):
        close(math.angle_between(a, b), PI / 4, 2)


@pytest.mark.parametrize("other", [[1.0, 2.0], [-1.0, -2.0], [0.0, 0.0], [-0.0, -0.0]])
def test_angle_with_a_zero_vector_is_zero(other):
    for ab in ([[0.0, 0.0], other], [other, [-0.0, 0.0]]):
        for values in ladder(between)(jnp.array(ab)):
            assert_array_equal(values, 0.0)
