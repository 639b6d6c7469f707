"""Lagrange's equations on the graph: the cheapest of several forms."""

from functools import partial

from jaxlag._lowering._graph._eliminate import least_operations, solve
from jaxlag._lowering._graph._expression import Node, dependencies
from jaxlag._lowering._graph._simplify import Expansion
from jaxlag._lowering._graph._straight_line import assemble
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
    reaction,
    rows,
    solve_with_reactions,
    solve_with_rows,
)
from jaxlag._lowering._symbolic._derive_quasi import derive_rates
from jaxlag._lowering._symbolic._projection_program import surface
from jaxlag._lowering._symbolic._symbolic_system import Equations, SymbolicSystem


def derive(scene: SymbolicSystem, eps: float, limit: int | None) -> Equations:
    """Derive the equations in the cheapest of the available forms.

    Raises:
        Unsupported: the solve or the mass matrix alone takes more operations than the limit.
    """
    graph, L = scene.graph, scene.lagrangian
    if limit is not None:
        least = least_operations(pattern(scene))
        if least > limit:
            raise Unsupported(f"at least {least} operations, more than {limit}")
    if scene.kinematics is not None:
        return derive_rates(scene, eps)
    expansion = Expansion(graph)
    simplified = attempt(lambda: expansion.simplified([L]))
    written = [L] if simplified is None or simplified[0] is L else [L, simplified[0]]

    masses = []
    for form in written:
        mass = mass_matrix(graph, form, scene.v)
        masses.append(mass)
        flat = [x for row in mass for x in row]
        short = attempt(partial(expansion.simplified, flat))
        if short is not None:
            n = len(scene.q)
            masses.append([short[i * n : (i + 1) * n] for i in range(n)])
    mass = min(masses, key=lambda M: (nonzeros(graph, M), cost(graph, M)))
    if limit is not None:
        alone = assemble(graph, [x for row in mass for x in row]).operations
        if alone > limit:  # the bias is then not needed
            raise Unsupported(f"{alone} operations in the mass matrix alone, more than {limit}")

    forms: list[tuple[str, list[Node]]] = []
    for form, label in zip(written, ("L as written", "L simplified"), strict=False):
        bias = momentum_form(scene, form)
        forms.append((f"derivative of the momentum, {label}", bias))
    bias = forms[-1][1]
    short = attempt(lambda: expansion.simplified(bias))
    if short is not None:
        forms.append(("derivative of the momentum, expanded", short))
    seen = [form for form in written if degree([form], scene.v) <= 2.0]
    if seen and not varies(mass, scene.v):
        for label, form in (
            ("Christoffel symbols", christoffel_form),
            ("rates of M and c", rate_form),
        ):
            best = form(scene, seen[-1], mass)
            forms.append((label, best))
            short = attempt(partial(expansion.simplified, best))
            if short is not None:
                forms.append((f"{label}, expanded", short))

    bound = scene.constrained
    found_rows = None if bound is None else rows(graph, scene.t, scene.q, scene.v, bound)
    reactive = None if bound is None else reaction(graph, bound)
    found = []
    for label, h in forms:
        lam = None
        right = [graph.scale(x, -1.0) for x in h]
        if scene.force is not None:
            right = [graph.sub(Q, x) for Q, x in zip(scene.force, h, strict=True)]
        if bound is None or found_rows is None:
            a = solve(graph, mass, right, eps)
        elif reactive is not None:
            how = bound.active_rows, bound.sharing, bound.regular
            a, lam = solve_with_reactions(graph, mass, found_rows, right, reactive, eps, *how)
        else:
            sides = [(right, found_rows.gamma)]
            how = bound.active_rows, bound.formulation, bound.regular, bound.crossing
            (a,) = solve_with_rows(graph, mass, found_rows.A, sides, eps, *how)
        program = assemble(graph, a)
        found.append(Equations(written[-1], mass, h, a, program, label, found_rows, lam=lam))
    best = min(found, key=lambda e: e.program.cost)
    if bound is None or found_rows is None:
        return best
    lam = None if best.lam is None else assemble(graph, best.lam)
    return best._replace(surface=surface(graph, mass, found_rows.A, bound, eps, lam))


def pattern(scene: SymbolicSystem) -> list[list[bool]]:
    """Which entries of M may differ from zero: p_i depends on v_j (on u_j if L depends on u)."""
    known = scene.kinematics
    v = scene.v if known is None or not known.in_u else known.u
    momentum = gradient(scene.graph, scene.lagrangian, v)
    reached = dependencies(momentum)
    return [[x.data in reached[p] for x in v] for p in momentum]
