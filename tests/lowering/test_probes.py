"""Programs as scalars: value and gradient of any user expression, or a named reason."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _probes import FALLBACKS, PROBES

import jaxlag as jl
from jaxlag._lowering._graph._expression import Graph
from jaxlag._lowering._graph._simplify import Expansion
from jaxlag._lowering._jaxpr._differentiate import gradient, tangents
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported, read
from jaxlag._lowering._symbolic._evaluate import evaluate

EPS = np.finfo(float).eps
POINTS = np.array([[0.3, -0.4, 0.8], [-0.6, 0.2, 0.1], [1.2, 0.9, -0.7], [0.6, 0.7, 1.4]])


def scalars(function):
    """(graph, the three inputs, the node of the result)."""
    graph = Graph()
    x = np.empty(3, object)
    x[:] = [graph.input("x", i) for i in range(3)]
    (out,) = read(graph, jax.make_jaxpr(function)(jnp.zeros(3)), x)
    out = out.item()
    return graph, list(x), graph.const(float(out)) if not hasattr(out, "op") else out


def at(roots, point):
    values = {("x", i): value for i, value in enumerate(point)}
    return np.array([float(x) for x in evaluate(roots, values)])


@pytest.mark.parametrize("name", mostly_full(PROBES, *list(PROBES)[::4]))
def test_values_and_derivatives_equal_those_of_jax(name):
    """Values, both modes of the gradient and a column of the Hessian, also simplified."""
    graph, x, node = scalars(PROBES[name])
    (short,) = Expansion(graph).simplified([node])
    value = jax.jit(jax.value_and_grad(PROBES[name]))
    second = jax.jit(jax.jacfwd(jax.grad(PROBES[name])))
    for root in (node, short):
        reverse = gradient(graph, root, x)
        forward = [tangents(graph, [root], {one: graph.one})[0] for one in x]
        hessian = tangents(graph, reverse, {x[0]: graph.one})
        for point in POINTS:
            expected, slope = value(jnp.asarray(point))
            scale = 1.0 + abs(expected) + np.max(np.abs(slope))
            np.testing.assert_allclose(at([root], point)[0], expected, atol=64 * EPS * scale)
            np.testing.assert_allclose(at(reverse, point), slope, atol=256 * EPS * scale)
            np.testing.assert_allclose(at(forward, point), slope, atol=256 * EPS * scale)
            column = second(jnp.asarray(point))[:, 0]
            scale += np.max(np.abs(column))
            np.testing.assert_allclose(at(hessian, point), column, atol=1024 * EPS * scale)


@pytest.mark.parametrize("name", FALLBACKS)
def test_expressions_without_scalar_form_are_named_with_their_file(name):
    function, primitive = FALLBACKS[name]
    with pytest.raises(Unsupported, match=rf"({primitive}).* at .*_probes\.py"):
        scalars(function)


def test_explain_states_why_the_array_program_is_used():
    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - jnp.sort(q)[0]

    system = jl.System(lagrangian, ("x", "y"))
    assert re.search(r"array program.*sort.*test_probes\.py", system.explain(None))
    a = system.acceleration([0.3, -0.2], [0.0, 0.0])
    np.testing.assert_array_equal(a, [0.0, -1.0])


def test_custom_rules_are_used():
    """Twice the derivative of the sine, as declared; a stopped factor is not differentiated."""
    _, x, node = scalars(PROBES["custom rule"])
    graph, x, node = scalars(PROBES["custom rule"])
    np.testing.assert_allclose(
        at(gradient(graph, node, x), POINTS[0])[0], 2 * np.cos(0.3) * -0.4, rtol=4 * EPS
    )
    graph, x, node = scalars(PROBES["stopped"])
    np.testing.assert_allclose(at(gradient(graph, node, x), POINTS[0])[0], 0.3 * -0.4, rtol=4 * EPS)
