"""M bordered by constraint rows: both formulations, singular M, dependent rows, reactions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from numpy.linalg import norm

from jaxlag._linalg._independent_rows import independent_rows, least_norm
from jaxlag._linalg._kkt import FORMULATIONS, factor_kkt, solve_kkt, solve_reactions
from jaxlag._linalg._mass_solve import rank_floor

EPS = np.finfo(float).eps
SIZES = [(1, 1), (3, 1), (4, 2), (6, 4), (11, 3)]


def scene(n, m, singular=False, seed=0):
    """M (with `singular` of rank n - m at most), A, r, c."""
    rng = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(rng.normal(size=(n, n)))
    sizes = rng.uniform(0.5, 2.0, n)
    if singular:
        sizes[:m] = 0.0
    M = (axes * sizes) @ axes.T
    A = rng.normal(size=(m, n))
    return 0.5 * (M + M.T), A, rng.normal(size=n), rng.normal(size=m)


def dense(M, A, r, c):
    """(x, lam) by one dense solve of the whole matrix, and its condition number."""
    n, m = len(M), len(A)
    K = np.block([[M, -A.T], [-A, np.zeros((m, m))]])
    z = np.linalg.solve(K, np.concatenate([r, c]))
    return z[:n], z[n:], np.linalg.cond(K)


@pytest.mark.full
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("singular", [False, True])
@pytest.mark.parametrize(("n", "m"), mostly_full(SIZES, *SIZES[::2]))
def test_solve_equals_the_dense_solve(n, m, singular, formulation):
    """Also for a singular M that is positive on A x = 0."""
    M, A, r, c = scene(n, m, singular)
    x, lam, condition = dense(M, A, r, c)
    found = jax.jit(lambda *a: solve_kkt(*a, formulation=formulation))(M, A, r, c)
    allowed = 100 * EPS * condition * (norm(x) + norm(lam))
    np.testing.assert_allclose(found[0], x, atol=allowed)
    np.testing.assert_allclose(found[1], lam, atol=allowed)


@pytest.mark.full
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_dependent_rows_are_left_out(formulation):
    """Copies, multiples and sums of rows change x and A^T lam only by rounding."""
    M, A, r, c = scene(6, 3, singular=True)
    x, lam, condition = dense(M, A, r, c)
    M, r = jnp.array(M), jnp.array(r)
    more = np.vstack([A, -3.0 * A[1], A[0] + A[2]])
    c_more = np.concatenate([c, [-3.0 * c[1], c[0] + c[2]]])
    active_rows = independent_rows(M, jnp.array(more))
    assert int(active_rows.sum()) == 3
    found, reduced = solve_kkt(M, jnp.array(more), r, jnp.array(c_more), active_rows, formulation)
    allowed = 100 * EPS * condition * (norm(x) + norm(lam))
    np.testing.assert_allclose(found, x, atol=allowed)
    np.testing.assert_allclose(more.T @ reduced, A.T @ lam, atol=allowed)
    assert (np.asarray(reduced)[~np.asarray(active_rows)] == 0).all()

    # Least norm: no other multipliers of the same force are smaller in this norm.
    shortest = np.asarray(least_norm(jnp.array(more), reduced))
    np.testing.assert_allclose(more.T @ shortest, A.T @ lam, atol=allowed)
    sizes = norm(more, axis=1)
    scaled = (more / sizes[:, None]).T
    expected = np.linalg.pinv(scaled) @ (A.T @ lam) / sizes
    np.testing.assert_allclose(shortest, expected, atol=allowed)


@pytest.mark.full
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_derivatives_agree_with_differences(formulation):
    """Forward, reverse and central differences in all arguments, with one row left out."""
    M, A, r, c = scene(4, 2, singular=True, seed=1)
    A, c = np.vstack([A, 2.0 * A[0]]), np.append(c, 2.0 * c[0])
    active_rows = jnp.array([True, True, False])
    rng = np.random.default_rng(2)
    dM = rng.normal(size=(4, 4))
    point = tuple(map(jnp.asarray, (M, A, r, c)))
    move = (dM + dM.T, rng.normal(size=(3, 4)), rng.normal(size=4), rng.normal(size=3))
    move = tuple(map(jnp.asarray, move))

    def f(M, A, r, c):
        return jnp.concatenate(solve_kkt(M, A, r, c, active_rows, formulation))

    _, forward = jax.jvp(f, point, move)
    weights = jnp.arange(1.0, 8.0)
    back = jax.vjp(f, *point)[1](weights)
    assert np.isclose(
        weights @ forward, sum(jnp.sum(a * b) for a, b in zip(back, move, strict=True)), rtol=1e-12
    )
    h = 1e-5
    ahead, behind = (f(*(x + s * h * d for x, d in zip(point, move, strict=True))) for s in (1, -1))
    # Truncation h^2 and rounding eps/h of a solution of condition about 1e2.
    np.testing.assert_allclose(forward, (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_nearly_dependent_rows_give_nan_and_are_reported(formulation):
    """Every component is NaN, and `healthy` is False for the dependent row."""
    M, A, r, c = scene(4, 1)
    A = jnp.array(np.vstack([A, A + 1e-8]))
    c = jnp.array([c[0], c[0]])
    x, lam = solve_kkt(jnp.array(M), A, jnp.array(r), c, None, formulation)
    assert np.isnan(x).all()
    assert np.isnan(lam).all()
    _, rows = factor_kkt(jnp.array(M), A, None, formulation).healthy
    assert rows.tolist() == [True, False]
    assert rank_floor(jnp.dtype(float)) > 1e-16


def test_singular_mass_on_the_null_space_gives_nan():
    """M must be positive on A x = 0."""
    M = jnp.diag(jnp.array([1.0, 0.0, 0.0]))
    A = jnp.array([[0.0, 1.0, 0.0]])
    for formulation in FORMULATIONS:
        x, _ = solve_kkt(M, A, jnp.ones(3), jnp.ones(1), None, formulation)
        assert np.isnan(x).all()


# ---- Reactions -----------------------------------------------------------------------------------


def test_forces_linear_in_multipliers_equal_the_dense_solve():
    M, A, r, c = scene(5, 2, singular=True)
    G = 0.1 * np.random.default_rng(3).normal(size=(5, 2))
    K = np.block([[M, -(A.T + G)], [-A, np.zeros((2, 2))]])
    z = np.linalg.solve(K, np.concatenate([r, c]))
    M, A, r, c = map(jnp.asarray, (M, A, r, c))
    found = jnp.concatenate(solve_reactions(M, A, r, lambda lam: G @ lam, c, None, True))
    np.testing.assert_allclose(found, z, atol=100 * EPS * np.linalg.cond(K) * norm(z))


def test_forces_by_the_size_of_a_multiplier_satisfy_the_equations():
    """Friction mu |lam| for either sign of lam, and its derivative."""
    M, A, r, c = map(jnp.asarray, scene(3, 1))
    g = jnp.array([0.3, -0.2, 0.1])

    def solved(r):
        return solve_reactions(M, A, r, lambda lam: g * jnp.abs(lam[0]), c, None, False)

    for right in (r, -r):
        x, lam = solved(right)
        np.testing.assert_allclose(M @ x, right + g * abs(lam[0]) + lam @ A, atol=1e-13)
        np.testing.assert_allclose(A @ x, -c, atol=1e-13)
    d = jnp.array([0.2, 0.5, -0.4])
    h = 1e-6
    slope = (solved(r + h * d)[0] - solved(r - h * d)[0]) / (2 * h)
    np.testing.assert_allclose(jax.jvp(lambda r: solved(r)[0], (r,), (d,))[1], slope, atol=1e-8)


def test_painleve_paradox_gives_nan():
    """A rod on a rough floor: with mu above 4/3 at 45 degrees, A M^-1 (A^T + G) is negative."""
    M = jnp.diag(jnp.array([1.0, 1.0, 1.0 / 12]))
    s = c = 0.5 * np.sqrt(0.5)
    A = jnp.array([[0.0, 1.0, -c]])

    def reaction(mu):
        G = jnp.array([mu, 0.0, mu * s])
        r, gamma = jnp.array([0.0, -9.81, 0.0]), jnp.array([-1.0])
        return solve_reactions(M, A, r, lambda lam: G * lam[0], gamma, None, True)[1]

    # 1 + 12 c (c - mu s) = 0 at mu = 1 + 1 / (12 c^2) = 5/3.
    assert np.isfinite(reaction(1.6)).all()
    assert np.isnan(reaction(1.7)).all()
