"""Sparse KKT systems: the solution of the whole matrix, also for singular blocks of M."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csr_array

from jaxlag._linalg._block_diagonal import BlockDiagonal, blocks_of, factor_blocks, solve_blocks
from jaxlag._linalg._kkt import correction_matrix
from jaxlag._linalg._sparse_kkt import SparseKkt, factor_sparse, rows_of, solve_sparse

EPS = np.finfo(float).eps
SIZES = [2, 3, 1, 3, 2, 3]
"""Coordinates of the bodies of a chain; they are numbered in a random order."""


def chain(singular=False, seed=0):
    """(M, A): one row between neighbours, and one inside of every body of 3 coordinates.

    With `singular` M vanishes along these.
    """
    rng, n = np.random.default_rng(seed), sum(SIZES)
    names = np.split(rng.permutation(n), np.cumsum(SIZES)[:-1])
    M, A = np.zeros((n, n)), []
    for body in names:
        F = rng.normal(size=(len(body), len(body)))
        block = F @ F.T + np.eye(len(body))
        if len(body) == 3:
            a = rng.normal(size=3)
            A.append(np.zeros(n))
            A[-1][body] = a
            P = np.eye(3) - np.outer(a, a) / (a @ a)
            block = P @ block @ P if singular else block
        M[np.ix_(body, body)] = block
    for one, other in pairwise(names):
        A.append(np.zeros(n))
        A[-1][[one[0], other[-1]]] = rng.normal(size=2)
    return M, np.array(A)


def sparse(M, A):
    """The same by entries."""
    blocks = blocks_of(csr_array(M != 0))
    rows = rows_of(blocks, csr_array(A != 0), np.ones(len(A), bool))

    def entries(matrix, row, column):
        return np.pad(matrix, ((0, 0), (0, 1)))[row, np.minimum(column, len(M))]

    members = np.concatenate([blocks.members, np.full((1, blocks.size), len(M))])
    row = np.where(blocks.absent, 0, blocks.members)
    own = np.eye(blocks.size, dtype=bool) & blocks.absent[:, :, None]
    inside = entries(M, row[:, :, None], blocks.members[:, None, :])
    inside = np.where(blocks.absent[:, :, None], 0.0, inside)
    mass = BlockDiagonal(blocks, jnp.array(np.where(own, 1.0, inside)))
    at = np.arange(len(A))[:, None, None]
    return SparseKkt(mass, rows, jnp.array(entries(A, at, members[rows.met])))


def whole(M, A, r, c):
    """(x, lam) by one dense solve, and the condition number."""
    K = np.block([[M, -A.T], [-A, np.zeros((len(A), len(A)))]])
    z = np.linalg.solve(K, np.concatenate([r, c]))
    return z, np.linalg.cond(K)


def test_products_are_those_of_the_matrices():
    M, A = chain()
    kkt, rng = sparse(M, A), np.random.default_rng(1)
    x, lam = rng.normal(size=len(M)), rng.normal(size=len(A))
    np.testing.assert_allclose(kkt.mass.times(jnp.array(x)), M @ x, atol=1e-14)
    np.testing.assert_allclose(kkt.times(jnp.array(x)), A @ x, atol=1e-14)
    found = kkt.mass.blocks.join(kkt.loads(jnp.array(lam)))
    np.testing.assert_allclose(found, A.T @ lam, atol=1e-14)


def test_block_solve_and_its_derivatives_are_those_of_the_whole_matrix():
    M, _ = chain()
    r = np.random.default_rng(2).normal(size=len(M))
    mass = sparse(M, chain()[1]).mass

    def solved(scale):
        scaled = BlockDiagonal(mass.blocks, scale * mass.entries)
        return solve_blocks(scaled, jnp.array(r), factor_blocks(scaled))

    x, dx = jax.jvp(solved, (jnp.array(2.0),), (jnp.array(1.0),))
    expected = np.linalg.solve(M, r)
    allowed = 20 * EPS * np.linalg.cond(M) * np.linalg.norm(expected)
    np.testing.assert_allclose(x, expected / 2.0, atol=allowed)
    np.testing.assert_allclose(dx, -expected / 4.0, atol=allowed)
    negative = BlockDiagonal(mass.blocks, -mass.entries)
    assert np.all(np.isnan(solve_blocks(negative, jnp.array(r))))


@pytest.mark.full
@pytest.mark.parametrize("singular", [False, True])
def test_solution_is_that_of_the_whole_matrix(singular):
    M, A = chain(singular)
    rng = np.random.default_rng(3)
    r, c = rng.normal(size=len(M)), rng.normal(size=len(A))
    z, condition = whole(M, A, r, c)
    kkt = sparse(M, A)
    factor = factor_sparse(kkt, None, regular=not singular)
    found = solve_sparse(kkt, jnp.array(r), jnp.array(c), factor)
    assert bool(factor.healthy)
    allowed = 20 * EPS * condition * np.linalg.norm(z)
    np.testing.assert_allclose(np.concatenate(found), z, atol=allowed)


def test_effective_masses_are_those_of_the_whole_matrix():
    M, A = map(jnp.array, chain())
    factor = factor_sparse(sparse(*chain()), None, regular=True)
    expected = correction_matrix(M, A, None, "multipliers", False, False)[1]
    np.testing.assert_allclose(factor.masses(), expected, rtol=1e-12)


def test_rows_that_are_not_active_are_left_out():
    M, A = chain()
    rng, active = np.random.default_rng(4), np.arange(len(A)) != 4
    r, c = rng.normal(size=len(M)), rng.normal(size=len(A))
    z, condition = whole(M, A[active], r, c[active])
    kkt, rows = sparse(M, A), jnp.array(active)
    x, lam = solve_sparse(kkt, jnp.array(r), jnp.array(c), factor_sparse(kkt, rows, True), rows)
    allowed = 20 * EPS * condition * np.linalg.norm(z)
    np.testing.assert_allclose(np.concatenate([x, lam[active]]), z, atol=allowed)
    assert float(lam[4]) == 0.0


@pytest.mark.parametrize("crossing", [False, True])
def test_a_dependent_row_is_left_out_or_gives_nan(crossing):
    """A copy of a row: with `crossing` the solution of the others, else NaN."""
    M, A = chain()
    A = np.vstack([A, -3.0 * A[-1]])
    rng = np.random.default_rng(5)
    r, c = rng.normal(size=len(M)), rng.normal(size=len(A))
    c[-1] = -3.0 * c[-2]
    kkt = sparse(M, A)
    factor = factor_sparse(kkt, None, True, crossing)
    x, _ = solve_sparse(kkt, jnp.array(r), jnp.array(c), factor)
    if not crossing:
        assert np.all(np.isnan(x))
        return
    z, condition = whole(M, A[:-1], r, c[:-1])
    np.testing.assert_allclose(x, z[: len(M)], atol=50 * EPS * condition * np.linalg.norm(z))


@pytest.mark.full
def test_derivatives_of_the_solution_are_those_of_the_whole_matrix():
    """In M, A, r and c at once."""
    M, A = chain()
    rng, kkt = np.random.default_rng(6), sparse(M, A)
    r, c = jnp.array(rng.normal(size=len(M))), jnp.array(rng.normal(size=len(A)))

    def entries(s):
        mass = BlockDiagonal(kkt.mass.blocks, s * kkt.mass.entries)
        scaled = SparseKkt(mass, kkt.rows, (2.0 + s) * kkt.A)
        found = solve_sparse(scaled, s**2 * r, jnp.sin(s) * c, factor_sparse(scaled, None, True))
        return jnp.concatenate(found)

    def dense(s):
        K = jnp.block([[s * M, -(2.0 + s) * A.T], [-(2.0 + s) * A, np.zeros((len(A), len(A)))]])
        return jnp.linalg.solve(K, jnp.concatenate([s**2 * r, jnp.sin(s) * c]))

    at = jnp.array(1.3)
    expected = jax.jacfwd(dense)(at)
    allowed = 1e-11 * np.max(np.abs(expected))
    np.testing.assert_allclose(jax.jacfwd(entries)(at), expected, atol=allowed)
    np.testing.assert_allclose(jax.jacrev(entries)(at), expected, atol=allowed)
