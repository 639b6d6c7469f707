"""Vectors of nodes: inner products, projections and back substitution."""

from collections.abc import Sequence

from jaxlag._lowering._graph._expression import Graph, Node


def products(graph: Graph, x: Sequence[Node], y: Sequence[Node]) -> list[tuple[Node, float]]:
    """The products of the entries of two vectors, as terms of a sum."""
    return [(graph.mul(a, b), 1.0) for a, b in zip(x, y, strict=True)]


def dot(graph: Graph, x: Sequence[Node], y: Sequence[Node]) -> Node:
    """The inner product of two vectors, computed once."""
    return graph.let(graph.sum(products(graph, x, y)))


def without(
    graph: Graph, x: Sequence[Node], parts: Sequence[tuple[Node, Sequence[Node]]]
) -> list[Node]:
    """x minus the sum of factors times vectors."""
    return [
        graph.let(graph.sum([(a, 1.0), *((graph.mul(f, y[i]), -1.0) for f, y in parts)]))
        for i, a in enumerate(x)
    ]


def backward(graph: Graph, L: Sequence[Sequence[Node]], right: Sequence[Node]) -> list[Node]:
    """The x with L^T x = right."""
    m = len(right)
    x: list[Node] = [graph.zero] * m
    for k in reversed(range(m)):
        known = [(graph.mul(L[j][k], x[j]), -1.0) for j in range(k + 1, m)]
        x[k] = graph.let(graph.div(graph.sum([(right[k], 1.0), *known]), L[k][k]))
    return x
