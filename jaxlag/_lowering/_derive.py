"""Lagrange's equations on the graph: several ways to write them, the cheapest kept."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from jaxlag._lowering._diff import gradient, tangents
from jaxlag._lowering._expand import Expansion, TooLong
from jaxlag._lowering._graph import Graph, Node, dependencies, order
from jaxlag._lowering._ingest import Unsupported
from jaxlag._lowering._program import Program, assemble
from jaxlag._lowering._solve import least_operations, solve


class Scene(NamedTuple):
    """A system as scalars: L and Q as functions of the inputs t, q, v."""

    graph: Graph
    t: Node
    q: Sequence[Node]
    v: Sequence[Node]
    lagrangian: Node
    force: Sequence[Node] | None


class Equations(NamedTuple):
    """M a + h = Q, and the straight-line code for a.

    Attributes:
        lagrangian: L, simplified where that is possible.
        mass: M, n rows.
        bias: h.
        accelerations: a.
        program: straight-line code for a.
        form: how h was written, in words.
    """

    lagrangian: Node
    mass: list[list[Node]]
    bias: list[Node]
    accelerations: list[Node]
    program: Program
    form: str


def derive(scene: Scene, eps: float, limit: int | None) -> Equations:
    """The cheapest of the forms that exist.

    Raises:
        Unsupported: the solve alone takes more operations than the limit.
    """
    graph, L = scene.graph, scene.lagrangian
    if limit is not None:
        least = least_operations(pattern(scene))
        if least > limit:
            raise Unsupported(f"at least {least} operations, more than {limit}")
    expansion = Expansion(graph)
    simplified = attempt(lambda: expansion.simplified([L]))
    written = [L] if simplified is None or simplified[0] is L else [L, simplified[0]]

    masses = []
    for form in written:
        mass = mass_matrix(scene, form)
        masses.append(mass)
        flat = [x for row in mass for x in row]
        short = attempt(partial(expansion.simplified, flat))
        if short is not None:
            n = len(scene.q)
            masses.append([short[i * n : (i + 1) * n] for i in range(n)])
    mass = min(masses, key=lambda M: (nonzeros(graph, M), cost(graph, M)))

    forms: list[tuple[str, list[Node]]] = []
    for form, words in zip(written, ("L as written", "L simplified"), strict=False):
        bias = momentum_form(scene, form)
        forms.append((f"derivative of the momentum, {words}", bias))
    bias = forms[-1][1]
    short = attempt(lambda: expansion.simplified(bias))
    if short is not None:
        forms.append(("derivative of the momentum, expanded", short))
    if not varies(mass, scene.v):
        best = christoffel_form(scene, written[-1], mass)
        forms.append(("Christoffel symbols", best))
        short = attempt(lambda: expansion.simplified(best))
        if short is not None:
            forms.append(("Christoffel symbols, expanded", short))

    found = []
    for words, h in forms:
        right = [graph.scale(x, -1.0) for x in h]
        if scene.force is not None:
            right = [graph.sub(Q, x) for Q, x in zip(scene.force, h, strict=True)]
        a = solve(graph, mass, right, eps)
        found.append(Equations(written[-1], mass, h, a, assemble(graph, a), words))
    return min(found, key=lambda e: e.program.cost)


def attempt(make: Callable) -> list[Node] | None:
    """What `make` returns, None where a polynomial grows too long."""
    try:
        return make()
    except TooLong:
        return None


def pattern(scene: Scene) -> list[list[bool]]:
    """Which entries of M may differ from zero: p_i depends on v_j."""
    momentum = gradient(scene.graph, scene.lagrangian, scene.v)
    reached = dependencies(momentum)
    return [[v.data in reached[p] for v in scene.v] for p in momentum]


def mass_matrix(scene: Scene, L: Node) -> list[list[Node]]:
    """M_ij = d2L/dv_i dv_j, symmetric by construction."""
    momentum = gradient(scene.graph, L, scene.v)
    n = len(scene.v)
    M: list[list[Node]] = [[scene.graph.zero] * n for _ in range(n)]
    for j, v in enumerate(scene.v):
        column = tangents(scene.graph, momentum[j:], {v: scene.graph.one})
        for i in range(j, n):
            M[i][j] = M[j][i] = column[i - j]
    return M


def momentum_form(scene: Scene, L: Node) -> list[Node]:
    """h = (dp/dq) v + dp/dt - dL/dq by one derivative of p along the motion."""
    graph = scene.graph
    momentum = gradient(graph, L, scene.v)
    seeds = dict(zip(scene.q, scene.v, strict=True)) | {scene.t: graph.one}
    rate = tangents(graph, momentum, seeds)
    pull = gradient(graph, L, scene.q)
    return [graph.sub(a, b) for a, b in zip(rate, pull, strict=True)]


def christoffel_form(scene: Scene, L: Node, M: Sequence[Sequence[Node]]) -> list[Node]:
    """h_i = sum_jk (dM_ij/dq_k - dM_jk/dq_i / 2) v_j v_k + the rest of L, for M free of v.

    The rest, L - v.Mv/2, is linear in v: c . v + L_0, with c and L_0 read off at v = 0. With
    time in M or c, dM/dt v + dc/dt join in.
    """
    graph, n = scene.graph, len(scene.q)
    at_rest = dict.fromkeys(scene.v, graph.zero)
    L_0 = substitute(graph, [L], at_rest)[0]
    c = substitute(graph, gradient(graph, L, scene.v), at_rest)
    flat = [M[i][j] for i in range(n) for j in range(i + 1)]

    def full(packed: Sequence[Node]) -> list[list[Node]]:
        rows: list[list[Node]] = [[graph.zero] * n for _ in range(n)]
        entries = iter(packed)
        for i in range(n):
            for j in range(i + 1):
                rows[i][j] = rows[j][i] = next(entries)
        return rows

    slopes = [full(tangents(graph, flat, {q: graph.one})) for q in scene.q]  # [k][i][j]
    M_t = full(tangents(graph, flat, {scene.t: graph.one}))
    c_q = [tangents(graph, c, {q: graph.one}) for q in scene.q]  # [k][i]
    c_t = tangents(graph, c, {scene.t: graph.one})
    pull = gradient(graph, L_0, scene.q)
    v, h = scene.v, []
    for i in range(n):
        terms: list[tuple[Node, float]] = [(pull[i], -1.0), (c_t[i], 1.0)]
        for j in range(n):
            symbol: list[tuple[Node, float]] = [(M_t[i][j], 1.0)]
            symbol += [(c_q[j][i], 1.0), (c_q[i][j], -1.0)]
            for k in range(j, n):
                gamma = [(slopes[k][i][j], 1.0), (slopes[j][i][k], 1.0), (slopes[i][j][k], -1.0)]
                weight = 0.5 if j == k else 1.0
                both = graph.scale(graph.sum(gamma), weight)
                terms.append((graph.product([(both, 1), (v[j], 1), (v[k], 1)]), 1.0))
            terms.append((graph.mul(graph.sum(symbol), v[j]), 1.0))
        h.append(graph.sum(terms))
    return h


def substitute(graph: Graph, roots: Sequence[Node], values: dict[Node, Node]) -> list[Node]:
    """The roots with inputs replaced."""
    known: dict[Node, Node] = {}
    for node in order(roots):
        known[node] = rebuilt(graph, node, [known[arg] for arg in node.args], values)
    return [known[root] for root in roots]


def rebuilt(graph: Graph, node: Node, args: list[Node], values: dict[Node, Node]) -> Node:
    """The node computed from other arguments."""
    if node.op == "input":
        return values.get(node, node)
    if node.op == "const":
        return node
    if node.op == "sum":
        constant, terms = node.data
        return graph.sum(zip(args, (c for _, c in terms), strict=True), constant)
    if node.op == "product":
        return graph.product(zip(args, (e for _, e in node.data), strict=True))
    if node.op == "call":
        return graph.call(node.data, *args)
    if node.op == "select":
        return graph.select(*args)
    if node.op == "custom":
        rule, index = node.data
        return graph.custom(rule, index, args)
    return graph.stop(args[0]) if node.op == "stop" else graph.let(args[0])


def varies(M: Sequence[Sequence[Node]], inputs: Sequence[Node]) -> bool:
    """Whether any entry depends on any of the inputs."""
    wanted = set(inputs)
    return any(node in wanted for node in order(x for row in M for x in row))


def nonzeros(graph: Graph, M: Sequence[Sequence[Node]]) -> int:
    """Entries that are not structurally zero."""
    return sum(x is not graph.zero for row in M for x in row)


def cost(graph: Graph, M: Sequence[Sequence[Node]]) -> float:
    """Cost of the entries by themselves."""
    return assemble(graph, [x for row in M for x in row]).cost
