"""Comparison of the eigenvalues of linearized equations with closed forms."""

import numpy as np
from scipy.linalg import matrix_balance
from scipy.optimize import linear_sum_assignment

import jaxlag as jl

EPS = float(np.finfo(float).eps)


def eigenvalues(linear):
    """Shape (..., k)."""
    return np.asarray(jl.modes(linear).eigenvalues)


def rounding(A):
    """Bound on the difference of the eigenvalues of A and of a closed form: Bauer and Fike.

    n eps of the size of A for each of both. The greatest difference measured here is 0.48 of it.
    The matrix is balanced first, as in LAPACK. The units of the states then do not matter.
    """
    balanced, _ = matrix_balance(A, permute=False)
    _, vectors = np.linalg.eig(balanced)
    return 2 * len(A) * EPS * np.linalg.norm(balanced, 2) * np.linalg.cond(vectors)


def check_eigenvalues(linear, expected):
    """Compare sets of eigenvalues. Pairs are chosen for the least sum of distances."""
    found = eigenvalues(linear)
    assert found.shape == np.shape(expected)
    k = found.shape[-1]
    sets = (np.reshape(x, (-1, k)) for x in (found, expected))
    for A, these, those in zip(np.reshape(linear.A, (-1, k, k)), *sets, strict=True):
        distances = np.abs(these[:, None] - those[None])
        worst = np.max(distances[linear_sum_assignment(distances)])
        assert worst <= rounding(A)
    return found


def growth_rates(found, linear):
    """Greatest real parts; 0 for those within rounding."""
    growth = np.max(found.real, axis=-1)
    allowed = np.array([rounding(A) for A in linear.A])
    return np.where(np.abs(growth) > allowed, growth, 0.0)
