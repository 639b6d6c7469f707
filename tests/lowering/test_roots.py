"""Square roots: inverses of x and of sqrt(x) share a division."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._lowering._graph._expression import Graph
from jaxlag._lowering._graph._straight_line import _is_nonnegative, assemble

EPS = np.finfo(float).eps
POTENTIALS = {
    "quotient by a root": lambda q: -1.0 / jnp.sqrt(q @ q),
    "norm": lambda q: -1.0 / jnp.linalg.norm(q),
    "rsqrt": lambda q: -jax.lax.rsqrt(q @ q),
}
STATE = jnp.array([0.3, -0.7]), jnp.array([0.2, 0.1])


def kinds(system, dtype=float):
    """Names of the operations of the accelerations."""
    lowered = system._program.lowered(jnp.zeros(system.size, dtype), None, {})
    lines = lowered.equations.program.body
    return [line.data.name if line.op == "call" else line.op for line in lines]


def of_potential(V):
    return jl.System(lambda t, q, v, params: 0.5 * (v @ v) - V(q), ("x", "y"))


@pytest.mark.parametrize("V", POTENTIALS.values(), ids=POTENTIALS)
def test_inverse_squares_take_one_division_and_one_root(V):
    system = of_potential(V)
    found = kinds(system)
    assert [found.count(kind) for kind in ("div", "sqrt", "pow")] == [1, 1, 0]
    a = system.acceleration(*STATE)
    np.testing.assert_allclose(a, -jax.grad(V)(STATE[0]), rtol=8 * EPS)


@pytest.mark.parametrize("size", [1e-12, 1e12])
def test_they_have_the_range_of_the_quotient(size):
    """In single precision r^4 is 1e48 at r = 1e12: it does not occur."""
    system = of_potential(lambda q: -1e8 / jnp.sqrt(q @ q))
    q = jnp.array([0.6 * size, 0.8 * size], jnp.float32)
    with jax.enable_x64(False):
        found = jax.jit(lambda q: system.acceleration(q, jnp.zeros(2, jnp.float32)))(q)
    expected = -1e8 * np.array([0.6, 0.8]) / size**2
    np.testing.assert_allclose(found, expected, rtol=16 * np.finfo(np.float32).eps)


@pytest.mark.parametrize("r", [0.0, 1e-200, 1e155, np.inf])
def test_squares_beyond_the_range_of_numbers(r):
    """1 / r^2 is 0 or infinite, as the quotient: a force that is switched off stays 0."""
    system = jl.System(
        lambda t, q, v, params: 0.5 * (v @ v),
        ("x", "y"),
        forces=(jl.GeneralizedForce(lambda t, q, v, p: 2 * v / (q @ q * jnp.sqrt(q @ q)), "f"),),
    )
    assert kinds(system).count("div") == 1
    q, v = jnp.array([r, 0.0]), jnp.array([2.0, 1.0])
    expected = np.full(2, np.inf if r < 1.0 else 0.0)
    np.testing.assert_array_equal(system.acceleration(q, v), expected)


def test_a_base_that_may_be_negative_is_divided_by():
    """1 / x exists where sqrt(x) does not."""

    def force(t, q, v, params):
        x = q[0]
        root = jnp.sqrt(jnp.where(x > 0.0, x, -x))
        return jnp.stack([1.0 / x + v[0] / root, 2.0 / x + v[1] / root])

    system = jl.System(
        lambda t, q, v, params: 0.5 * (v @ v),
        ("x", "y"),
        forces=(jl.GeneralizedForce(force, "f"),),
    )
    for x in (-4.0, 4.0):
        found = system.acceleration(jnp.array([x, 0.0]), jnp.array([1.0, 3.0]))
        np.testing.assert_allclose(found, [1 / x + 0.5, 2 / x + 1.5], rtol=4 * EPS)


def test_which_bases_are_sums_of_squares():
    graph = Graph()
    x, y = graph.input("q", 0), graph.input("q", 1)
    square = graph.power(x, 2)
    known = [graph.add(square, graph.power(y, 4)), graph.add(square, graph.const(2.0))]
    known += [graph.mul(graph.sqrt(x), square), graph.const(0.0)]
    assert all(map(_is_nonnegative, known))
    others = [
        x,
        graph.add(square, y),
        graph.add(square, graph.const(-1.0)),
        graph.scale(square, -1.0),
    ]
    assert not any(map(_is_nonnegative, [*others, graph.mul(square, y)]))


def test_a_reciprocal_of_a_root_alone_is_a_division():
    graph = Graph()
    x, y, z = (graph.input("q", i) for i in range(3))
    root = graph.sqrt(x)
    lines = assemble(graph, [graph.add(graph.div(y, root), z), graph.add(graph.div(z, root), y)])
    assert [line.op for line in lines.body].count("div") == 1
    assert [line.op for line in lines.body].count("mul") == 2
