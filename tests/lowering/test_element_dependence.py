"""Patterns of Jacobians: no entry is missed, and none is listed that the operations exclude."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxlag._lowering._sparsity import compressed, jacobian_pattern

N = 12
WEIGHTS = np.where(np.arange(N * N).reshape(N, N) % 5 == 0, 0.7, 0.0)
INDICES = np.array([3, 3, 0, 11, 7])

EXACT = {
    "elementwise": lambda x: jnp.sin(x) * x[::-1] / (2.0 + x**2),
    "differences": lambda x: jnp.diff(x) ** 2,
    "slices": lambda x: x[2:9:3] * x[1:4],
    "rolled": lambda x: jnp.roll(x, 3) - x,
    "reshaped": lambda x: jnp.sum(x.reshape(4, 3).T ** 2, axis=0),
    "largest": lambda x: jnp.max(x.reshape(4, 3), axis=1),
    "product": lambda x: jnp.prod(x.reshape(3, 4), axis=0),
    "gathered": lambda x: x[INDICES] ** 2,
    "added at indices": lambda x: jnp.zeros(N).at[INDICES].add(x[:5] ** 2),
    "outside": lambda x: x.at[jnp.array([2, 40])].get(mode="fill", fill_value=0.0),
    "known weights": lambda x: WEIGHTS @ jnp.tanh(x),
    "batched product": lambda x: jnp.einsum(
        "kij,kj->ki", x.reshape(3, 2, 2), x.reshape(3, 2, 2)[:, 0]
    ),
    "padded": lambda x: lax.pad(x**2, 0.0, [(1, -2, 1)]),
    "stacked": lambda x: jnp.stack([x[:3], x[3:6] ** 2], axis=1),
    "one branch": lambda x: lax.cond(True, jnp.sin, jnp.cos, x),
    "vmapped": lambda x: jax.vmap(lambda a, b: a @ b)(x.reshape(6, 2), jnp.cos(x.reshape(6, 2))),
    "called": lambda x: jax.jit(jnp.sin)(x) + jax.checkpoint(jnp.cos)(x),
    "with a rule": lambda x: jax.nn.relu(x) + jnp.logaddexp(x, x[::-1]),
}
COARSE = {
    "set at indices": lambda x: x.at[jnp.array([1, 4])].set(x[:2] ** 2),
    "cumulated": jnp.cumsum,
    "sorted": jnp.sort,
    "scanned": lambda x: lax.scan(lambda c, y: (c * y, c + y), 1.0, x)[1],
    "repeated": lambda x: lax.fori_loop(0, 3, lambda i, y: jnp.sin(y) + jnp.roll(y, 1), x),
    "solved": lambda x: jnp.linalg.solve(jnp.eye(N) + x[:, None] * x, x),
    "unknown index": lambda x: lax.dynamic_slice(x, (jnp.argmax(x),), (3,)),
    "either branch": lambda x: lax.cond(x[5] > 0, lambda x: x[:3], lambda x: x[:3] * x[3:6], x),
}


def patterns(function):
    """(the pattern that was found, the entries that differ from zero somewhere)."""
    x = jax.ShapeDtypeStruct((N,), float)
    found = jacobian_pattern(function, x).toarray()
    slopes = jax.jit(jax.jacfwd(function))
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (6, N))
    present = np.any([np.asarray(slopes(x)) != 0 for x in points], axis=0)
    return found, present.reshape(found.shape)


@pytest.mark.parametrize("name", EXACT)
def test_pattern_is_that_of_the_jacobian(name):
    found, present = patterns(EXACT[name])
    np.testing.assert_array_equal(found, present)


@pytest.mark.parametrize("name", COARSE)
def test_no_entry_is_missed(name):
    found, present = patterns(COARSE[name])
    assert not np.any(present & ~found)


def test_params_leave_no_trace():
    """Values that are unknown but not asked about have no pattern."""
    x, p = jax.ShapeDtypeStruct((N,), float), jax.ShapeDtypeStruct((N, N), float)
    found = jacobian_pattern(lambda x, p: (p @ jnp.ones(N)) * x, x, p).toarray()
    np.testing.assert_array_equal(found, np.eye(N, dtype=bool))


@pytest.mark.parametrize(("name", "of_rows"), [("differences", False), ("reshaped", True)])
def test_entries_are_read_from_few_derivatives(name, of_rows):
    """Two for differences by columns; one for sums of separate triples by rows."""
    function, x = EXACT[name], np.random.default_rng(1).normal(size=N)
    pattern = jacobian_pattern(function, jax.ShapeDtypeStruct((N,), float))
    m, n = pattern.shape
    rows, columns = np.mgrid[: m + 1, : n + 1]  # the last ones lie outside
    read = compressed(pattern, rows, columns)
    expected = np.zeros((m + 1, n + 1))
    expected[:m, :n] = jax.jacrev(function)(x)
    assert (read.of_rows, len(read.seeds)) == (of_rows, 1 if of_rows else 2)
    np.testing.assert_allclose(read.entries(function, jnp.array(x)), expected, rtol=1e-14)
