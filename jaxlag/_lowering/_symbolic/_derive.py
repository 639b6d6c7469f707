"""Lagrange's equations on the graph: the cheapest of several forms."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from jaxlag._lowering._graph._eliminate import least_operations, solve
from jaxlag._lowering._graph._expression import Node, order
from jaxlag._lowering._graph._literals import Literals
from jaxlag._lowering._graph._residues import Residues
from jaxlag._lowering._graph._simplify import Expansion
from jaxlag._lowering._graph._straight_line import assemble
from jaxlag._lowering._graph._traversal import dependencies
from jaxlag._lowering._jaxpr._differentiate import gradient
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported
from jaxlag._lowering._symbolic._bias_forms import (
    attempt,
    christoffel_form,
    cost,
    degree,
    mass_matrix,
    momentum_form,
    nonzeros,
    rate_form,
    varies,
)
from jaxlag._lowering._symbolic._constraint_solve import (
    SymbolicRows,
    reaction,
    rows,
    solve_with_reactions,
    solve_with_rows,
)
from jaxlag._lowering._symbolic._derive_quasi import derive_rates
from jaxlag._lowering._symbolic._partial_velocities import principle_of_dalembert
from jaxlag._lowering._symbolic._projection_program import surface
from jaxlag._lowering._symbolic._symbolic_system import Equations, SymbolicSystem
from jaxlag._lowering._symbolic._value_numbering import merged

LONGER = 2  # forms with so many times the nodes of the shortest are not written out
SOLVED = 2  # forms of least cost that are solved for a and compared


class Derivation(NamedTuple):
    """M, h, A and gamma in several forms, which may be solved in different ways.

    Attributes:
        lagrangian: L, simplified if possible.
        forms: the shortest ones, least cost first.
        cancelled: whether coefficients of A or gamma may be rounding.
    """

    lagrangian: Node
    forms: list["TermForm"]
    cancelled: bool


def derivation(scene: SymbolicSystem, limit: int | None) -> Derivation:
    """Derive the terms in the available forms.

    Raises:
        Unsupported: the mass matrix alone takes more operations than the limit.
    """
    graph, bound, residues = scene.graph, scene.constrained, Residues()
    graph.cancelled = bound is not None and bound.cancelled
    of_v = _rows(scene)
    cancelled = graph.cancelled
    simplified, forms = _forms(scene, of_v, residues, limit)
    sizes = [len(order([x for row in f.M for x in row] + f.h)) for f in forms]
    short = [f for f, size in zip(forms, sizes, strict=True) if size <= LONGER * min(sizes)]
    terms = [TermForm.of(scene, form, residues) for form in short]
    return Derivation(simplified, sorted(terms, key=lambda each: each.cost), cancelled)


def derive(scene: SymbolicSystem, terms: Derivation | None, eps: float) -> tuple[Equations, int]:
    """The equations in the form that is cheapest to solve, and the number of that form.

    Args:
        scene: the system.
        terms: of the same system; None if its state has quasi-velocities.
        eps: rounding of the state.
    """
    graph = scene.graph
    if terms is None:
        return derive_rates(scene, eps), 0
    found = [_solved(scene, form, eps) for form in terms.forms[:SOLVED]]
    form = min(range(len(found)), key=lambda i: found[i].program.cost)
    best = found[form]._replace(lagrangian=terms.lagrangian)
    bound = scene.constrained
    if bound is None or best.rows is None:
        return best, form
    lam = None if best.lam is None else assemble(graph, best.lam)
    return best._replace(surface=surface(graph, best.mass, best.rows.A, bound, eps, lam)), form


def shortest_solve(scene: SymbolicSystem) -> int:
    """Operations of the elimination of (a, lam), or of the rates of quasi-velocities, alone."""
    return least_operations(pattern(scene))


class _Form(NamedTuple):
    """M and h in one form.

    Attributes:
        label: the name of the form.
        M: mass matrix.
        h: bias.
        rows: A and gamma; None without constraints.
        literals: the numbers that stand as inputs in all of them.
    """

    label: str
    M: list[list[Node]]
    h: list[Node]
    rows: SymbolicRows | None
    literals: Literals


def _exact(scene: SymbolicSystem, literals: Literals) -> SymbolicSystem:
    """The scene with inputs in place of numbers, in L and the constraints."""
    bound = scene.constrained
    (L,) = literals.without([scene.lagrangian])
    if bound is not None:
        velocity, position = map(literals.without, (bound.velocity, bound.position))
        bound = bound._replace(velocity=velocity, position=position)
    return scene._replace(lagrangian=L, constrained=bound)


def _rows(scene: SymbolicSystem) -> SymbolicRows | None:
    bound = scene.constrained
    return None if bound is None else rows(scene.graph, scene.t, scene.q, scene.v, bound)


def _forms(
    scene: SymbolicSystem, of_v: SymbolicRows | None, residues: Residues, limit: int | None
) -> tuple[Node, list[_Form]]:
    """L, simplified if possible, and several forms.

    Raises:
        Unsupported: each M takes more operations than the limit.
    """
    graph, L = scene.graph, scene.lagrangian
    expansion = Expansion(graph)
    simplified = attempt(lambda: expansion.simplified([L]))
    written = [L] if simplified is None or simplified[0] is L else [L, simplified[0]]

    def expanded(nodes: Sequence[Node]) -> list[Node] | None:
        """The same as short polynomials; None if already L is none."""
        if simplified is None:
            return None
        return attempt(partial(expansion.simplified, nodes))

    masses = []
    for form in written:
        mass = mass_matrix(graph, form, scene.v)
        masses.append(mass)
        short = expanded([x for row in mass for x in row])
        if short is not None:
            n = len(scene.q)
            masses.append([short[i * n : (i + 1) * n] for i in range(n)])
    mass = min(masses, key=lambda M: (nonzeros(graph, M), cost(graph, M)))
    literals = Literals(graph)
    exact = _exact(scene, literals)
    by_dalembert = principle_of_dalembert(exact, exact.lagrangian, residues)
    if limit is not None:
        known = [mass] if by_dalembert is None else [mass, by_dalembert[0]]
        alone = min(assemble(graph, [x for row in M for x in row]).operations for M in known)
        if alone > limit:  # the bias is then not needed
            raise Unsupported(f"{alone} operations in the mass matrix alone, more than {limit}")

    forms: list[tuple[str, list[Node]]] = []
    for form, label in zip(written, ("L as written", "L simplified"), strict=False):
        bias = momentum_form(scene, form)
        forms.append((f"derivative of the momentum, {label}", bias))
    short = expanded(forms[-1][1])
    if short is not None:
        forms.append(("derivative of the momentum, expanded", short))
    seen = [form for form in written if degree([form], scene.v) <= 2.0]
    long = simplified is None and by_dalembert is not None
    if seen and not long and not varies(mass, scene.v):
        for label, form in (
            ("Christoffel symbols", christoffel_form),
            ("rates of M and c", rate_form),
        ):
            best = form(scene, seen[-1], mass)
            forms.append((label, best))
            short = expanded(best)
            if short is not None:
                forms.append((f"{label}, expanded", short))
    none = Literals(graph)
    found = [_Form(label, mass, h, of_v, none) for label, h in forms]
    if by_dalembert is not None:
        found.append(_Form("d'Alembert's principle", *by_dalembert, _rows(exact), literals))
    return written[-1], found


class TermForm(NamedTuple):
    """M, h, A and gamma in one form, of equal expressions only one.

    Attributes:
        label: the name of the form.
        M: mass matrix.
        h: bias.
        rows: A and gamma; None without constraints.
        cost: of all of them.
    """

    label: str
    M: list[list[Node]]
    h: list[Node]
    rows: SymbolicRows | None
    cost: float

    @classmethod
    def of(cls, scene: SymbolicSystem, form: _Form, residues: Residues) -> "TermForm":
        """The terms of a form."""
        restored = form.literals.restored
        found = cls(form.label, form.M, form.h, form.rows, 0.0)
        found, _ = found._merged(scene, [], residues, restored)
        A, gamma = ([], []) if found.rows is None else found.rows
        lower = [x for i, row in enumerate(found.M) for x in row[: i + 1]]
        roots = [*lower, *found.h, *(x for row in A for x in row), *gamma]
        return found._replace(cost=assemble(scene.graph, roots).cost)

    def with_force(self, scene: SymbolicSystem) -> tuple["TermForm", list[Node]]:
        """(the terms, Q - h), with what they have in common computed once."""
        if not scene.force:
            return self, [scene.graph.scale(x, -1.0) for x in self.h]
        found, force = self._merged(scene, list(scene.force), Residues(), list)
        return found, [scene.graph.sub(*pair) for pair in zip(force, found.h, strict=True)]

    def _merged(
        self, scene: SymbolicSystem, force: list[Node], residues: Residues, restored: Callable
    ) -> tuple["TermForm", list[Node]]:
        """(the terms, the force), of equal expressions only one, and with restored numbers."""
        n, rows = len(self.h), self.rows
        flat = [*(self.M[i][j] for i in range(n) for j in range(i + 1)), *self.h, *force]
        if rows is not None:
            flat += [*(x for row in rows.A for x in row), *rows.gamma]
        found = iter(restored(merged(scene.graph, flat, residues)))
        lower = [[next(found) for _ in range(i + 1)] for i in range(n)]
        M = [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
        h, force = [next(found) for _ in range(n)], [next(found) for _ in force]
        if rows is not None:
            A = [[next(found) for _ in row] for row in rows.A]
            rows = SymbolicRows(A, list(found))
        return self._replace(M=M, h=h, rows=rows), force


def _solved(scene: SymbolicSystem, terms: TermForm, eps: float) -> Equations:
    """The equations of one form, solved for a."""
    graph, bound, lam = scene.graph, scene.constrained, None
    (label, M, h, found_rows, _), right = terms.with_force(scene)
    reactive = None if bound is None else reaction(graph, bound)
    if bound is None or found_rows is None:
        a = solve(graph, M, right, eps)
    elif reactive is not None:
        how = bound.active_rows, bound.sharing, bound.regular
        a, lam = solve_with_reactions(graph, M, found_rows, right, reactive, eps, *how)
    else:
        sides = [(right, found_rows.gamma)]
        how = bound.active_rows, bound.formulation, bound.regular, bound.crossing
        (a,) = solve_with_rows(graph, M, found_rows.A, sides, eps, *how)
    program = assemble(graph, a)
    return Equations(scene.lagrangian, M, h, a, program, label, found_rows, lam=lam)


def pattern(scene: SymbolicSystem) -> list[list[bool]]:
    """Which entries of [M, A^T; A, 0] may differ from zero: p and A v + b depend on v_j.

    Of M alone with quasi-velocities, by p that depends on u_j if L depends on u.
    """
    known, bound = scene.kinematics, scene.constrained
    v = scene.v if known is None or not known.in_u else known.u
    momentum = gradient(scene.graph, scene.lagrangian, v)
    residuals = [] if bound is None or known is not None else bound.velocity
    reached = dependencies([*momentum, *residuals])
    M, A = ([[x.data in reached[p] for x in v] for p in part] for part in (momentum, residuals))
    above = [[*row, *(a[i] for a in A)] for i, row in enumerate(M)]
    return above + [[*a, *[False] * len(A)] for a in A]
