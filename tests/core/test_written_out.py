"""Programs on small arrays written out: the same values, without sums, products and libraries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import jaxpr_as_fun

from jaxlag._core import _xla
from jaxlag._core._jaxprs import equations
from jaxlag._core._written_out import COLUMNS, FACTORS, TERMS, has_form, written_out

EPS = np.finfo(float).eps


def out_of(function, *args):
    """(results of the program written out, names of its operations)."""
    program = jax.make_jaxpr(function)(*args)
    code = written_out(program)
    names = {eqn.primitive.name for eqn in equations(code.jaxpr)}
    return jax.jit(jaxpr_as_fun(code))(*args), names


def sums(x):
    parts = jnp.sum(x, (0, 2)), jnp.prod(x, 1), jnp.max(x, 2), jnp.min(x, (0, 1))
    best = jnp.argmax(x, 1), jnp.argmin(x, 2), lax.argmax(x, np.int64(1), jnp.int32)
    return parts, jnp.any(x > 0, 0), jnp.all(x > -1.0, (1, 2)), best


def products(x):
    y = x[:, :, :2]
    plain = x[0] @ x[1].T, x[0] @ x[0, 0], x[0, 0] @ x[0, 0], jnp.outer(x[0, 0], x[1, 1])
    return plain, jnp.einsum("bij,bik->bjk", x, y), jnp.tensordot(x, y, ((1, 0), (1, 0)))


def scatters(x):
    at, row = jnp.array([2, 0, 7]), x[0, 0]
    return (
        row.at[at].set(jnp.array([5.0, 6.0, 7.0])),  # beyond the end: dropped
        row.at[at].set(jnp.array([5.0, 6.0, 7.0]), mode="clip"),
        row.at[-1].add(3.0),
        row.at[jnp.array([1, 1])].add(jnp.array([0.5, 0.25])),
        x[0].at[:, at[:2]].add(x[1, :, :2]),
        x[0].at[at[:2]].set(x[1, :2]),
        (row > 0).at[at[1]].set(True),
        lax.scatter(jnp.zeros(300), jnp.array([[3], [1]], jnp.int8), row[:2], ALONG),
    )


ALONG = lax.ScatterDimensionNumbers((), (0,), (0,))


@pytest.mark.parametrize("function", [sums, products, scatters])
def test_values_are_those_of_the_program(function):
    x = jnp.asarray(np.random.default_rng(1).normal(size=(2, 3, 4)))
    found, names = out_of(function, x)
    assert not names & {"dot_general", "scatter", "scatter-add", "argmax", "argmin"}
    assert not any(name.startswith("reduce_") for name in names)
    for a, b in zip(found, jax.tree.leaves(function(x)), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=16 * EPS)


def test_an_index_of_nan_is_that_of_numpy():
    """The first NaN, whatever else is there; the first of equal entries; false before true."""
    rows = np.array([[1.0, np.nan, 3.0, np.nan], [2.0, 5.0, 5.0, 2.0], [np.inf, 0.0, 0.0, -np.inf]])
    pair = out_of(lambda x: (jnp.argmax(x, 1), jnp.argmin(x, 1), jnp.argmax(x > 4.0, 1)), rows)[0]
    right = np.argmax(rows, 1), np.argmin(rows, 1), np.argmax(rows > 4.0, 1)
    for a, b in zip(pair, right, strict=True):
        np.testing.assert_array_equal(a, b)


def solve(a, b, factor):
    """factor a^-1 b with an implicit derivative, as `jnp.linalg.solve` has, by Q and R."""
    q, r = jnp.linalg.qr(a)
    inverse = lambda b: factor * jax.scipy.linalg.solve_triangular(r, q.T @ b)  # noqa: E731
    return lax.custom_linear_solve(lambda x: a @ x, b, lambda _, b: inverse(b), lambda _, b: b)


@pytest.mark.parametrize("shape", [(1, 1), (5, 5), (6, 4), (3, 5), (COLUMNS, COLUMNS)])
@pytest.mark.parametrize("mode", ["reduced", "complete"])
def test_factors_of_matrices_are_orthogonal_and_triangular(shape, mode):
    """Backward errors over eps: at most 2.2 sqrt(m) in 1,000 matrices, measured."""
    rng = np.random.default_rng(2)
    units = 10.0 ** rng.uniform(-9, 9, shape[1])  # of the columns
    a = jnp.asarray(rng.normal(size=shape) * units)
    (q, r), names = out_of(lambda a: jnp.linalg.qr(a, mode), a)
    assert "qr" not in names
    bound = 10 * EPS * np.sqrt(shape[0])
    np.testing.assert_allclose(q.T @ q, np.eye(q.shape[1]), rtol=0, atol=bound)
    np.testing.assert_allclose(q @ r / units, a / units, rtol=0, atol=4 * bound)
    np.testing.assert_array_equal(np.tril(r, -1), 0.0)
    right = jnp.linalg.qr(a, mode)[1]  # of the same signs
    np.testing.assert_array_equal(np.sign(np.diagonal(r)), np.sign(np.diagonal(right)))


def test_factors_of_special_matrices():
    """Dependent and vanishing columns, numbers near overflow, arrays of matrices, NaN."""
    rng = np.random.default_rng(3)
    a = rng.normal(size=(6, 4, 3))
    a[0, :, 1] = 2.0 * a[0, :, 0]
    a[1, :, 2] = 0.0
    a[2] = 0.0
    a[3] *= 1e200
    a[4] *= 1e-200
    a[5] = np.triu(a[5])
    q, r = out_of(jnp.linalg.qr, jnp.asarray(a))[0]
    for i in range(len(a)):
        size = np.max(np.abs(a[i])) or 1.0
        np.testing.assert_allclose(q[i].T @ q[i], np.eye(3), rtol=0, atol=20 * EPS)
        np.testing.assert_allclose(q[i] @ r[i] / size, a[i] / size, rtol=0, atol=40 * EPS)
    a[0, 2, 1] = np.nan
    q, r = out_of(jnp.linalg.qr, jnp.asarray(a[0]))[0]
    assert np.isnan(r).any()
    assert np.isnan(q).any()


@pytest.mark.parametrize("lower", [False, True])
@pytest.mark.parametrize("trans", [0, 1])
@pytest.mark.parametrize("unit_diagonal", [False, True])
@pytest.mark.parametrize("left", [False, True])
def test_triangular_systems_are_solved(lower, trans, unit_diagonal, left):
    rng = np.random.default_rng(4)
    a = jnp.asarray(rng.normal(size=(4, 4)) + 4.0 * np.eye(4))  # the other half is not read
    b = jnp.asarray(rng.normal(size=(4, 2) if left else (2, 4)))
    options = {"lower": lower, "transpose_a": bool(trans), "unit_diagonal": unit_diagonal}

    def function(a, b):
        return lax.linalg.triangular_solve(a, b, left_side=left, **options)

    (x,), names = out_of(function, a, b)
    assert "triangular_solve" not in names
    np.testing.assert_allclose(x, function(a, b), rtol=1e-13, atol=1e-13)


def test_solves_with_implicit_derivatives():
    """Each has a program of its own."""
    rng = np.random.default_rng(5)
    a = jnp.asarray(rng.normal(size=(4, 4)) + 3.0 * np.eye(4))

    def several(a, b):
        return [solve(a, b, float(k)) for k in range(8)]

    found, names = out_of(several, a, jnp.arange(4.0))
    assert "custom_linear_solve" not in names
    for k, x in enumerate(found):
        np.testing.assert_allclose(a @ x, k * jnp.arange(4.0), rtol=0, atol=512 * EPS)


def test_what_is_large_or_has_no_form_stays():
    few, many = jnp.ones(TERMS), jnp.ones(FACTORS + 1)
    wide = jnp.ones((COLUMNS + 1, COLUMNS + 1))

    def forms(function, *args):
        return [has_form(eqn) for eqn in equations(jax.make_jaxpr(function)(*args))]

    row, square = jnp.ones(FACTORS), jnp.ones((FACTORS, FACTORS))
    assert any(forms(jnp.dot, square, row))
    assert not any(forms(jnp.dot, many, many))
    assert not any(forms(jnp.dot, row > 0, row > 0))
    assert not any(forms(lax.dot, row.astype(jnp.bfloat16), row.astype(jnp.bfloat16)))
    assert not any(forms(lambda x: x.at[jnp.array([0])].apply(jnp.exp), row))
    part = lax.ScatterDimensionNumbers((1,), (0,), (0,))
    windows = jnp.array([[3], [1]]), jnp.ones((2, 2)), part
    assert not any(forms(lambda x: lax.scatter_add(x, *windows), square))
    assert not any(forms(jnp.linalg.qr, wide))
    assert not any(forms(jnp.sort, few))
    assert not any(forms(jnp.dot, jnp.ones(0), jnp.ones(0)))


def test_loops_with_scatters_are_not_marked():
    """XLA has no code for a scatter within a native function."""

    def loop(x):
        return lax.fori_loop(0, 3, lambda i, x: x.at[jnp.array([0, 1]) + i].add(1.0), x)

    program = jax.make_jaxpr(loop)(jnp.ones(5))
    assert not _xla.is_plain(program.jaxpr)
    assert _xla.is_plain(written_out(program).jaxpr)
