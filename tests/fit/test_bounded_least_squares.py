"""Least squares with bounds, compared with scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from jaxlag._fit._bounded_least_squares import box_least_squares

EPS = np.finfo(float).eps
SOLVE = jax.jit(box_least_squares)


def problem(seed, p=6):
    """Bounds on some sides of a problem whose free minimum lies beyond many of them."""
    rng = np.random.default_rng(seed)
    R, c = np.linalg.qr(rng.normal(size=(2 * p, p)))[1], 3.0 * rng.normal(size=p)
    low = np.where(rng.random(p) < 0.3, -np.inf, rng.uniform(-1.0, 0.0, p))
    high = np.where(rng.random(p) < 0.3, np.inf, rng.uniform(0.0, 1.0, p))
    return R, c, low, high


@pytest.mark.parametrize("seed", range(40))
def test_minimum_equals_that_of_scipy(seed):
    R, c, low, high = problem(seed)
    z = np.asarray(SOLVE(R, c, low, high))
    right = lsq_linear(R, c, (low, high), method="bvls", tol=1e-14).x
    np.testing.assert_allclose(z, right, atol=1000 * EPS * np.linalg.cond(R) * np.linalg.norm(c))
    assert np.all((low <= z) & (z <= high))


def test_solution_without_bounds_is_the_triangular_solve():
    R, c, *_ = problem(1)
    nowhere = np.full(6, np.inf)
    np.testing.assert_array_equal(
        SOLVE(R, c, -nowhere, nowhere), jax.scipy.linalg.solve_triangular(R, c)
    )


def test_variable_beyond_its_bound_does_not_fix_another():
    """The free minimum is beyond both bounds, the bounded one is on one of them only."""
    R = np.linalg.cholesky([[1.0, -0.9], [-0.9, 1.0]]).T
    z = SOLVE(R, R @ np.array([-1.0, -0.1]), np.zeros(2), np.full(2, np.inf))
    # (z + (1, 0.1)) R^T R (z + (1, 0.1)) at z = (0, x) is least at x = 0.9 - 0.1.
    np.testing.assert_allclose(z, [0.0, 0.8], atol=20 * EPS)


def test_fixed_variables_keep_their_values():
    R, c, low, high = problem(3)
    low[2] = high[2] = 0.4
    z = np.asarray(SOLVE(R, c, low, high))
    others = np.arange(6) != 2
    right = lsq_linear(R[:, others], c - 0.4 * R[:, 2], (low[others], high[others])).x
    assert z[2] == 0.4
    np.testing.assert_allclose(z[others], right, atol=1e-8)  # scipy's tolerance is 1e-10


def test_batch_of_problems_equals_single_ones():
    problems = [problem(seed) for seed in range(40)]
    stacked = [jnp.stack(x) for x in zip(*problems, strict=True)]
    together = jax.jit(jax.vmap(box_least_squares))(*stacked)
    alone = np.stack([SOLVE(*each) for each in problems])
    np.testing.assert_allclose(together, alone, atol=1e-12)


def test_problem_without_variables_has_an_empty_solution():
    nothing = jnp.zeros(0)
    assert box_least_squares(jnp.zeros((0, 0)), nothing, nothing, nothing).shape == (0,)
