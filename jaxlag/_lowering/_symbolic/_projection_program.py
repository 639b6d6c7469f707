"""Straight-line code of a projection onto constraints."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxlag._lowering._graph._expression import Graph, Node
from jaxlag._lowering._graph._straight_line import Program, assemble
from jaxlag._lowering._symbolic._constraint_solve import Constrained, correction


class ProjectionCode(NamedTuple):
    """Straight-line code for a projection: residuals, and matrices of their corrections.

    Attributes:
        position: phi of the holonomic rows.
        velocity: A v + b.
        correction: columns from phi to a change of q, unless they are some of the next ones; then
            columns from A v + b to a change of v; then the diagonal of (A M^-1 A^T)^-1 if
            requested.
        lam: multipliers; None if no force depends on them.
    """

    position: Program
    velocity: Program
    correction: Program
    lam: Program | None


def surface(
    graph: Graph,
    M: Sequence[Sequence[Node]],
    A: Sequence[Sequence[Node]],
    bound: Constrained,
    eps: float,
    lam: Program | None,
) -> ProjectionCode:
    """Code for the residuals and their corrections."""
    holonomic_rows = [k for k, holonomic in enumerate(bound.holonomic) if holonomic]
    every = list(range(len(A)))

    def columns(chosen: Sequence[int]) -> tuple[list[Node], list[Node]]:
        how = bound.active_rows, bound.regular, chosen, bound.crossing
        found, masses = correction(graph, M, A, eps, *how)
        return [x for column in found for x in column], masses

    of_position = columns(holonomic_rows)[0] if 0 < len(holonomic_rows) < len(A) else []
    of_velocity, masses = columns(every)
    return ProjectionCode(
        assemble(graph, list(bound.position)),
        assemble(graph, list(bound.velocity)),
        assemble(graph, [*of_position, *of_velocity, *masses]),
        lam,
    )
