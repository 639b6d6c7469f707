"""Independent rows, rows that are only rounding, and multipliers of dependent rows."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from jaxlag._linalg._independent_rows import independent_rows, least_norm
from jaxlag._linalg._kkt import units_of
from jaxlag._linalg._row_residuals import row_sizes
from jaxlag._lowering._graph._expression import Graph
from jaxlag._lowering._symbolic._evaluate import evaluate
from jaxlag._lowering._symbolic._shared_reactions import Sharing, shared


def test_dependent_rows_are_left_out():
    """The first of equal rows is selected; rows marked to come first precede the others."""
    M, rows = jnp.eye(3), jnp.array([[1.0, 0, 0], [2.0, 0, 0], [0, 1.0, 0]])
    assert independent_rows(M, rows).tolist() == [True, False, True]
    assert independent_rows(M, rows, (1, 0, 1)).tolist() == [False, True, True]
    assert independent_rows(M, jnp.zeros((2, 3))).tolist() == [False, False]


def row_of(function):
    """The gradient of a function of q as one row of a constraint."""
    return lambda q: jax.jacrev(function)(q)[None]


@pytest.mark.full
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize(
    ("function", "q", "nonzero"),
    [
        (lambda q: jnp.cos(q[0]), [np.pi, 0.3], False),
        (lambda q: jnp.sin(q[0]) * q[1], [np.pi, 0.0], False),
        (lambda q: q[0] ** 2, [0.0, 1.0], False),
        (lambda q: q @ q, [1e-4, -1e-4], True),  # even for a short rod
        (lambda q: (q[0] - q[1]) ** 2, [1000.0, 1000.125], True),  # even far from the origin
        (lambda q: jnp.arcsin(q[0]), [-0.999999, 0.0], True),  # near the end of a domain
        (lambda q: jnp.cos(q[0]), [np.pi - 1e-4, 0.3], True),
    ],
)
def test_rows_of_rounding_count_as_zero(function, q, nonzero, dtype):
    rows, q = row_of(function), jnp.array(q, dtype)
    found, void, size = row_sizes(rows, q, rows(q))
    assert found.tolist() == [nonzero]
    assert void.tolist() == [False]  # it is nonzero nearby
    if nonzero:
        np.testing.assert_allclose(size[0], jnp.linalg.norm(rows(q)), rtol=1e-6)
    else:
        assert float(size[0]) > 0.1  # the rate at which it grows


@pytest.mark.full
def test_zero_rows_have_no_multiplier_and_no_derivative():
    """A row of 1e-16 parallel to the first row, and a zero row."""
    A = jnp.array([[1.0, 0.0], [1e-16, 0.0], [0.0, 0.0]])
    active_rows, nonzero = jnp.array([True, False, False]), jnp.array([True, False, False])
    lam = jnp.array([2.0, 0.0, 0.0])
    np.testing.assert_allclose(least_norm(A, lam, active_rows, nonzero), lam, atol=1e-15)
    slopes = jax.jacrev(least_norm)(A, lam, active_rows, nonzero)
    assert np.all(np.isfinite(slopes))
    np.testing.assert_array_equal(slopes[:, 1:], 0.0)


# ---- Least norm with short levers ----------------------------------------------------------------

# Two rollers of radius r. Dependent rows: twice the first one, or multiples of the difference.
ROLLERS = {
    "doubled": lambda r: [[1.0, -r, 0.0], [1.0, 0.0, -r], [2.0, -2 * r, 0.0]],
    "implied": lambda r: [[1.0, -r, 0.0], [1.0, 0.0, -r], [0.0, 1.0, -1.0], [0.0, 3.0, -3.0]],
}


def least_by_hand(A, f):
    """The same in closed form: by a singular value decomposition in 50 digits."""
    with mpmath.workdps(50):
        A = mpmath.matrix(A.tolist())
        sizes = [mpmath.norm(A[k, :]) for k in range(A.rows)]
        # (1/|A_k|) A_k, each coordinate in its own unit: an equivalent system of equations
        units = [max(abs(A[k, i]) for k in range(A.rows)) for i in range(A.cols)]
        B = mpmath.matrix(A.cols, A.rows)
        for i in range(A.cols):
            for k in range(A.rows):
                B[i, k] = A[k, i] / sizes[k] / units[i]
        U, S, V = mpmath.svd_r(B)
        parts = U.T * mpmath.matrix([x / u for x, u in zip(f, units, strict=True)])
        y = [sum(V[j, k] * parts[j] / S[j] for j in range(2)) for k in range(A.rows)]
        return np.array([float(x / size) for x, size in zip(y, sizes, strict=True)])


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("kind", list(ROLLERS))
def test_least_norm_is_accurate_for_levers_of_any_length(kind, dtype):
    """A^T lam agrees to rounding of its terms, and lam has least norm, from 1 m to 10 nm."""
    eps = float(jnp.finfo(dtype).eps)

    @jax.jit
    def solved(A, M, lam):
        active_rows = independent_rows(M, A, mobile_first=True)
        return active_rows, least_norm(A, lam, active_rows, active_rows | True, units_of(M, A))

    for r in 10.0 ** -np.arange(9):
        A = np.array(ROLLERS[kind](r), dtype)
        M = np.diag(np.array([1.0, r**2, 2 * r**2], dtype))
        lam = np.array([0.3, 1.1, *[0.0] * (len(A) - 2)], dtype)
        active_rows, found = solved(A, M, lam)
        assert int(jnp.sum(active_rows)) == 2
        exact, found = A.astype(float), np.asarray(found, float)
        f = exact.T @ lam.astype(float)
        expected = least_by_hand(exact, f)
        sizes = np.linalg.norm(exact, axis=1)
        worst = np.max(np.abs(sizes * (found - expected))) / np.max(np.abs(sizes * expected))
        assert worst < 16 * eps  # measured: at most 4 eps
        left = np.abs(found @ exact - f) / (np.abs(found) @ np.abs(exact) + np.abs(f))
        assert left.max() < 8 * eps


def on_the_graph(A, units, active_rows, lam):
    """The same by the scalar program, evaluated with numbers."""
    graph, (m, n) = Graph(), A.shape
    rows = [
        [graph.input("A", i * n + j) if A[i, j] else graph.zero for j in range(n)] for i in range(m)
    ]
    given = {"A": A.ravel(), "units": units, "active_rows": active_rows, "nonzero": np.ones(m)}
    units, active_rows, nonzero = (
        [graph.input(name, i) for i in range(given[name].size)]
        for name in ("units", "active_rows", "nonzero")
    )
    sharing = Sharing(list(range(m)), nonzero)
    found = shared(graph, rows, units, active_rows, sharing, float(np.finfo(float).eps))
    values = {(name, i): float(x) for name, xs in given.items() for i, x in enumerate(xs)}
    flat = [float(x) for x in evaluate([x for row in found for x in row], values)]
    return np.reshape(flat, (m, m)) @ lam


@pytest.mark.full
@pytest.mark.parametrize("kind", list(ROLLERS))
def test_least_norm_on_the_graph_is_as_accurate(kind):
    eps = float(np.finfo(float).eps)
    for r in 10.0 ** -np.arange(9):
        A = np.array(ROLLERS[kind](r))
        M = jnp.diag(jnp.array([1.0, r**2, 2 * r**2]))
        units = units_of(M, jnp.asarray(A))
        active_rows = np.asarray(independent_rows(M, jnp.asarray(A), mobile_first=True))
        lam = np.where(active_rows, np.array([0.3, 1.1, 0.7, -0.4])[: len(A)], 0.0)
        lam = lam / np.linalg.norm(A * np.asarray(units), axis=1)
        found, f = on_the_graph(A, np.asarray(units), active_rows, lam), A.T @ lam
        expected, sizes = least_by_hand(A, f), np.linalg.norm(A, axis=1)
        worst = np.max(np.abs(sizes * (found - expected))) / np.max(np.abs(sizes * expected))
        assert worst < 16 * eps  # measured: at most 3 eps
        left = np.abs(found @ A - f) / (np.abs(found) @ np.abs(A) + np.abs(f))
        assert left.max() < 8 * eps


@pytest.mark.full
def test_derivatives_of_the_least_norm_agree_for_short_levers():
    """Along a family of constant rank: both modes and central differences."""

    def found(x):
        r = 1e-6 * (1.0 + x[0])
        A = jnp.stack([jnp.array([1.0, 0.0, 0.0]) - r * e for e in jnp.eye(3)[1:]])
        A = jnp.concatenate([A, (1.0 + x[1]) * (A[:1] - A[1:]) / r, A[:1] * x[2]])
        M = jnp.diag(jnp.array([1.0, 1e-12, 2e-12]))
        active_rows = jnp.array([True, False, True, False])
        lam = jnp.stack([0.3 + x[0], 0.0, 1e-6 * (0.2 + x[1] * x[2]), 0.0])
        units = units_of(M, A)
        found = least_norm(A, lam, active_rows, active_rows | True, units)
        return found * jnp.sqrt(jnp.sum(A**2, axis=1))

    x = jnp.array([0.3, 0.4, 1.7])
    forwards, backwards = jax.jacfwd(found)(x), jax.jacrev(found)(x)
    h = 1e-5
    differences = [(found(x + h * e) - found(x - h * e)) / (2 * h) for e in jnp.eye(3)]
    np.testing.assert_allclose(forwards, backwards, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forwards, np.stack(differences, axis=1), rtol=1e-7, atol=1e-9)
