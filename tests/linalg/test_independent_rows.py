"""Which rows are independent, which are only rounding, and the multipliers of the others."""

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
    found, void, size = row_sizes(rows, q, rows(q))
    assert found.tolist() == [there]
    assert void.tolist() == [False]  # it is one nearby
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


# ---- Least norm where levers are short -----------------------------------------------------------

# Two rollers of radius r, a row that doubles the first, and what both imply, twice.
ROLLERS = {
    "doubled": lambda r: [[1.0, -r, 0.0], [1.0, 0.0, -r], [2.0, -2 * r, 0.0]],
    "implied": lambda r: [[1.0, -r, 0.0], [1.0, 0.0, -r], [0.0, 1.0, -1.0], [0.0, 3.0, -3.0]],
}


def least_by_hand(A, f):
    """The same in closed form: of the null vectors of A^T, in 50 digits."""
    with mpmath.workdps(50):
        A = mpmath.matrix(A.tolist())
        sizes = [mpmath.norm(A[k, :]) for k in range(A.rows)]
        # (1/|A_k|) A_k, each coordinate in its own unit, which leaves equations what they are
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
def test_least_norm_with_levers_of_any_length(kind, dtype):
    """A^T lam is kept to rounding of its terms, and lam is the least, from 1 m to 10 nm."""
    eps = float(jnp.finfo(dtype).eps)

    @jax.jit
    def solved(A, M, lam):
        kept = independent_rows(M, A, mobile_first=True)
        return kept, least_norm(A, lam, kept, kept | True, units_of(M, A))

    for r in 10.0 ** -np.arange(9):
        A = np.array(ROLLERS[kind](r), dtype)
        M = np.diag(np.array([1.0, r**2, 2 * r**2], dtype))
        lam = np.array([0.3, 1.1, *[0.0] * (len(A) - 2)], dtype)
        kept, found = solved(A, M, lam)
        assert int(jnp.sum(kept)) == 2
        exact, found = A.astype(float), np.asarray(found, float)
        f = exact.T @ lam.astype(float)
        expected = least_by_hand(exact, f)
        sizes = np.linalg.norm(exact, axis=1)
        worst = np.max(np.abs(sizes * (found - expected))) / np.max(np.abs(sizes * expected))
        assert worst < 16 * eps  # 4 eps is the worst there is
        left = np.abs(found @ exact - f) / (np.abs(found) @ np.abs(exact) + np.abs(f))
        assert left.max() < 8 * eps


def on_the_graph(A, units, kept, lam):
    """The same by scalar code, in numbers."""
    graph, (m, n) = Graph(), A.shape
    rows = [
        [graph.input("A", i * n + j) if A[i, j] else graph.zero for j in range(n)] for i in range(m)
    ]
    given = {"A": A.ravel(), "units": units, "active_rows": kept, "nonzero": np.ones(m)}
    units, kept, there = (
        [graph.input(name, i) for i in range(given[name].size)]
        for name in ("units", "active_rows", "nonzero")
    )
    sharing = Sharing(list(range(m)), there)
    found = shared(graph, rows, units, kept, sharing, float(np.finfo(float).eps))
    values = {(name, i): float(x) for name, xs in given.items() for i, x in enumerate(xs)}
    flat = [float(x) for x in evaluate([x for row in found for x in row], values)]
    return np.reshape(flat, (m, m)) @ lam


@pytest.mark.parametrize("kind", list(ROLLERS))
def test_least_norm_on_the_graph_is_as_accurate(kind):
    eps = float(np.finfo(float).eps)
    for r in 10.0 ** -np.arange(9):
        A = np.array(ROLLERS[kind](r))
        M = jnp.diag(jnp.array([1.0, r**2, 2 * r**2]))
        units = units_of(M, jnp.asarray(A))
        kept = np.asarray(independent_rows(M, jnp.asarray(A), mobile_first=True))
        lam = np.where(kept, np.array([0.3, 1.1, 0.7, -0.4])[: len(A)], 0.0)
        lam = lam / np.linalg.norm(A * np.asarray(units), axis=1)
        found, f = on_the_graph(A, np.asarray(units), kept, lam), A.T @ lam
        expected, sizes = least_by_hand(A, f), np.linalg.norm(A, axis=1)
        worst = np.max(np.abs(sizes * (found - expected))) / np.max(np.abs(sizes * expected))
        assert worst < 16 * eps  # 3 eps is the worst there is
        left = np.abs(found @ A - f) / (np.abs(found) @ np.abs(A) + np.abs(f))
        assert left.max() < 8 * eps


def test_derivatives_of_the_least_norm_where_levers_are_short():
    """Along a family whose rank stays what it is: both modes, and central differences."""

    def found(x):
        r = 1e-6 * (1.0 + x[0])
        A = jnp.stack([jnp.array([1.0, 0.0, 0.0]) - r * e for e in jnp.eye(3)[1:]])
        A = jnp.concatenate([A, (1.0 + x[1]) * (A[:1] - A[1:]) / r, A[:1] * x[2]])
        M = jnp.diag(jnp.array([1.0, 1e-12, 2e-12]))
        kept = jnp.array([True, False, True, False])
        lam = jnp.stack([0.3 + x[0], 0.0, 1e-6 * (0.2 + x[1] * x[2]), 0.0])
        units = units_of(M, A)
        found = least_norm(A, lam, kept, kept | True, units)
        return found * jnp.sqrt(jnp.sum(A**2, axis=1))

    x = jnp.array([0.3, 0.4, 1.7])
    forwards, backwards = jax.jacfwd(found)(x), jax.jacrev(found)(x)
    h = 1e-5
    differences = [(found(x + h * e) - found(x - h * e)) / (2 * h) for e in jnp.eye(3)]
    np.testing.assert_allclose(forwards, backwards, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forwards, np.stack(differences, axis=1), rtol=1e-7, atol=1e-9)
