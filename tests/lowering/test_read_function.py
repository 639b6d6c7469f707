"""Functions on arrays that are read as expressions, and known values met on the way."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxlag as jl
from jaxlag._linalg._kkt import row_weights
from jaxlag._lowering import ScalarProgram
from jaxlag._lowering._graph._expression import Graph
from jaxlag._lowering._jaxpr._from_jaxpr import read
from jaxlag._lowering._symbolic._read_function import read_function
from systems import particle_on_surface


def test_functions_are_read_with_their_structural_zeros():
    """Weights of a row that touches massless coordinates alone, and of one with an inertia."""
    graph = Graph()
    m, a, b = (graph.input("q", i) for i in range(3))
    zero = graph.zero
    found = read_function(graph, 2e-16, row_weights, [[m, zero], [zero, zero]], [[a, b], [zero, b]])
    assert len(found) == 2
    assert all(node.op == "let" for node in found)


KNOWN = {
    "uint8 wraps": lambda: jnp.array([250, 5], jnp.uint8) + jnp.array([10, 1], jnp.uint8),
    "int8 sum": lambda: jnp.cumsum(jnp.array([100, 100], jnp.int8)),
    "to float32": lambda: jnp.arange(3).astype(jnp.float32),
    "mask": lambda: jnp.where(jnp.eye(2, dtype=bool), 3, jnp.arange(2)),
    "empty maximum": lambda: jnp.max(jnp.arange(0), initial=0),
    "cases": lambda: lax.select_n(jnp.arange(4, dtype=jnp.int32) % 2, *jnp.arange(8).reshape(2, 4)),
    "random": lambda: jax.random.normal(jax.random.key(0), (2,)),
    "random, old key": lambda: jax.random.normal(jax.random.PRNGKey(0), (2,)),
    "truths": lambda: jnp.array([True, False]) & ~jnp.array([True, True]),
}


@pytest.mark.parametrize("name", KNOWN)
def test_known_values_are_those_of_jax(name):
    closed = jax.make_jaxpr(lambda x: (KNOWN[name](), x))(1.0)
    graph = Graph()
    found, _ = read(graph, closed, np.array(graph.input("q", 0), object))
    expected = KNOWN[name]()
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


def test_constraints_may_read_random_numbers_and_empty_maxima():
    def phi(t, q, params):
        a = jax.random.normal(jax.random.key(0), (2,))
        none = jnp.max(jnp.arange(0), initial=0)
        return a @ q - a[0] + none.astype(q.dtype)

    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v, ("x", "y"), constraints=(jl.Holonomic(phi, "line"),)
    )
    a = np.asarray(jax.random.normal(jax.random.key(0), (2,)))
    A = np.asarray(system.acceleration([1.0, 0.0], [a[1], -a[0]], {}))
    np.testing.assert_allclose(a @ A, 0.0, atol=1e-15)


@pytest.mark.full
@pytest.mark.parametrize("formulation", ["multipliers", "null_space"])
def test_programs_with_rows_exist_in_both_formulations(formulation):
    """An error of the lowering falls back to the array program, and only `explain` reports it."""
    entry = particle_on_surface.entry
    terms = replace(entry.system._terms, formulation=formulation)
    lowered = ScalarProgram(terms, None).lowered(entry.start()[0], dict(entry.example.params), {})
    assert lowered.reason.startswith("equal to the array program")
