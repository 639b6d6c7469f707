"""Elimination of states, compared with dense least squares."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.linalg import solve_triangular

from jaxlag._fit._linear_least_squares import LinearRows, condense, eliminate, sizes_of, states_of

EPS = np.finfo(float).eps
SEGMENTS, ROWS, STATES, PARAMS, DAMPING = 7, 9, 4, 3, 0.3


def problem(chained):
    """(rows for elimination, the same as one dense matrix, its right-hand side)."""
    rng = np.random.default_rng(0)
    columns = STATES + PARAMS + 1
    measured = rng.normal(size=(SEGMENTS, ROWS, columns))
    joined = rng.normal(size=(SEGMENTS, STATES, columns))
    following = np.full((SEGMENTS, STATES), 3.0)
    for end in (2, SEGMENTS - 1):  # two experiments
        joined[end] = following[end] = 0.0
    prior = rng.normal(size=(2, PARAMS + 1))
    size = PARAMS + SEGMENTS * STATES

    def dense(k, rows):
        full = np.zeros((len(rows), size))
        full[:, :PARAMS] = rows[:, STATES:-1]
        full[:, PARAMS + k * STATES : PARAMS + (k + 1) * STATES] = rows[:, :STATES]
        return full

    blocks, right = [], []
    for k in range(SEGMENTS):
        blocks.append(dense(k, measured[k]))
        right.append(measured[k, :, -1])
        if chained and following[k, 0]:
            block = dense(k, joined[k])
            block[:, PARAMS + (k + 1) * STATES : PARAMS + (k + 2) * STATES] = -np.diag(following[k])
            blocks.append(block)
            right.append(joined[k, :, -1])
    blocks.append(np.eye(2, size) * 0.0)
    blocks[-1][:, :PARAMS] = prior[:, :-1]
    right.append(prior[:, -1])
    chain = (jnp.asarray(joined), jnp.asarray(following)) if chained else (None, None)
    rows = LinearRows(jnp.asarray(measured), *chain, jnp.asarray(prior))
    return rows, np.concatenate(blocks), np.concatenate(right)


def close(found, matrix, right):
    """These are the least-squares solution of a dense problem, to rounding times its condition."""
    expected = np.linalg.lstsq(matrix, np.append(right, np.zeros(len(matrix) - len(right))))[0]
    bound = 10 * EPS * np.linalg.cond(matrix) * np.linalg.norm(expected)
    np.testing.assert_allclose(found, expected, rtol=0, atol=bound)


@pytest.mark.full
@pytest.mark.parametrize("weights", [None, np.array([1.0, 0.3, 0.1])], ids=["alike", "weighed"])
@pytest.mark.parametrize("chained", [False, True])
def test_solution_equals_that_of_the_dense_problem(chained, weights):
    rows, matrix, right = problem(chained)
    given = None if weights is None else jnp.asarray(weights)
    reduced = eliminate(condense(rows), jnp.asarray(DAMPING), given)
    p = solve_triangular(reduced.params[:-1, :-1], reduced.params[:-1, -1])
    damping = np.full(matrix.shape[1], np.sqrt(DAMPING))
    damping[:PARAMS] *= 1.0 if weights is None else weights
    found = np.append(p, states_of(reduced, p))
    close(found, np.concatenate([matrix, np.diag(damping)]), right)


@pytest.mark.parametrize("chained", [False, True])
def test_reduced_matrix_is_the_schur_complement(chained):
    """R^T R is the Schur complement of the states in J^T J; the last number is the residual."""
    rows, matrix, right = problem(chained)
    reduced = eliminate(condense(rows), jnp.asarray(DAMPING))
    size = matrix.shape[1]
    damped = np.concatenate([matrix, np.sqrt(DAMPING) * np.eye(size)])
    normal = damped.T @ damped
    (own, mixed), (_, states) = (np.split(x, [PARAMS], 1) for x in np.split(normal, [PARAMS]))
    factor = np.asarray(reduced.params)[:-1, :-1]
    schur = own - mixed @ np.linalg.solve(states, mixed.T)
    bound = 100 * EPS * np.linalg.norm(normal)
    np.testing.assert_allclose(factor.T @ factor, schur, rtol=0, atol=bound)
    full = np.append(right, np.zeros(size))
    best = np.linalg.lstsq(damped, full)[0]
    residual = np.linalg.norm(damped @ best - full)
    np.testing.assert_allclose(abs(reduced.params[-1, -1]), residual, rtol=1e-12)


@pytest.mark.parametrize("chained", [False, True])
def test_states_for_given_params_equal_the_dense_ones(chained):
    rows, matrix, right = problem(chained)
    p = np.array([0.7, -0.2, 1.1])
    x = states_of(eliminate(condense(rows), jnp.asarray(DAMPING)), jnp.asarray(p))
    damping = np.sqrt(DAMPING) * np.eye(matrix.shape[1] - PARAMS)
    known = right - matrix[:, :PARAMS] @ p
    close(np.ravel(x), np.concatenate([matrix[:, PARAMS:], damping]), known)


@pytest.mark.parametrize("chained", [False, True])
def test_sizes_are_norms_of_the_columns(chained):
    rows, matrix, right = problem(chained)
    sizes = np.append(np.linalg.norm(matrix[:, :PARAMS], axis=0), np.linalg.norm(right))
    np.testing.assert_allclose(sizes_of(condense(rows))[STATES:], sizes, rtol=100 * EPS)
