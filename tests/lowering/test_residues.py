"""Identity testing modulo a prime: what is equal, what is not, and what is not recognized."""

import numpy as np
import pytest

from jaxlag._lowering._graph._expression import COS, SIN, Graph, named
from jaxlag._lowering._graph._residues import PRIME, Residues, fraction

PARTS = 5


@pytest.fixture
def graph():
    return Graph()


def inputs(graph, count=PARTS):
    return [graph.input("q", i) for i in range(count)]


def expanded(graph, factors):
    """The product of sums of inputs, multiplied out."""
    terms = [[]]
    for factor in factors:
        terms = [[*term, x] for term in terms for x in factor]
    return graph.sum([(graph.mul(*term), 1.0) for term in terms])


def same(graph, a, b):
    residues = Residues()
    assert residues([a]) != [(0, 0)]
    return residues([a]) == residues([b]) and residues.vanish([graph.sub(a, b)])


def test_products_equal_their_expansions(graph):
    a, b, c, d, e = inputs(graph)
    factors = [[a, b], [b, c, d], [d, e], [a, c]]
    product = graph.mul(*(graph.add(*factor) for factor in factors))
    assert same(graph, product, expanded(graph, factors))
    assert not same(graph, product, expanded(graph, [*factors[:3], [a, d]]))


@pytest.mark.parametrize("small", [2.0**-60, 1e-300, 5e-324])
def test_a_smallest_difference_counts(graph, small):
    a, b, *_ = inputs(graph)
    square = graph.power(graph.add(a, b), 2)
    longer = graph.sum([(expanded(graph, [[a, b], [a, b]]), 1.0), (a, small)])
    assert not same(graph, square, longer)


def test_quotients(graph):
    a, b, c, *_ = inputs(graph)
    sum_ = graph.add(graph.div(a, b), graph.div(b, c))
    whole = graph.div(graph.add(graph.mul(a, c), graph.power(b, 2)), graph.mul(b, c))
    assert same(graph, sum_, whole)


def test_sines_and_cosines_lie_on_the_circle(graph):
    a, b, c, *_ = inputs(graph)
    x = graph.sum([(a, 1.0), (b, -3.0)])
    mirrored = graph.sum([(b, 3.0), (a, -1.0)])
    s, k = graph.call(SIN, x), graph.call(COS, x)
    s_m = graph._node("call", SIN, (mirrored,))  # not put into its normal form
    assert same(graph, graph.add(graph.power(s, 2), graph.power(k, 2)), graph.one)
    assert same(graph, s_m, graph.scale(s, -1.0))
    assert same(graph, graph._node("call", COS, (mirrored,)), k)
    other = graph.call(COS, c)
    assert not same(graph, graph.add(graph.power(s, 2), graph.power(other, 2)), graph.one)
    assert not same(graph, s, k)


def test_functions_of_equal_arguments_are_equal(graph):
    a, b, *_ = inputs(graph)
    square, sum_ = graph.power(graph.add(a, b), 2), expanded(graph, [[a, b], [a, b]])
    for name in ("exp", "tanh", "log"):
        function = named(name, accuracy=None)
        assert same(graph, graph.call(function, square), graph.call(function, sum_))
        assert not same(graph, graph.call(function, square), graph.call(function, a))
    exp, tanh = (named(name, accuracy=None) for name in ("exp", "tanh"))
    assert not same(graph, graph.call(exp, a), graph.call(tanh, a))


def test_roots_of_squares_are_no_numbers_with_a_sign(graph):
    """sqrt(x^2) is |x|: neither x nor -x."""
    a, b, *_ = inputs(graph)
    for k in range(32):
        x = graph.sum([(a, 1.0), (b, float(k))])
        root = graph.sqrt(expanded(graph, [[x], [x]]))
        assert not same(graph, root, x)
        assert not same(graph, root, graph.scale(x, -1.0))
        assert same(graph, root, graph.sqrt(graph.power(x, 2)))


def test_choices_are_equal_if_their_parts_are(graph):
    a, b, c, *_ = inputs(graph)
    truth, other = graph.call(named("gt"), a, b), graph.call(named("gt"), a, c)
    square, sum_ = graph.power(graph.add(a, b), 2), expanded(graph, [[a, b], [a, b]])
    assert not same(graph, graph.select(truth, square, sum_), square)
    assert same(graph, graph.select(truth, square, c), graph.select(truth, sum_, c))
    assert not same(graph, graph.select(truth, square, c), graph.select(other, square, c))
    assert not same(graph, graph.select(truth, a, c), graph.select(truth, c, a))


def test_stopped_values_differ_from_the_values(graph):
    a, b, *_ = inputs(graph)
    assert not same(graph, graph.stop(a), a)
    assert same(graph, graph.stop(graph.add(a, b)), graph.stop(graph.add(b, a)))


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_no_number_is_no_zero(graph, number):
    a, *_ = inputs(graph)
    assert not Residues().vanish([graph.mul(graph.const(number), a)])
    assert not Residues().vanish([graph.const(number)])


def test_a_division_by_zero_is_unknown(graph):
    """1 / (sin^2 + cos^2 - 1) is not reduced to a number."""
    a, *_ = inputs(graph)
    s, k = graph.call(SIN, a), graph.call(COS, a)
    nothing = graph.sum([(graph.power(s, 2), 1.0), (graph.power(k, 2), 1.0)], -1.0)
    assert Residues().vanish([nothing])
    assert not Residues().vanish([graph.power(nothing, -1)])


def test_residues_are_the_same_in_every_process(graph):
    a, b, *_ = inputs(graph)
    assert Residues()([a, b]) == Residues()([a, b])
    assert Residues()([graph.add(a, graph.one)])[0][0] == (Residues()([a])[0][0] + 1) % PRIME


@pytest.mark.parametrize("number", [1.0, -1.0, 0.5, -2.0, 3.0, 7 / 4, -63 / 64])
def test_small_fractions_are_found(graph, number):
    assert fraction(Residues()([graph.const(number)])[0]) == number


def test_other_numbers_are_no_small_fractions(graph):
    a, *_ = inputs(graph)
    assert fraction(Residues()([a])[0]) is None
    assert fraction(Residues()([graph.const(np.pi)])[0]) is None


def test_powers_of_two_differ(graph):
    """2^61 is 1 modulo 2^61 - 1, the usual prime of this size."""
    a, *_ = inputs(graph)
    powers = [graph.scale(a, 2.0**k) for k in range(-1074, 1024)]
    assert len(set(Residues()(powers))) == len(powers)
