"""Eigenpairs: closed forms, derivatives beside repeated eigenvalues, units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._analysis._eigenpairs import eigenpairs, left_vectors

EPS = np.finfo(float).eps
A = np.random.default_rng(0).normal(size=(5, 5))
WEIGHTS = np.random.default_rng(1).normal(size=(5, 5))


def of_values(A):
    """A smooth function of the eigenvalues, real and imaginary parts."""
    values = eigenpairs(A).values
    return jnp.sum(jnp.sin(jnp.real(values)) * WEIGHTS[0] + jnp.imag(values) ** 2 * WEIGHTS[1])


def of_vectors(A):
    """One of the vectors that does not depend on their scale."""
    x = eigenpairs(A).vectors
    return jnp.sum(jnp.real(x / x[0]) * WEIGHTS + jnp.imag(x / x[0]) ** 2)


def of_participation(A):
    pairs = eigenpairs(A)
    return jnp.sum(jnp.real(left_vectors(A, pairs).T * pairs.vectors) * WEIGHTS)


@pytest.mark.full
def test_pairs_satisfy_their_equations():
    pairs = eigenpairs(jnp.array(A))
    values, x = np.asarray(pairs.values), np.asarray(pairs.vectors)
    w = np.asarray(left_vectors(jnp.array(A), pairs))
    size = 20 * EPS * np.linalg.norm(A) * np.linalg.norm(x) * np.linalg.norm(w)
    np.testing.assert_allclose(A @ x, x * values, atol=size)
    np.testing.assert_allclose(w @ A, values[:, None] * w, atol=size)
    np.testing.assert_allclose(w @ x, np.eye(5), atol=size)
    assert np.all(pairs.simple)
    assert np.all(np.diff(np.abs(values)) > -size)
    assert np.imag(values[0]) > 0
    assert values[1] == np.conj(values[0])


ORDERS = [(one, other) for one in (jax.jacfwd, jax.jacrev) for other in (jax.jacfwd, jax.jacrev)]


def derivatives(function, at):
    """First derivatives in both modes, second ones in four orders; one program."""

    @jax.jit
    def of(at):
        first = [mode(function)(at) for mode in (jax.jacfwd, jax.jacrev)]
        return first, [one(other(function))(at) for one, other in ORDERS]

    return of(jnp.array(at))


@pytest.mark.full
@pytest.mark.parametrize("function", [of_values, of_vectors, of_participation])
def test_derivatives_in_every_mode(function):
    """Forward, reverse, central differences; second derivatives in four orders."""
    (forward, reverse), twice = derivatives(function, A)
    np.testing.assert_allclose(reverse, forward, atol=200 * EPS * np.max(np.abs(reverse)))
    for other in twice[1:]:
        np.testing.assert_allclose(other, twice[0], atol=200 * EPS * np.max(np.abs(twice[0])))
    h = 1e-5 * np.random.default_rng(2).normal(size=(5, 5))
    slope = jax.jit(jax.value_and_grad(function))
    (above, up), (below, down) = slope(jnp.array(A + h)), slope(jnp.array(A - h))
    np.testing.assert_allclose(np.sum(reverse * h), (above - below) / 2, rtol=1e-8)
    expected = 2 * np.tensordot(twice[0], h)
    np.testing.assert_allclose(up - down, expected, atol=1e-7 * np.max(np.abs(expected)))


DIAGONAL = np.diag([1.0, 2.0, 2.0, -3.0])
JORDAN = np.array([[0.0, 1, 0, 0], [0, 0, 0, 0], [0, 0, -3, 1], [0, 0, -1, -3]])
CRITICAL = np.array([[0.0, 1, 0], [-1, -2, 0], [0, 0, -5]])


@pytest.mark.full
@pytest.mark.parametrize(
    ("matrix", "simple"),
    [(DIAGONAL, [1, 0, 0, 1]), (JORDAN, [0, 0, 1, 1])],
    ids=["diagonal", "jordan"],
)
def test_repeated_eigenvalues_leave_derivatives_of_simple_ones(matrix, simple):
    """Derivatives are NaN for repeated ones only, of both orders and in every mode."""
    pairs = eigenpairs(jnp.array(matrix))
    simple = np.array(simple, bool)
    np.testing.assert_array_equal(pairs.simple, simple)
    assert np.all(pairs.errors < 1e-3)
    values = lambda A: jnp.real(eigenpairs(A).values)  # noqa: E731
    (forward, reverse), _ = derivatives(lambda A: jnp.sum(jnp.sin(values(A)[~simple])), matrix)
    assert np.any(np.isnan(forward))
    assert np.any(np.isnan(reverse))
    first, second = derivatives(lambda A: jnp.sum(values(A)[simple] ** 3), matrix)
    assert all(np.all(np.isfinite(x)) for x in (*first, *second))
    traces = np.sum(3 * np.real(pairs.values[simple]) ** 2)  # A + c shifts them by c
    np.testing.assert_allclose([np.trace(x) for x in first], traces, rtol=20 * EPS)


@pytest.mark.full
def test_second_derivatives_of_repeated_eigenvalues_are_nan():
    assert not np.any(eigenpairs(jnp.array(CRITICAL)).simple[:2])
    values = lambda A: jnp.sum(jnp.real(eigenpairs(A).values)[:2] ** 2)  # noqa: E731
    first, second = derivatives(values, CRITICAL)
    assert all(np.any(np.isnan(x)) for x in (*first, *second))


def test_vectors_of_simple_eigenvalues_have_derivatives_beside_repeated_ones():
    """Against differences: the vector of 1 moves by E_21 / (1 - 2)."""
    entry = jax.jit(jax.grad(lambda A: jnp.real(eigenpairs(A).vectors)[1, 0]))
    moved = entry(jnp.array(DIAGONAL))
    expected = np.zeros((4, 4))
    expected[1, 0] = 1.0 / (1.0 - 2.0)
    np.testing.assert_allclose(moved, expected, atol=10 * EPS)


def test_units_do_not_decide_what_is_simple():
    """States in units 1e12 apart: the same eigenvalues, errors and derivatives."""
    units = np.array([1.0, 1e12, 1e-6, 1e3, 1.0])
    scaled = A * units / units[:, None]
    pairs, plain = eigenpairs(jnp.array(scaled)), eigenpairs(jnp.array(A))
    np.testing.assert_allclose(pairs.values, plain.values, atol=100 * EPS * np.linalg.norm(A))
    assert np.all(pairs.simple)
    assert np.all(pairs.errors < 10 * plain.errors)
    slope = jax.jit(jax.grad(lambda A: jnp.real(eigenpairs(A).values)[0]))
    expected = slope(jnp.array(A)) / units * units[:, None]
    np.testing.assert_allclose(slope(jnp.array(scaled)), expected, rtol=1e-10)


def test_errors_contain_the_rounding_of_stiff_matrices():
    """A slow pair beside fast ones, in a random basis: true errors are below those given."""
    random, found = np.random.default_rng(3), jax.jit(eigenpairs)
    worst = 0.0
    for _ in range(20):
        basis = np.linalg.qr(random.normal(size=(6, 6)))[0]
        blocks = np.diag([-1e6, -1e3, -2.0, -1.0, 0.0, 0.0])
        blocks[4:, 4:] = [[-0.01, 1.0], [-1.0, -0.01]]
        pairs = found(jnp.array(basis @ blocks @ basis.T))
        exact = np.array([1.0, -0.01 + 1j, -0.01 - 1j, 2.0, 1e3, 1e6]) * [-1, 1, 1, -1, -1, -1]
        miss = np.min(np.abs(np.asarray(pairs.values)[:, None] - exact), axis=1)
        worst = max(worst, float(np.max(miss / pairs.errors)))
        assert np.all(pairs.simple)
    assert worst < 1.0  # measured 0.2


def test_errors_of_jordan_blocks_are_those_of_their_size():
    """Blocks of 2 to 4 zeros in a random basis: true errors are below those given."""
    random = np.random.default_rng(4)
    for size in (2, 3, 4):
        basis = np.linalg.qr(random.normal(size=(5, 5)))[0]
        block = np.diag([1.0] * (size - 1) + [0.0] * (5 - size), 1)
        block[size:, size:] = np.diag([-1.0 - i for i in range(5 - size)])
        pairs = eigenpairs(jnp.array(basis @ block @ basis.T))
        zeros = np.abs(pairs.values[:size])
        assert np.max(zeros) < 1e-2
        assert np.all(zeros <= pairs.errors[:size])
        assert np.all(pairs.errors < 2e-2)
        assert not np.any(pairs.simple[:size])
        assert np.all(pairs.simple[size:])


def test_sizes_do_not_overflow():
    A = jnp.array([[0.0, 1.0], [-1e30, 0.0]], jnp.float32)
    np.testing.assert_allclose(eigenpairs(A).values, [1e15j, -1e15j], rtol=1e-6)
    A = jnp.array([[0.0, 1.0], [-1e-30, 0.0]], jnp.float32)
    np.testing.assert_allclose(eigenpairs(A).values, [1e-15j, -1e-15j], rtol=1e-6)
    assert np.all(eigenpairs(A).simple)


@pytest.mark.full
def test_batches_and_single_precision():
    batch = jnp.stack([jnp.array(A), jnp.array(A.T)])
    found = jax.vmap(eigenpairs)(batch)
    np.testing.assert_allclose(found.values[0], found.values[1], atol=1e-13)
    single = eigenpairs(jnp.array(A, jnp.float32))
    assert single.values.dtype == jnp.complex64
    np.testing.assert_allclose(single.values, found.values[0], atol=1e-5)
    assert np.all(single.simple)
