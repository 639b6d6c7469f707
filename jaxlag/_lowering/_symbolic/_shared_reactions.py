"""Multipliers of dependent rows that forces read: their distribution among the rows."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxlag._linalg._kkt import orthonormal_rows
from jaxlag._linalg._row_residuals import ROUNDINGS
from jaxlag._lowering._graph._eliminate import GREATER, bordered
from jaxlag._lowering._graph._expression import Graph, Node
from jaxlag._lowering._graph._vectors import backward, dot, without
from jaxlag._lowering._symbolic._read_function import read_function


class Sharing(NamedTuple):
    """Rows whose multipliers have least norm within their group if they are dependent.

    Attributes:
        chosen: indices of these rows.
        nonzero: for every row 1, or 0 if it is only rounding.
    """

    chosen: Sequence[int]
    nonzero: Sequence[Node]


def _orthonormal_rows(A: Array, active_rows: Array) -> Any:
    """With the active rows as numbers, 1 or 0."""
    active = active_rows > 0.5
    return orthonormal_rows(jnp.where(active[:, None], A, 0.0), active, 0.0, jnp.nan)[:2]


def shared(
    graph: Graph,
    A: Sequence[Sequence[Node]],
    units: Sequence[Node],
    active_rows: Sequence[Node],
    sharing: Sharing,
    eps: float,
) -> list[list[Node]]:
    """The matrix from multipliers of the active rows to those that forces read, m rows.

    As `_independent_rows.shared`, with the same a_k, C, z and weights.
    """
    m, chosen = len(A), sharing.chosen
    zero, one, places = graph.zero, graph.one, range(len(chosen))
    A = [[graph.mul(sharing.nonzero[k], x) for x in A[k]] for k in chosen]
    scaled = [[graph.mul(x, s) for x, s in zip(row, units, strict=True)] for row in A]

    def length(x: Sequence[Node]) -> Node:
        """Length of a vector; 1 if it is 0."""
        square = graph.let(dot(graph, x, x))
        some = graph.let(graph.select(graph.call(GREATER, square, zero), square, one))
        return graph.let(graph.sqrt(some))

    norms, sizes = [length(row) for row in A], [length(row) for row in scaled]
    weights = [graph.let(graph.div(*pair)) for pair in zip(norms, sizes, strict=True)]
    unit = [
        [graph.let(graph.div(x, size)) for x in row]
        for row, size in zip(scaled, sizes, strict=True)
    ]
    flags = [active_rows[k] for k in chosen]
    L, Y = read_function(graph, eps, _orthonormal_rows, unit, flags)
    C, others, rounding = [], [], graph.const((ROUNDINGS * eps) ** 2)
    for row, flag in zip(unit, flags, strict=True):
        parts = [dot(graph, y, row) for y in Y]
        rest = without(graph, row, list(zip(parts, Y, strict=True)))
        near = graph.call(GREATER, graph.const(eps), dot(graph, rest, rest))
        follows = graph.let(graph.select(near, graph.sum([(flag, -1.0)], 1.0), zero))
        others.append(follows)
        # Coefficients that are rounding could be large for a row of smaller weight.
        found = [(x, graph.let(graph.power(x, 2))) for x in backward(graph, L, parts)]
        found = [graph.select(graph.call(GREATER, s, rounding), x, zero) for x, s in found]
        C.append([graph.let(graph.mul(follows, x)) for x in found])
    moved = [
        [
            graph.mul(weights[k], graph.sum([(others[j], -1.0)]) if j == k else C[j][k])
            for k in places
        ]
        for j in places
    ]
    # In units in which the diagonal is 1: weights may differ as much as forces and short levers.
    lengths = [length(x) for x in moved]
    moved = [[graph.let(graph.div(x, s)) for x in y] for y, s in zip(moved, lengths, strict=True)]
    square = [[dot(graph, x, y) for y in moved] for x in moved]
    for j in places:
        square[j][j] = graph.sum([(square[j][j], 1.0), (others[j], -1.0)], 1.0)
    sides = [[graph.mul(weights[k], flags[k], x[k]) for x in moved] for k in places]
    columns = bordered(graph, square, [], [(side, []) for side in sides], eps)
    seen = [[one if i == j else zero for j in range(m)] for i in range(m)]
    for j, found in enumerate(columns):
        z = [graph.let(graph.div(x, s)) for x, s in zip(found, lengths, strict=True)]
        shares = []
        for i in places:
            taken = [(graph.mul(C[k][i], z[k]), -1.0) for k in places]
            diagonal = [(flags[i], 1.0)] if i == j else []
            shares.append(
                graph.let(graph.sum([*diagonal, (graph.mul(others[i], z[i]), 1.0), *taken]))
            )
        # The total generalized force does not change.
        exerted = [graph.mul(flags[j], x) for x in unit[j]]
        left = without(graph, exerted, list(zip(shares, unit, strict=True)))
        more = backward(graph, L, [dot(graph, y, left) for y in Y])
        for i in places:
            share = graph.let(graph.add(shares[i], graph.mul(flags[i], more[i])))
            seen[chosen[i]][chosen[j]] = graph.let(graph.div(graph.mul(share, sizes[j]), sizes[i]))
    return seen
