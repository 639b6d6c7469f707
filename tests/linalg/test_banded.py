"""Banded factorization: solves, the diagonal of the inverse, dependent rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._linalg._banded import factor_banded

EPS = np.finfo(float).eps
SIZES = [(1, 1), (2, 1), (40, 1), (7, 3), (50, 20)]


def banded(m, w, seed=0):
    """A definite matrix of half bandwidth w, with 1 on the diagonal."""
    rng = np.random.default_rng(seed)
    L = np.eye(m)
    for k in range(1, w + 1):
        L += np.diag(rng.normal(size=max(m - k, 0)) / w, -k)[:m, :m] if k < m else 0.0
    S = L @ np.diag(rng.uniform(0.5, 2.0, m)) @ L.T
    units = np.sqrt(np.diagonal(S))
    return S / np.outer(units, units)


def columns(S, w):
    """Its lower band."""
    m = len(S)
    return jnp.array([[S[k + i, k] if k + i < m else 0.0 for i in range(w + 1)] for k in range(m)])


@pytest.mark.parametrize(("m", "w"), SIZES)
def test_solves_and_diagonal_of_the_inverse_are_those_of_the_whole_matrix(m, w):
    S, c = banded(m, w), np.random.default_rng(1).normal(size=m)
    factor = factor_banded(columns(S, w), 1e-11)
    inverse = np.linalg.inv(S)
    allowed = 20 * EPS * np.linalg.cond(S)
    assert bool(jnp.all(factor.healthy))
    np.testing.assert_allclose(factor.solve(jnp.array(c)), inverse @ c, atol=allowed * abs(c).max())
    np.testing.assert_allclose(
        factor.diagonal_of_inverse(), np.diagonal(inverse), atol=allowed * abs(inverse).max()
    )


def test_a_dependent_row_is_left_out_and_the_others_are_solved():
    """The third of four rows is the second one: its unknown is 0, and so is its inverse."""
    A = np.array([[1.0, 0.2, 0.0], [0.0, 1.0, 0.3], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]])
    A = A / np.linalg.norm(A, axis=1)[:, None]
    S, c, kept = A @ A.T, np.array([0.3, -1.0, -1.0, 0.7]), [0, 1, 3]
    factor = factor_banded(columns(S, 2), 1e-11, crossing=True)
    x = np.zeros(4)
    x[kept] = np.linalg.solve(S[np.ix_(kept, kept)], c[kept])
    masses = np.zeros(4)
    masses[kept] = np.diagonal(np.linalg.inv(S[np.ix_(kept, kept)]))
    assert not bool(factor_banded(columns(S, 2), 1e-11).healthy[2])
    assert bool(jnp.all(factor.healthy))
    np.testing.assert_allclose(factor.solve(jnp.array(c)), x, atol=20 * EPS)
    np.testing.assert_allclose(factor.diagonal_of_inverse(), masses, atol=20 * EPS)


def test_the_code_does_not_grow_with_the_matrix():
    def lines(m):
        program = jax.jit(lambda S, c: factor_banded(S, 1e-11).solve(c))
        return len(program.lower(jnp.ones((m, 3)), jnp.ones(m)).as_text().splitlines())

    assert lines(1000) == lines(10)
