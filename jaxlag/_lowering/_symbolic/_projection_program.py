"""Straight-line code of a projection onto constraints."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxlag._lowering._graph._expression import Graph, Node
from jaxlag._lowering._graph._partition import partitioned
from jaxlag._lowering._graph._straight_line import Program, assemble
from jaxlag._lowering._symbolic._constraint_solve import Constrained, augmented, correction

# Columns with more lines than this, counted without shared expressions, are solved for at run time.
# Chains of point masses, columns | factors: 14 masses (3,416 lines) first result 9.7 | 7.1 s, run
# 2.3 | 3.0 ms; 20 masses (7,040 lines) 30 | 11 s, 1.5 | 1.6 ms.
LINES = 4000
FEW = 5  # rows whose columns are always lines


class ProjectionCode(NamedTuple):
    """Straight-line code for a projection: residuals, and matrices of their corrections.

    Attributes:
        position: phi of the holonomic rows.
        velocity: A v + b.
        correction: columns from phi to a change of q, unless they are some of the next ones; then
            columns from A v + b to a change of v; then the diagonal of (A M^-1 A^T)^-1 if
            requested. With `solves` the factors instead.
        lam: multipliers; None if no force depends on them.
        solves: for the same corrections in the same order (change, then (A M^-1 A^T)^-1 c if the
            diagonal is requested) as functions of the factors and of c; None if `correction` has
            the columns.
    """

    position: Program
    velocity: Program
    correction: Program
    lam: Program | None
    solves: tuple[Program, ...] | None = None


def surface(
    graph: Graph,
    M: Sequence[Sequence[Node]],
    A: Sequence[Sequence[Node]],
    bound: Constrained,
    eps: float,
    lam: Program | None,
) -> ProjectionCode:
    """Code for the residuals and their corrections."""
    if not bound.regular:
        M, _ = augmented(graph, M, A, [], eps, bound.active_rows)
    holonomic_rows = [k for k, holonomic in enumerate(bound.holonomic) if holonomic]
    every = list(range(len(A)))
    groups = [every]
    if 0 < len(holonomic_rows) < len(A):
        groups = [holonomic_rows, every]

    def corrected(
        chosen: Sequence[int], right: Sequence[Sequence[Node]]
    ) -> list[tuple[list[Node], list[Node]]]:
        rows, active = [A[k] for k in chosen], bound.active_rows
        active = None if active is None else [active[k] for k in chosen]
        return correction(graph, M, rows, eps, active, bound.crossing, right)

    residuals = assemble(graph, list(bound.position)), assemble(graph, list(bound.velocity))
    if len(A) > FEW:
        values: list[Node] = []
        solves = []
        for chosen in groups:
            c = [graph.input("c", k) for k in range(len(chosen))]
            ((change, mu),) = corrected(chosen, [c])
            solves.append(partitioned(graph, [*change, *mu], c, values))
        programs = tuple(assemble(graph, roots) for roots in solves)
        lines = sum(len(p.body) * len(chosen) for p, chosen in zip(programs, groups, strict=True))
        if lines > LINES:
            return ProjectionCode(*residuals, assemble(graph, values), lam, programs)

    found: list[Node] = []
    for chosen in groups:
        unit = [[graph.one if j == k else graph.zero for j in chosen] for k in chosen]
        columns = corrected(chosen, unit)
        found += [x for change, _ in columns for x in change]
        if chosen is every:
            found += [mu[k] for k, (_, mu) in enumerate(columns) if mu]
    return ProjectionCode(*residuals, assemble(graph, found), lam)
