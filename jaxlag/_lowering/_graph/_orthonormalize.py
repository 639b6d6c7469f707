"""Orthonormalization of vectors of nodes, with their inner products."""

from collections.abc import Sequence

import numpy as np

from jaxlag._lowering._graph._eliminate import GREATER, NO_LESS
from jaxlag._lowering._graph._expression import Graph, Node


def products(graph: Graph, x: Sequence[Node], y: Sequence[Node]) -> list[tuple[Node, float]]:
    """The products of the entries of two vectors, as terms of a sum."""
    return [(graph.mul(a, b), 1.0) for a, b in zip(x, y, strict=True)]


def dot(graph: Graph, x: Sequence[Node], y: Sequence[Node]) -> Node:
    """The inner product of two vectors, computed once."""
    return graph.let(graph.sum(products(graph, x, y)))


def orthonormal(
    graph: Graph,
    rows: Sequence[Sequence[Node]],
    kept: Sequence[Node] | None,
    floor: float = 0.0,
    crossing: bool = False,
) -> tuple[list[list[Node]], list[list[Node]]]:
    """(L, Y) with rows = L Y by Gram-Schmidt orthonormalization, each row twice.

    Rows that are not kept have 0 in Y and 1 in L. If a remaining square is at most `floor` times
    the original, the result is NaN, or with `crossing` 0 in Y and infinity in L.
    """
    Y: list[list[Node]] = []
    L: list[list[Node]] = []
    for k, row in enumerate(rows):
        if kept is not None:
            row = [graph.mul(kept[k], x) for x in row]
        first = [dot(graph, y, row) for y in Y]
        rest = without(graph, row, list(zip(first, Y, strict=True)))
        second = [dot(graph, y, rest) for y in Y]
        rest = without(graph, rest, list(zip(second, Y, strict=True)))
        square = dot(graph, rest, rest)
        bound = graph.scale(dot(graph, row, row), floor) if floor else graph.zero
        if crossing:
            dependent = graph.call(NO_LESS, bound, square)
            square = graph.select(dependent, graph.const(np.inf), square)
        else:
            square = graph.select(graph.call(GREATER, square, bound), square, graph.const(np.nan))
        if kept is not None:
            keep = graph.call(GREATER, kept[k], graph.const(0.5))
            square = graph.select(keep, square, graph.one)
        norm = graph.let(graph.sqrt(graph.let(square)))
        Y.append([x if x is graph.zero else graph.let(graph.div(x, norm)) for x in rest])
        L.append([graph.add(a, b) for a, b in zip(first, second, strict=True)] + [norm])
    return L, Y


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
