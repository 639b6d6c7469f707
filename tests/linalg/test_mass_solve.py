"""The solve with the mass matrix: unrolled up to n = 8, a loop up to n = 16, a library above.

Elimination without pivoting is backward stable on symmetric positive definite matrices: the
computed x solves a system whose M and r differ by some n EPS of their norms.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.linalg import norm

from jaxlag._linalg._mass_solve import (
    LOOP_UP_TO,
    UNROLL_UP_TO,
    factor_mass,
    first_unhealthy,
    solve_mass,
)

EPS = np.finfo(float).eps
SIZES = (1, 2, 3, 4, 5, 6, 7, 8, 9, 12, 16, 17, 18)
WAYS = (3, UNROLL_UP_TO + 2, LOOP_UP_TO + 2)  # one size for each algorithm


@jax.jit
def solved(M, r):
    """x with M x = r, and the index of the first coordinate without inertia."""
    return solve_mass(M, r), first_unhealthy(M)


def solve(M, r):
    return np.asarray(solved(M, r)[0])


def unhealthy(M):
    return int(solved(M, np.ones(len(M)))[1])


def definite(rng, n, condition):
    """Symmetric matrix with eigenvalues from 1 down to 1/condition along random axes."""
    axes, _ = np.linalg.qr(rng.normal(size=(n, n)))
    M = (axes * np.geomspace(1.0, 1.0 / condition, n)) @ axes.T
    return (M + M.T) / 2


def backward_error(M, x, r):
    return norm(M @ x - r) / (norm(M, 2) * norm(x) + norm(r))


def test_all_ways_of_solving_are_tested():
    assert WAYS[0] <= UNROLL_UP_TO < WAYS[1] <= LOOP_UP_TO < WAYS[2] <= max(SIZES)


@pytest.mark.full
@pytest.mark.parametrize("n", SIZES)
def test_solve_is_backward_stable(n):
    rng = np.random.default_rng(n)
    for condition in (1.0, 1e3, 1e6, 1e9, 1e12):
        M, r = definite(rng, n, condition), rng.normal(size=n)
        x = solve(M, r)
        assert backward_error(M, x, r) <= 10 * n * EPS
        assert unhealthy(M) == -1
        assert norm(x - np.linalg.solve(M, r)) <= 10 * n * EPS * np.linalg.cond(M) * norm(x)


def test_solve_works_in_single_precision():
    rng = np.random.default_rng(0)
    for n in WAYS:
        M, r = (x.astype(np.float32) for x in (definite(rng, n, 100.0), rng.normal(size=n)))
        x = solve(M, r)
        assert x.dtype == jnp.float32
        assert backward_error(M, x, r) <= 10 * n * np.finfo(np.float32).eps


@pytest.mark.parametrize("n", WAYS)
def test_factor_is_reusable_for_any_right_hand_side(n):
    rng = np.random.default_rng(n)
    M, R = definite(rng, n, 10.0), rng.normal(size=(3, n))
    X = jax.jit(lambda M, R: [solve_mass(M, r, factor) for factor in [factor_mass(M)] for r in R])
    for x, r in zip(X(M, R), R, strict=True):
        np.testing.assert_array_equal(x, solve(M, r))


# ---- Not positive definite ---------------------------------------------------------------------


def with_pivot(rng, n, index, pivot):
    """Symmetric with elimination pivots 1 except `pivot` at `index`: L D L^T of integers."""
    L = np.tril(rng.integers(-2, 3, (n, n)), -1) + np.eye(n)
    D = np.where(np.arange(n) == index, pivot, 1.0)
    return (L * D) @ L.T


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("pivot", [0.0, -1.0, np.nan])
def test_first_nonpositive_pivot_is_reported_and_solution_is_nan(n, pivot):
    rng = np.random.default_rng(n)
    for index in range(n):
        M = with_pivot(rng, n, index, 1.0)
        if np.isnan(pivot):
            M[index, index] = np.nan
        else:
            M = with_pivot(rng, n, index, pivot)
        assert unhealthy(M) == index
        assert np.all(np.isnan(solve(M, np.ones(n))))


@pytest.mark.parametrize("n", SIZES)
def test_the_coordinate_without_inertia_is_named(n):
    for index in range(n):
        M = np.diag(np.where(np.arange(n) == index, 0.0, 2.0))
        assert unhealthy(M) == index
        assert np.all(np.isnan(solve(M, np.ones(n))))


def of_rank_less_one(rng, n):
    """The last row is a linear combination of the others, which are well conditioned."""
    M = np.zeros((n, n))
    M[:-1, :-1] = definite(rng, n - 1, 4.0)
    combination = rng.uniform(-1.0, 1.0, n - 1)
    M[-1, :-1] = M[:-1, -1] = M[:-1, :-1] @ combination
    M[-1, -1] = combination @ M[:-1, -1]
    return M


@pytest.mark.parametrize("n", SIZES[1:])
def test_singular_matrices_are_detected_despite_rounding(n):
    """Rank n - 1, otherwise well conditioned: the last pivot is rounding, of either sign."""
    for seed in range(10):
        assert unhealthy(of_rank_less_one(np.random.default_rng([n, seed]), n)) == n - 1


@pytest.mark.parametrize("n", WAYS)
def test_indefinite_matrix_in_a_batch_does_not_affect_others(n):
    rng = np.random.default_rng(n)
    M = np.stack([definite(rng, n, 10.0), with_pivot(rng, n, 1, -1.0), definite(rng, n, 10.0)])
    r = rng.normal(size=(3, n))
    x = jax.jit(jax.vmap(solve_mass))(M, r)
    np.testing.assert_array_equal(np.isnan(x), [[False] * n, [True] * n, [False] * n])
    for i in (0, 2):
        assert backward_error(M[i], np.asarray(x[i]), r[i]) <= 10 * n * EPS


# ---- Units and mass ratios ---------------------------------------------------------------------


@pytest.mark.parametrize("n", WAYS)
def test_solution_scales_with_units_of_coordinates(n):
    """M -> D M D, r -> D r gives x -> x/D: exactly for powers of two D from 1e-6 to 1e6."""
    rng = np.random.default_rng(n)
    M, r = definite(rng, n, 100.0), rng.normal(size=n)
    D = 2.0 ** np.round(np.linspace(-20, 20, n))[rng.permutation(n)]
    np.testing.assert_array_equal(solve(D[:, None] * M * D, D * r), solve(M, r) / D)
    singular = of_rank_less_one(rng, n)
    D = 10.0 ** np.linspace(-6, 6, n)[rng.permutation(n)]
    assert unhealthy(D[:, None] * M * D) == -1
    assert unhealthy(D[:, None] * singular * D) == n - 1


@pytest.mark.parametrize(("upper", "lower"), [(1.0, 1e8), (1e8, 1.0), (1.0, 1e12), (1e12, 1.0)])
def test_extreme_mass_ratios_are_positive_definite(upper, lower):
    """A straight double pendulum of unit links: M = [[m1 + m2, m2], [m2, m2]], det = m1 m2."""
    M, r = np.array([[upper + lower, lower], [lower, lower]]), np.array([1.0, 3.0])
    assert unhealthy(M) == -1
    assert backward_error(M, solve(M, r), r) <= 20 * EPS
    massless = np.array([[lower, lower], [lower, lower]])
    assert unhealthy(massless) == 1


# ---- Derivatives -------------------------------------------------------------------------------


def curve(rng, n):
    """Second-order polynomials M(s), r(s), their coefficients, and a direction of x."""
    M = [definite(rng, n, 30.0), *(A + A.T for A in rng.normal(size=(2, n, n)) / n)]
    return M, rng.normal(size=(3, n)), rng.normal(size=n)


@pytest.mark.full
@pytest.mark.parametrize("n", WAYS)
def test_derivatives_are_those_of_the_inverse(n):
    """x' = y(r' - M' x) and x'' = y(r'' - M'' x - 2 M' x') with y = M^-1, forward and reverse."""
    M, r, w = curve(np.random.default_rng(n), n)

    def solution_at(s):
        powers = jnp.array([1.0, s, s**2 / 2])
        return solve_mass(jnp.tensordot(powers, np.stack(M), 1), powers @ r)

    def weighted(s):
        return w @ solution_at(s)

    x, x1 = jax.jit(lambda: jax.jvp(solution_at, (0.0,), (1.0,)))()
    expected1 = np.linalg.solve(M[0], r[1] - M[1] @ x)
    expected2 = np.linalg.solve(M[0], r[2] - M[2] @ x - 2 * M[1] @ expected1)
    condition = np.linalg.cond(M[0])
    size = norm(np.linalg.inv(M[0]), 2)
    tolerance = 10 * n * EPS * condition
    size1 = size * (norm(r[1]) + norm(M[1], 2) * norm(x))
    size2 = size * (norm(r[2]) + norm(M[2], 2) * norm(x) + 2 * norm(M[1], 2) * size1)
    np.testing.assert_allclose(x1, expected1, rtol=0, atol=tolerance * size1)
    jacobians = jax.jacfwd, jax.jacrev
    first, second = jax.jit(
        lambda: (
            [f(weighted)(0.0) for f in jacobians],
            [f(g(weighted))(0.0) for f in jacobians for g in jacobians],
        )
    )()
    atol1, atol2 = (tolerance * norm(w) * size for size in (size1, size2))
    np.testing.assert_allclose(first, [w @ expected1] * 2, rtol=0, atol=atol1)
    np.testing.assert_allclose(second, [w @ expected2] * 4, rtol=0, atol=atol2)


@pytest.mark.full
@pytest.mark.parametrize("n", WAYS)
def test_second_derivatives_agree_with_differences(n):
    """Central differences of the first derivative, error h^2 + eps/h: 1e-10 at h = 1e-5."""
    M, r, w = curve(np.random.default_rng(n + 1), n)

    def weighted(s):
        powers = jnp.array([1.0, s, s**2 / 2])
        return w @ solve_mass(jnp.tensordot(powers, np.stack(M), 1), powers @ r)

    first = jax.grad(weighted)
    h = 1e-5
    second, third, low, high = jax.jit(
        lambda: (jax.grad(first)(0.0), jax.grad(jax.jacfwd(first))(0.0), first(-h), first(h))
    )()
    # The truncation error is h^2/6 times the fourth derivative, about kappa times the third.
    condition = np.linalg.cond(M[0])
    atol = h**2 * condition * abs(third) + 10 * n * EPS * condition * max(abs(low), abs(high)) / h
    np.testing.assert_allclose(second, (high - low) / (2 * h), rtol=0, atol=atol)
    assert abs(second) > 1e3 * atol


@pytest.mark.parametrize("n", WAYS)
def test_cotangent_of_mass_matrix_is_an_outer_product(n):
    """Of w . x: lam = M^-1 w for r, and -lam x^T for M."""
    rng = np.random.default_rng(n)
    M, r, w = definite(rng, n, 30.0), rng.normal(size=n), rng.normal(size=n)
    to_M, to_r = jax.jit(jax.grad(lambda M, r: w @ solve_mass(M, r), argnums=(0, 1)))(M, r)
    lam, x = np.linalg.solve(M, w), np.linalg.solve(M, r)
    rtol = 20 * n * EPS * np.linalg.cond(M)
    np.testing.assert_allclose(to_r, lam, rtol=0, atol=rtol * norm(lam))
    np.testing.assert_allclose(to_M, -np.outer(lam, x), rtol=0, atol=rtol * norm(lam) * norm(x))
