"""Numbers of a declaration as inputs while equations are derived."""

import numpy as np
import pytest

from jaxlag._lowering._graph._expression import Graph
from jaxlag._lowering._graph._literals import NAME, Literals
from jaxlag._lowering._graph._residues import Residues
from jaxlag._lowering._graph._traversal import dependencies


@pytest.fixture
def graph():
    return Graph()


def test_numbers_come_back_to_the_bit(graph):
    x, y = (graph.input("q", i) for i in range(2))
    root = graph.sum([(graph.power(x, 2), 0.1), (graph.mul(x, y), -0.3), (y, 2.0)], 1 / 3)
    literals = Literals(graph)
    (without,) = literals.without([root])
    names = {name for name, _ in dependencies([without])[without]}
    assert names == {"q", NAME}
    assert literals.restored([without]) == [root]


@pytest.mark.parametrize("number", [1.0, -2.0, 0.5, 0.375, 1e3, 2.0**-40, -4095.0 * 2.0**90])
def test_short_numbers_stay(graph, number):
    root = graph.sum([(graph.input("q", 0), number)], 3.0)
    assert Literals(graph).without([root]) == [root]


@pytest.mark.parametrize("number", [np.inf, -np.inf])
def test_no_numbers_stay(graph, number):
    root = graph.sum([(graph.input("q", 0), number)])
    assert Literals(graph).without([root]) == [root]


def test_a_number_and_its_negative_are_one_input(graph):
    """0.1 x - 0.1 y - 0.1 (x - y) is zero as an expression, whatever the rounding of 0.1."""
    x, y = (graph.input("q", i) for i in range(2))
    parts = [graph.scale(x, 0.1), graph.scale(y, -0.1), graph.scale(graph.sub(x, y), -0.1)]
    found = Literals(graph).without(parts)
    assert Residues().vanish([graph.add(*found)])


def test_products_of_numbers_are_exact(graph):
    """0.1 (0.2 x) (0.3 y) in two orders: rounded numbers differ, inputs do not."""
    x, y = (graph.input("q", i) for i in range(2))

    def two(a, b, c):
        one = graph.mul(graph.mul(a, graph.mul(b, x)), graph.mul(c, y))
        other = graph.mul(graph.mul(graph.mul(c, graph.mul(a, y)), b), x)
        return Residues()([one]) == Residues()([other])

    assert 0.1 * 0.2 * 0.3 != 0.3 * 0.1 * 0.2
    assert not two(*map(graph.const, (0.1, 0.2, 0.3)))
    assert two(*(graph.input(NAME, i) for i in range(3)))
