"""Which rows are independent, which are only rounding, and the multipliers of the others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._rank import independent_rows, least_norm, row_sizes


def test_which_rows_are_left_out():
    """The first of equal ones stays; rows marked to come first do so whatever their place."""
    M, rows = jnp.eye(3), jnp.array([[1.0, 0, 0], [2.0, 0, 0], [0, 1.0, 0]])
    assert independent_rows(M, rows).tolist() == [True, False, True]
    assert independent_rows(M, rows, (1, 0, 1)).tolist() == [False, True, True]
    assert independent_rows(M, jnp.zeros((2, 3))).tolist() == [False, False]


def row_of(function):
    """A function of q as one row, as a constraint has it."""
    return lambda q: jax.jacrev(function)(q)[None]


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize(
    ("function", "q", "there"),
    [
        (lambda q: jnp.cos(q[0]), [np.pi, 0.3], False),
        (lambda q: jnp.sin(q[0]) * q[1], [np.pi, 0.0], False),
        (lambda q: q[0] ** 2, [0.0, 1.0], False),
        (lambda q: q @ q, [1e-4, -1e-4], True),  # however short the rod is
        (lambda q: (q[0] - q[1]) ** 2, [1000.0, 1000.125], True),  # and however far away
        (lambda q: jnp.arcsin(q[0]), [-0.999999, 0.0], True),  # beside the end of a domain
        (lambda q: jnp.cos(q[0]), [np.pi - 1e-4, 0.3], True),
    ],
)
def test_rows_are_none_where_rounding_is_all_of_them(function, q, there, dtype):
    rows, q = row_of(function), jnp.array(q, dtype)
    found, size = row_sizes(rows, q, rows(q))
    assert found.tolist() == [there]
    if there:
        np.testing.assert_allclose(size[0], jnp.linalg.norm(rows(q)), rtol=1e-6)
    else:
        assert float(size[0]) > 0.1  # as fast as it grows


def test_what_is_no_row_has_no_multiplier_and_no_derivative():
    """A row of 1e-16 beside the one that it may resemble, and one of 0."""
    A = jnp.array([[1.0, 0.0], [1e-16, 0.0], [0.0, 0.0]])
    kept, there = jnp.array([True, False, False]), jnp.array([True, False, False])
    lam = jnp.array([2.0, 0.0, 0.0])
    np.testing.assert_allclose(least_norm(A, lam, kept, there), lam, atol=1e-15)
    slopes = jax.jacrev(least_norm)(A, lam, kept, there)
    assert np.all(np.isfinite(slopes))
    np.testing.assert_array_equal(slopes[:, 1:], 0.0)
