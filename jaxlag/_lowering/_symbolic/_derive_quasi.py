"""Equations of motion in quasi-velocities on the graph: one of several forms."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxlag._lowering._graph._eliminate import solve
from jaxlag._lowering._graph._expression import Graph, Node, order
from jaxlag._lowering._graph._literals import Literals
from jaxlag._lowering._graph._residues import Residues
from jaxlag._lowering._graph._simplify import Expansion
from jaxlag._lowering._graph._straight_line import assemble
from jaxlag._lowering._graph._traversal import substitute
from jaxlag._lowering._graph._vectors import products
from jaxlag._lowering._jaxpr._differentiate import gradient, tangents
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported
from jaxlag._lowering._symbolic._bias_forms import attempt, cost, mass_matrix
from jaxlag._lowering._symbolic._cofactor_inverse import Inverse
from jaxlag._lowering._symbolic._constraint_solve import rows
from jaxlag._lowering._symbolic._partial_velocities import principle_of_dalembert
from jaxlag._lowering._symbolic._projection_program import surface
from jaxlag._lowering._symbolic._symbolic_system import Equations, Kinematics, SymbolicSystem
from jaxlag._lowering._symbolic._value_numbering import merged

WRITTEN_OUT = 3  # forms of the right side that are compared, shortest first
LONGER = 2  # an L of u with so many times the nodes of L is not used,
LONG = 500  # if it has so many nodes


class _Moved(NamedTuple):
    """v = V(t, q, u) and its derivatives.

    Attributes:
        V: v from all quasi-velocities.
        v: the same with the bound ones zero.
        B: columns dv/du of the free ones.
        s: dv/dt at u' = 0, the bound ones zero.
        healthy: truth values, all true if u determines v.
        determinants: of blocks of dU/dv or dV/du, which are 0 or infinite at singular
            quasi-velocities. None if they are too long.
    """

    V: list[Node]
    v: list[Node]
    B: list[list[Node]]
    s: list[Node]
    healthy: list[Node]
    determinants: list[Node] | None


def derive_rates(scene: SymbolicSystem, eps: float) -> Equations:
    """v and u' of the free quasi-velocities, the bound ones zero, by the cheapest of several forms.

    If L is a function of v, these are the projected equations, B^T M B u' = B^T (Q - h - M s) for
    v = B u + c and s = v' at u' = 0, where M s + h is one derivative, or M and h are those of
    d'Alembert's principle. Others are the Boltzmann-Hamel equations.

    Raises:
        Unsupported: the kinematics have no short inverse on scalars.
    """
    graph, expansion = scene.graph, Expansion(scene.graph)
    assert scene.kinematics is not None
    kinematics = scene.kinematics
    moved = _moved(scene, kinematics, expansion, eps)
    declared, of_u, U, residues = scene.lagrangian, None, None, Residues()
    forms: list[tuple[str, list[list[Node]], list[Node]]] = []
    if kinematics.in_u:
        of_u = declared
    else:
        for label, L in _written(expansion, declared):
            M, left = _lagrange(scene, moved, L)
            forms.append((f"projected, {label}", *_projected(scene, moved, M, left)))
        terms = _by_dalembert(scene, residues)
        if terms is not None:
            M, h = terms
            left = [graph.add(x, _dot(graph, row, moved.s)) for x, row in zip(h, M, strict=True)]
            label = "projected, d'Alembert's principle"
            forms.append((label, *_projected(scene, moved, M, left)))
        if len(kinematics.u) == len(scene.v):
            # With fewer u, momenta of the omitted ones would be lost.
            (of_u,) = substitute(graph, [declared], dict(zip(scene.v, moved.V, strict=True)))
            size = _size([of_u])
            of_u = None if size > max(LONG, LONGER * _size([declared])) else of_u
    if of_u is not None:
        U = _quasi(scene, kinematics, expansion)
        for label, L in _written(expansion, of_u):
            forms.append((f"Boltzmann-Hamel, {label}", *_hamel(scene, kinematics, moved, U, L)))

    masses = [mass for _, mass, _ in forms]
    masses += [short for mass in masses if (short := _short(expansion, mass)) is not None]
    mass = min(masses, key=lambda M: cost(graph, M))
    v, sides = _guarded(graph, moved.v, moved.healthy), []
    for label, _, right in forms:
        sides.append((label, right))
        short = attempt(partial(expansion.simplified, right))
        if short is not None:
            sides.append((f"{label}, expanded", short))
    # Long forms are not compared: generating their code takes too much time.
    sides.sort(key=lambda side: _size(side[1]))
    found = []
    for label, right in sides[:WRITTEN_OUT]:
        numbered = iter(merged(graph, [*(x for row in mass for x in row), *right, *v], residues))
        M = [[next(numbered) for _ in row] for row in mass]
        right = [next(numbered) for _ in right]
        rates = [*numbered, *solve(graph, M, right, eps)]
        rest = [graph.scale(x, -1.0) for x in right]
        found.append(Equations(declared, M, rest, rates, assemble(graph, rates), label))
    best = min(found, key=lambda equations: equations.program.cost)
    best = best._replace(velocity=assemble(graph, v))
    if moved.determinants is not None:
        moving = [x for x in moved.determinants if not x.fixed]
        best = best._replace(determinants=assemble(graph, moving))
    bound = scene.constrained
    if bound is None:
        return best
    of_v = declared
    if kinematics.in_u:
        assert U is not None
        (of_v,) = substitute(graph, [declared], dict(zip(kinematics.u, U, strict=True)))
    flat = [x for row in mass_matrix(graph, of_v, scene.v) for x in row]
    flat += [x for row in rows(graph, scene.t, scene.q, scene.v, bound).A for x in row]
    entries = iter(substitute(graph, flat, dict(zip(scene.v, moved.v, strict=True))))
    M = [[next(entries) for _ in scene.v] for _ in scene.v]
    A = [[next(entries) for _ in scene.v] for _ in bound.velocity]
    return best._replace(surface=surface(graph, M, A, bound, eps, None))


def _moved(
    scene: SymbolicSystem, kinematics: Kinematics, expansion: Expansion, eps: float
) -> _Moved:
    graph, healthy, inverse = scene.graph, [], None
    if kinematics.V is not None:
        V = list(kinematics.V)
        determinants = _determinants(graph, expansion, affine(graph, V, kinematics.u)[0])
    else:
        assert kinematics.U is not None
        theta, theta_0 = affine(graph, kinematics.U, scene.v)
        inverse = Inverse(graph, expansion, theta, eps)
        right = [graph.sub(*pair) for pair in zip(kinematics.u, theta_0, strict=True)]
        V, healthy, determinants = inverse(right), inverse.healthy, inverse.determinants
    short = attempt(partial(expansion.simplified, V))
    if short is not None and cost(graph, [short]) <= cost(graph, [V]):
        V = short
    zero_bound = dict.fromkeys(kinematics.bound, graph.zero)
    v = substitute(graph, V, zero_bound)
    B = [tangents(graph, V, {u: graph.one}) for u in kinematics.free]
    s = tangents(graph, v, dict(zip(scene.q, v, strict=True)) | {scene.t: graph.one})
    if inverse is not None and kinematics.U is not None:
        # From 0 = u' = Theta s + the derivative of U at fixed v.
        along = dict(zip(scene.q, scene.v, strict=True)) | {scene.t: graph.one}
        turning = tangents(graph, kinematics.U, along)
        turning = substitute(graph, turning, dict(zip(scene.v, v, strict=True)))
        solved = inverse([graph.scale(x, -1.0) for x in turning])
        s = min((s, solved), key=lambda s: cost(graph, [v, *B, s]))
    return _Moved(V, v, B, s, healthy, determinants)


def _determinants(graph: Graph, expansion: Expansion, B: list[list[Node]]) -> list[Node] | None:
    """Determinants of blocks of B, or of B^T B for a tall B; None if they are too long."""
    k = len(B[0])
    try:
        square = B if len(B) == k else _gram(graph, expansion, B)
        return Inverse(graph, expansion, square, 0.0).determinants
    except Unsupported:
        return None


def _gram(graph: Graph, expansion: Expansion, B: list[list[Node]]) -> list[list[Node]]:
    """B^T B."""
    columns = list(zip(*B, strict=True))
    gram = [[_dot(graph, one, other) for other in columns] for one in columns]
    short = _short(expansion, gram)
    return gram if short is None else short


def affine(
    graph: Graph, functions: Sequence[Node], inputs: Sequence[Node]
) -> tuple[list[list[Node]], list[Node]]:
    """(matrix, rest) of functions that are affine in the inputs."""
    columns = [tangents(graph, functions, {x: graph.one}) for x in inputs]
    matrix = [[column[k] for column in columns] for k in range(len(functions))]
    return matrix, substitute(graph, functions, dict.fromkeys(inputs, graph.zero))


def _quasi(scene: SymbolicSystem, kinematics: Kinematics, expansion: Expansion) -> list[Node]:
    """U(t, q, v); if it is not given, B^-1 (v - c), or (B^T B)^-1 B^T (v - c) for a tall B.

    B^T B would lose digits of a square B, above all for coordinates of different units.
    """
    graph = scene.graph
    if kinematics.U is not None:
        return list(kinematics.U)
    assert kinematics.V is not None
    B, c = affine(graph, kinematics.V, kinematics.u)
    rest = [graph.sub(*pair) for pair in zip(scene.v, c, strict=True)]
    if len(B) == len(B[0]):
        return Inverse(graph, expansion, B, 0.0)(rest)
    gram = _gram(graph, expansion, B)
    right = [_dot(graph, column, rest) for column in zip(*B, strict=True)]
    return Inverse(graph, expansion, gram, 0.0)(right)


def _lagrange(scene: SymbolicSystem, moved: _Moved, L: Node) -> tuple[list[list[Node]], list[Node]]:
    """(M, M s + h) from L(t, q, v): M s + h is Lagrange's left side at a = s."""
    graph, v = scene.graph, scene.v
    momentum = gradient(graph, L, v)
    seeds = dict(zip(scene.q, v, strict=True)) | {scene.t: graph.one}
    rate = tangents(graph, momentum, seeds | dict(zip(v, moved.s, strict=True)))
    dL_dq = gradient(graph, L, scene.q)
    left = [graph.sub(*pair) for pair in zip(rate, dL_dq, strict=True)]
    return mass_matrix(graph, L, v), left


def _by_dalembert(
    scene: SymbolicSystem, residues: Residues
) -> tuple[list[list[Node]], list[Node]] | None:
    """(M, h) by d'Alembert's principle, with `Literals` in place of numbers meanwhile."""
    literals = Literals(scene.graph)
    (L,) = literals.without([scene.lagrangian])
    found = principle_of_dalembert(scene, L, residues)
    if found is None:
        return None
    M, h = found
    flat = iter(literals.restored([*(x for row in M for x in row), *h]))
    return [[next(flat) for _ in row] for row in M], list(flat)


def _projected(
    scene: SymbolicSystem, moved: _Moved, M: list[list[Node]], left: list[Node]
) -> tuple[list[list[Node]], list[Node]]:
    """(B^T M B, B^T (Q - (M s + h)))."""
    graph, v = scene.graph, scene.v
    effort = [graph.scale(x, -1.0) for x in left]
    if scene.force is not None:
        effort = [graph.sub(*pair) for pair in zip(scene.force, left, strict=True)]
    at = dict(zip(v, moved.v, strict=True))
    effort = substitute(graph, effort, at)
    flat = iter(substitute(graph, [x for row in M for x in row], at))
    M = [[next(flat) for _ in v] for _ in v]
    heavy = [[_dot(graph, row, column) for row in M] for column in moved.B]  # M B, by columns
    return (
        [[_dot(graph, one, other) for other in heavy] for one in moved.B],
        [_dot(graph, column, effort) for column in moved.B],
    )


def _hamel(
    scene: SymbolicSystem, kinematics: Kinematics, moved: _Moved, U: Sequence[Node], L: Node
) -> tuple[list[list[Node]], list[Node]]:
    """(d2L/du2, the right side of d2L/du2 u' = ...) from L(t, q, u), with p = dL/du.

    d/dt p + B^T (Gamma p - dL/dq) = B^T Q,  Gamma p = d/dt(Theta) p - (dU/dq)^T p at fixed p and v.

    The bound quasi-velocities are set to zero only at the end, because their p is nonzero.

    Source: Pila, eqs. 4.44 to 4.58, with the terms of explicit time and of affine U.
    """
    graph, q, v, u = scene.graph, scene.q, scene.v, kinematics.u
    p = gradient(graph, L, u)
    frozen = [graph.input("momentum", i) for i in range(len(u))]
    weighted = _dot(graph, frozen, U)
    along = dict(zip(q, v, strict=True)) | {scene.t: graph.one}
    turning = tangents(graph, gradient(graph, weighted, v), along)
    bending = gradient(graph, weighted, q)
    dL_dq = gradient(graph, L, q)
    effort = [
        graph.sum([(a, -1.0), (b, 1.0), (c, 1.0)])
        for a, b, c in zip(turning, bending, dL_dq, strict=True)
    ]
    if scene.force is not None:
        effort = [graph.add(*pair) for pair in zip(scene.force, effort, strict=True)]
    at = dict(zip(v, moved.v, strict=True)) | dict(zip(frozen, p, strict=True))
    effort = substitute(graph, effort, at)
    free_momenta = [p[list(u).index(x)] for x in kinematics.free]
    rate = tangents(graph, free_momenta, dict(zip(q, moved.v, strict=True)) | {scene.t: graph.one})
    right = [
        graph.sub(_dot(graph, column, effort), x) for column, x in zip(moved.B, rate, strict=True)
    ]
    mass = mass_matrix(graph, L, kinematics.free)
    zero_bound = dict.fromkeys(kinematics.bound, graph.zero)
    flat = iter(substitute(graph, [*(x for row in mass for x in row), *right], zero_bound))
    k = len(kinematics.free)
    return [[next(flat) for _ in range(k)] for _ in range(k)], [next(flat) for _ in range(k)]


def _written(expansion: Expansion, L: Node) -> list[tuple[str, Node]]:
    """L as written and, if different, simplified."""
    short = attempt(partial(expansion.simplified, [L]))
    forms = [("L as written", L)]
    if short is not None and short[0] is not L:
        forms.append(("L simplified", short[0]))
    return forms


def _size(nodes: Sequence[Node]) -> int:
    return len(order(nodes))


def _guarded(graph: Graph, v: list[Node], healthy: list[Node]) -> list[Node]:
    """v, with a NaN first element if u does not determine it."""
    first, *rest = v
    for truth in healthy:
        first = graph.select(truth, first, graph.const(np.nan))
    return [first, *rest]


def _short(expansion: Expansion, M: list[list[Node]]) -> list[list[Node]] | None:
    flat = attempt(partial(expansion.simplified, [x for row in M for x in row]))
    if flat is None:
        return None
    entries = iter(flat)
    return [[next(entries) for _ in row] for row in M]


def _dot(graph: Graph, x: Sequence[Node], y: Sequence[Node]) -> Node:
    return graph.sum(products(graph, x, y))
