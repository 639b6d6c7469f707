"""Global value numbering: one node for equal expressions, the one of fewest operations."""

import numpy as np
import pytest

from jaxlag._lowering._graph._expression import COS, SIN, Graph, named, order
from jaxlag._lowering._graph._residues import Residues
from jaxlag._lowering._graph._straight_line import assemble
from jaxlag._lowering._jaxpr._differentiate import tangents
from jaxlag._lowering._symbolic._evaluate import evaluate
from jaxlag._lowering._symbolic._value_numbering import merged


@pytest.fixture
def graph():
    return Graph()


def random_values(roots, seed=0):
    rng = np.random.default_rng(seed)
    return {node.data: rng.uniform(0.5, 1.5) for node in order(roots) if node.op == "input"}


def rotation(graph, angles):
    """The entries of a product of rotations about z, x, z."""
    R = [[graph.one if i == j else graph.zero for j in range(3)] for i in range(3)]
    for k, angle in enumerate(angles):
        s, c = graph.call(SIN, angle), graph.call(COS, angle)
        a, b = (0, 1) if k % 2 == 0 else (1, 2)
        one = [[graph.one if i == j else graph.zero for j in range(3)] for i in range(3)]
        one[a][a] = one[b][b] = c
        one[a][b], one[b][a] = graph.scale(s, -1.0), s
        R = times(graph, R, one)
    return R


def times(graph, A, B):
    columns = list(zip(*B, strict=True))
    return [
        [
            graph.add(*(graph.mul(x, y) for x, y in zip(row, column, strict=True)))
            for column in columns
        ]
        for row in A
    ]


def test_body_rates_are_computed_once(graph):
    """R^T dR/dt has three different entries of nine, and R^T R none."""
    angles, rates = ([graph.input(name, i) for i in range(3)] for name in ("q", "v"))
    R = rotation(graph, angles)
    flat = [x for row in R for x in row]
    moved = tangents(graph, flat, dict(zip(angles, rates, strict=True)))
    back = list(zip(*R, strict=True))
    W = times(graph, back, [moved[3 * i : 3 * i + 3] for i in range(3)])
    W = [x for row in W for x in row]
    found = merged(graph, W, Residues())
    for i in range(3):
        assert found[4 * i] is graph.zero
        for j in range(i):
            assert found[3 * i + j] is graph.scale(found[3 * j + i], -1.0)
    values = random_values(W)
    assert np.allclose(evaluate(found, values), evaluate(W, values), rtol=0, atol=1e-15)
    assert assemble(graph, found).operations < 0.6 * assemble(graph, W).operations


def test_the_shorter_of_two_is_kept_in_any_order(graph):
    a, b, c = (graph.input("q", i) for i in range(3))
    long = graph.add(graph.mul(a, c), graph.mul(b, c), graph.mul(a, b))
    short = graph.add(graph.mul(graph.add(a, b), c), graph.mul(a, b))
    for roots in ([long, short], [short, long]):
        assert merged(graph, roots, Residues()) == [short, short]


def test_expressions_of_params_are_preferred(graph):
    """(p + q)(p - q) + q^2 is p^2, however many operations p^2 takes once."""
    p, q = graph.input("params", 0), graph.input("q", 0)
    moving = graph.add(graph.mul(graph.add(p, q), graph.sub(p, q)), graph.power(q, 2))
    fixed = graph.power(p, 2)
    assert merged(graph, [moving, fixed], Residues()) == [fixed, fixed]


def test_the_negative_is_the_negative(graph):
    a, b = (graph.input("q", i) for i in range(2))
    square = graph.power(graph.sub(a, b), 2)
    long = graph.sum([(graph.power(a, 2), -1.0), (graph.mul(a, b), 2.0), (graph.power(b, 2), -1.0)])
    assert merged(graph, [square, long], Residues()) == [square, graph.scale(square, -1.0)]


def test_a_let_stays_closed(graph):
    a, b, c = (graph.input("q", i) for i in range(3))
    kept = graph.let(graph.add(a, b))
    root = graph.add(kept, c, a)
    (found,) = merged(graph, [root], Residues())
    assert found is root


def test_different_expressions_stay(graph):
    a, b = (graph.input("q", i) for i in range(2))
    roots = [graph.add(a, b), graph.sub(a, b), graph.mul(a, b), graph.call(SIN, a), graph.stop(a)]
    assert merged(graph, roots, Residues()) == roots


# ---- What is not replaced ------------------------------------------------------------------------


def quotients(graph):
    """(1 - cos x) / sin x and sin x / (1 + cos x), the cheaper one first."""
    x = graph.input("q", 0)
    s, c = graph.call(SIN, x), graph.call(COS, x)
    far = graph.div(graph.sum([(c, -1.0)], 1.0), s)
    near = graph.div(s, graph.sum([(c, 1.0)], 1.0))
    return far, near


def test_a_guarded_quotient_keeps_its_value(graph):
    """Both are equal, but at 0 only one of them has a value, and near 0 only one has digits."""
    far, near = quotients(graph)
    assert Residues()([far]) == Residues()([near])
    for roots in ([far, near], [near, far]):
        assert merged(graph, roots, Residues()) == roots
    truth = graph.call(named("gt"), graph.input("q", 0), graph.zero)
    root = graph.select(truth, near, far)
    assert merged(graph, [root], Residues()) == [root]


def test_a_polynomial_is_not_replaced_by_a_quotient(graph):
    """(x^6 - 1) / (x - 1) has no value at 1."""
    x = graph.input("q", 0)
    power = graph.div(graph.sum([(graph.power(x, 6), 1.0)], -1.0), graph.sum([(x, 1.0)], -1.0))
    sum_ = graph.sum([(graph.power(x, k), 1.0) for k in range(1, 6)], 1.0)
    assert Residues()([power]) == Residues()([sum_])
    assert merged(graph, [sum_], Residues()) == [sum_]
    assert merged(graph, [power, sum_], Residues())[1] is sum_


@pytest.mark.parametrize("kind", ["q", "params"])
def test_a_product_of_differences_keeps_its_digits(graph, kind):
    a, b = (graph.input(kind, i) for i in range(2))
    product = graph.mul(graph.sub(a, b), graph.add(a, b))
    squares = graph.sub(graph.power(a, 2), graph.power(b, 2))
    assert merged(graph, [squares, product], Residues())[1] is product


def test_a_square_of_a_sine_keeps_its_digits(graph):
    x = graph.input("q", 0)
    square = graph.power(graph.call(SIN, x), 2)
    rest = graph.sum([(graph.power(graph.call(COS, x), 2), -1.0)], 1.0)
    assert merged(graph, [rest, square], Residues()) == [square, square]


def test_roots_of_squares_stay(graph):
    x = graph.input("q", 0)
    root = graph.sqrt(graph.add(graph.power(x, 2), graph.zero))
    assert merged(graph, [x, root], Residues()) == [x, root]


@pytest.mark.parametrize("depth", [5, 200])
def test_time_is_linear_in_the_depth_of_shared_nodes(graph, depth):
    """x -> x^2 + x has 2^depth operations without sharing."""
    x = graph.input("q", 0)
    for _ in range(depth):
        x = graph.add(graph.mul(x, graph.input("q", 1)), x)
    assert merged(graph, [x], Residues()) == [x]
