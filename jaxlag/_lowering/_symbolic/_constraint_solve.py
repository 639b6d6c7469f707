"""Constraint rows on the graph, and the solve for accelerations with constraints."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxlag._linalg._kkt import TangentSpace, row_weights, tangent_space, units_of
from jaxlag._lowering._graph._eliminate import GREATER, bordered, solve_general
from jaxlag._lowering._graph._expression import Graph, Node
from jaxlag._lowering._graph._traversal import dependencies, substitute
from jaxlag._lowering._graph._vectors import dot, products
from jaxlag._lowering._jaxpr._differentiate import tangents
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported
from jaxlag._lowering._symbolic._read_function import read_function
from jaxlag._lowering._symbolic._shared_reactions import Sharing, shared


class Constrained(NamedTuple):
    """Residuals from the declaration, and options of their solve.

    Attributes:
        velocity: A v + b of all rows.
        position: phi of the holonomic rows, in their order.
        holonomic: for every row, whether it is one of them.
        active_rows: for every row 1, or 0 if it is left out; None if all are active.
        formulation: "multipliers" or "null_space".
        damping: Baumgarte's (2 alpha, beta^2), None without; alpha changes its sign with time.
        regular: whether M is known to be positive definite by itself.
        reaction: the forces that depend on multipliers; None without.
        lam: their multipliers.
        sharing: distribution of multipliers among dependent rows; None if forces do not need it.
        crossing: whether rows that become dependent are left out; otherwise results are NaN.
        cancelled: whether coefficients of the residuals may be rounding.
        labels: of all rows.
    """

    velocity: Sequence[Node]
    position: Sequence[Node]
    holonomic: Sequence[bool]
    active_rows: Sequence[Node] | None
    formulation: str
    damping: tuple[float, float] | None
    regular: bool
    reaction: Sequence[Node] | None = None
    lam: Sequence[Node] = ()
    sharing: Sharing | None = None
    crossing: bool = False
    cancelled: bool = False
    labels: Sequence[str] = ()


class SymbolicRows(NamedTuple):
    """A, and gamma with A a + gamma = 0."""

    A: list[list[Node]]
    gamma: list[Node]


def rows(
    graph: Graph, t: Node, q: Sequence[Node], v: Sequence[Node], c: Constrained
) -> SymbolicRows:
    """A from the residuals' slopes in v, gamma from their rate along the motion.

    Raises:
        Unsupported: a residual that is affine in v, but whose slopes contain v on the graph.
    """
    columns = [tangents(graph, c.velocity, {x: graph.one}) for x in v]
    A = [[column[k] for column in columns] for k in range(len(c.velocity))]
    reached = dependencies(x for row in A for x in row)
    if any(name == "v" for found in reached.values() for name, _ in found):
        raise Unsupported("constraint rows whose derivatives with respect to v contain v")
    gamma = tangents(graph, c.velocity, dict(zip(q, v, strict=True)) | {t: graph.one})
    if c.damping is not None:
        twice_alpha, beta_squared = c.damping
        positions, direction = iter(c.position), graph.input("time_direction", 0)
        for k, residual in enumerate(c.velocity):
            terms = [(gamma[k], 1.0), (graph.mul(direction, residual), twice_alpha)]
            if c.holonomic[k]:
                terms.append((next(positions), beta_squared))
            gamma[k] = graph.sum(terms)
    return SymbolicRows(A, gamma)


def solve_with_rows(
    graph: Graph,
    M: Sequence[Sequence[Node]],
    A: Sequence[Sequence[Node]],
    right: Sequence[tuple[Sequence[Node], Sequence[Node]]],
    eps: float,
    active_rows: Sequence[Node] | None,
    formulation: str,
    regular: bool,
    crossing: bool,
) -> list[list[Node]]:
    """For each right-hand side (r, c) the x with M x = r + A^T lam, A x + c = 0."""
    if formulation == "null_space":
        return _null_space(graph, M, A, right, eps, active_rows, crossing)
    if not regular or any(M[i][i] is graph.zero for i in range(len(M))):
        M, right = augmented(graph, M, A, right, eps, active_rows)
    found = bordered(graph, M, A, right, eps, active_rows, checked=True, crossing=crossing)
    return [x[: len(M)] for x in found]


class Reaction(NamedTuple):
    """Forces Q_0 + G lam that are affine in the multipliers; G by columns."""

    rest: list[Node]
    slopes: list[list[Node]]


def reaction(graph: Graph, c: Constrained) -> Reaction | None:
    """The forces that depend on multipliers, as an affine function.

    Raises:
        Unsupported: they are not affine.
    """
    if c.reaction is None:
        return None
    slopes = [tangents(graph, c.reaction, {x: graph.one}) for x in c.lam]
    reached = dependencies(x for column in slopes for x in column)
    if any(name == "lam" for found in reached.values() for name, _ in found):
        raise Unsupported("forces that are not affine in multipliers")
    return Reaction(substitute(graph, c.reaction, dict.fromkeys(c.lam, graph.zero)), slopes)


def solve_with_reactions(
    graph: Graph,
    M: Sequence[Sequence[Node]],
    rows: SymbolicRows,
    r: Sequence[Node],
    found: Reaction,
    eps: float,
    active_rows: Sequence[Node] | None,
    sharing: Sharing | None,
    regular: bool,
) -> tuple[list[Node], list[Node]]:
    """(a, lam) with M a = r + Q_0 + (A^T + G) lam, A a + gamma = 0.

    As `_kkt.solve_reactions`: S = A M^-1 (A^T + G) by LU factorization. S is not
    symmetric. If its determinant is not positive, friction has reversed its sense.
    """
    m = len(rows.A)
    A, gamma, G = rows.A, list(rows.gamma), found.slopes
    seen = None
    if active_rows is not None and sharing is not None:
        roots = [graph.let(graph.div(graph.one, graph.sqrt(M[i][i]))) for i in range(len(M))]
        units = roots if regular else read_function(graph, eps, units_of, M, A)
        seen = shared(graph, A, units, active_rows, sharing, eps)
    if seen is not None:
        of_rows = zip(*seen, strict=True)
        G = [[dot(graph, column, g) for g in zip(*G, strict=True)] for column in of_rows]
    if active_rows is not None:
        A = [[graph.mul(active_rows[k], x) for x in row] for k, row in enumerate(A)]
        G = [[graph.mul(active_rows[k], x) for x in column] for k, column in enumerate(G)]
        gamma = [graph.mul(active_rows[k], x) for k, x in enumerate(gamma)]
    sides = [([graph.add(*pair) for pair in zip(r, found.rest, strict=True)], gamma)]
    if not regular:
        M, sides = augmented(graph, M, A, sides, eps, None)
    columns = [
        [graph.add(a, g) for a, g in zip(row, column, strict=True)]
        for row, column in zip(A, G, strict=True)
    ]
    free, *spread = bordered(graph, M, [], [(sides[0][0], []), *((p, []) for p in columns)], eps)

    S = [[dot(graph, A[k], spread[j]) for j in range(m)] for k in range(m)]
    if active_rows is not None:
        for k in range(m):
            S[k][k] = graph.sum([(S[k][k], 1.0), (active_rows[k], -1.0)], 1.0)
    right = [
        graph.let(graph.sum([(gamma[k], -1.0), *_less(products(graph, A[k], free))]))
        for k in range(m)
    ]
    lam = solve_general(graph, S, right, eps ** (2 / 3))
    a = []
    for i, x in enumerate(free):
        terms = [(graph.mul(lam[k], spread[k][i]), 1.0) for k in range(m)]
        a.append(graph.let(graph.sum([(x, 1.0), *terms])))
    return a, lam if seen is None else [dot(graph, row, lam) for row in seen]


def _less(terms: list[tuple[Node, float]]) -> list[tuple[Node, float]]:
    return [(node, -c) for node, c in terms]


def augmented(
    graph: Graph,
    M: Sequence[Sequence[Node]],
    A: Sequence[Sequence[Node]],
    right: Sequence[tuple[Sequence[Node], Sequence[Node]]],
    eps: float,
    active_rows: Sequence[Node] | None,
) -> tuple[list[list[Node]], list[tuple[list[Node], Sequence[Node]]]]:
    """M + A^T W A and r - A^T W c, for an M that may be singular: x does not change.

    A are all rows: with some alone M may not be positive definite.
    """
    n, m = len(M), len(A)
    weights = read_function(graph, eps, row_weights, M, A)
    if active_rows is not None:
        # Selected, not multiplied: the weight of a row that is only rounding may overflow.
        half, zero = graph.const(0.5), graph.zero
        weights = [
            graph.select(graph.call(GREATER, active_rows[k], half), w, zero)
            for k, w in enumerate(weights)
        ]
    full: list[list[Node]] = [[graph.zero] * n for _ in range(n)]
    for i in range(n):
        for j in range(i, n):
            more = [(graph.mul(weights[k], A[k][i], A[k][j]), 1.0) for k in range(m)]
            full[i][j] = full[j][i] = graph.let(graph.sum([(M[i][j], 1.0), *more]))
    sides = []
    for r, c in right:
        moved = [
            graph.sum(
                [(r[i], 1.0), *((graph.mul(weights[k], A[k][i], c[k]), -1.0) for k in range(m))]
            )
            for i in range(n)
        ]
        sides.append((moved, c))
    return full, sides


def _null_space(
    graph: Graph,
    M: Sequence[Sequence[Node]],
    A: Sequence[Sequence[Node]],
    right: Sequence[tuple[Sequence[Node], Sequence[Node]]],
    eps: float,
    active_rows: Sequence[Node] | None,
    crossing: bool,
) -> list[list[Node]]:
    """As `_kkt.NullSpace`, whose programs are read; the elimination is that of the graph."""
    if active_rows is not None:
        A = [[graph.mul(active_rows[k], x) for x in row] for k, row in enumerate(A)]
        right = [
            (r, [graph.mul(k, x) for k, x in zip(active_rows, c, strict=True)]) for r, c in right
        ]
    read = partial(read_function, graph, eps)
    space = read(_tangent_space, M, A, active_rows, crossing=crossing)
    found = [read(TangentSpace.loads, space, *side) for side in right]
    inertia, sides = read(TangentSpace.inertia, space), [(load, ()) for _, load in found]
    symmetric = [[inertia[min(i, j)][max(i, j)] for j in range(len(M))] for i in range(len(M))]
    solved = bordered(graph, symmetric, [], sides, eps)
    return [
        read(TangentSpace.acceleration, space, y, across)
        for y, (across, _) in zip(solved, found, strict=True)
    ]


def _tangent_space(M: Array, A: Array, active_rows: Array | None, crossing: bool) -> TangentSpace:
    """With the active rows as numbers, 1 or 0; NaN if a row is dependent."""
    active_rows = None if active_rows is None else active_rows > 0.5
    return tangent_space(M, A, active_rows, crossing, jnp.nan)


def correction(
    graph: Graph,
    M: Sequence[Sequence[Node]],
    A: Sequence[Sequence[Node]],
    eps: float,
    active_rows: Sequence[Node] | None,
    crossing: bool,
    right: Sequence[Sequence[Node]],
) -> list[tuple[list[Node], list[Node]]]:
    """For each c the change M^-1 A^T mu of q or v, with mu = (A M^-1 A^T)^-1 c; mu with `crossing`.

    M must be positive definite: if it may be singular, it is `augmented`.
    """
    nothing = [graph.zero] * len(M)
    sides = [(nothing, c) for c in right]
    found = bordered(graph, M, A, sides, eps, active_rows, crossing=crossing)
    n = len(M)
    return [([graph.scale(x, -1.0) for x in side[:n]], side[n:]) for side in found]
