"""The solve with nonsymmetric matrices, on the graph and on arrays."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._linalg._kkt import solve_general as on_arrays
from jaxlag._lowering._graph._eliminate import solve_general as on_graph
from jaxlag._lowering._graph._expression import Graph
from jaxlag._lowering._symbolic._evaluate import evaluate


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_nonsymmetric_matrices_are_eliminated(m):
    """The graph agrees with arrays; leading minors that are not positive are reported."""
    graph, rng = Graph(), np.random.default_rng(m)
    S = [[graph.input("q", m * k + j) for j in range(m)] for k in range(m)]
    right = [graph.input("v", k) for k in range(m)]
    x = on_graph(graph, S, right, 1e-10)
    signs = set()
    for k in range(12):
        matrix, side = rng.normal(size=(m, m)) + (k % 2) * 2.0 * np.eye(m), rng.normal(size=m)
        values = {("q", i): value for i, value in enumerate(matrix.ravel())}
        found = evaluate(x, values | {("v", i): value for i, value in enumerate(side)})
        positive = all(np.linalg.det(matrix[:i, :i]) > 0 for i in range(1, m + 1))
        also, fine = on_arrays(jnp.array(matrix), jnp.array(side), 1e-10)
        assert fine == positive
        signs.add(positive)
        if not positive:
            assert np.isnan(found[-1])
            continue
        expected = np.linalg.solve(matrix, side)
        bound = 1e-13 * np.linalg.cond(matrix) * np.linalg.norm(expected)
        np.testing.assert_allclose(found, expected, rtol=0, atol=bound)
        np.testing.assert_allclose(also, expected, rtol=0, atol=bound)
    assert signs == {True, False}
