"""M and h from L on the graph, in several forms."""

import math
from collections.abc import Callable, Sequence

from jaxlag._lowering._graph._expression import Graph, Node, order
from jaxlag._lowering._graph._simplify import TooLong
from jaxlag._lowering._graph._straight_line import assemble
from jaxlag._lowering._graph._traversal import substitute
from jaxlag._lowering._jaxpr._differentiate import gradient, tangents
from jaxlag._lowering._symbolic._symbolic_system import SymbolicSystem


def attempt(make: Callable) -> list[Node] | None:
    """The result of `make`; None if a polynomial becomes too long."""
    try:
        return make()
    except TooLong:
        return None


def mass_matrix(graph: Graph, L: Node, v: Sequence[Node]) -> list[list[Node]]:
    """M_ij = d2L/dv_i dv_j, symmetric by construction."""
    momentum = gradient(graph, L, v)
    n = len(v)
    M: list[list[Node]] = [[graph.zero] * n for _ in range(n)]
    for j, x in enumerate(v):
        column = tangents(graph, momentum[j:], {x: graph.one})
        for i in range(j, n):
            M[i][j] = M[j][i] = column[i - j]
    return M


def momentum_form(scene: SymbolicSystem, L: Node) -> list[Node]:
    """h = (dp/dq) v + dp/dt - dL/dq by one derivative of p along the motion."""
    graph = scene.graph
    momentum = gradient(graph, L, scene.v)
    seeds = dict(zip(scene.q, scene.v, strict=True)) | {scene.t: graph.one}
    rate = tangents(graph, momentum, seeds)
    dL_dq = gradient(graph, L, scene.q)
    return [graph.sub(a, b) for a, b in zip(rate, dL_dq, strict=True)]


def christoffel_form(scene: SymbolicSystem, L: Node, M: Sequence[Sequence[Node]]) -> list[Node]:
    """h_i = sum_jk (dM_ij/dq_k - dM_jk/dq_i / 2) v_j v_k + the rest of L, for L quadratic in v.

    The rest, L - v.Mv/2, is linear in v: c . v + L_0, with c and L_0 evaluated at v = 0. If M or c
    depends on time, dM/dt v + dc/dt is added.
    """
    graph, n = scene.graph, len(scene.q)
    at_rest = dict.fromkeys(scene.v, graph.zero)
    L_0 = substitute(graph, [L], at_rest)[0]
    c = substitute(graph, gradient(graph, L, scene.v), at_rest)
    moving = {(i, j): M[i][j] for i in range(n) for j in range(i + 1) if not M[i][j].fixed}

    def entries(packed: Sequence[Node]) -> Callable[[int, int], Node]:
        lower = dict(zip(moving, packed, strict=True))
        return lambda i, j: lower.get((max(i, j), min(i, j)), graph.zero)

    slopes, present = [], [set[tuple[int, int]]() for _ in range(n)]
    for k, q in enumerate(scene.q):
        packed = tangents(graph, list(moving.values()), {q: graph.one})
        slopes.append(entries(packed))
        for (i, j), slope in zip(moving, packed, strict=True):
            if slope is not graph.zero:
                present[i].add((min(j, k), max(j, k)))
                present[j].add((min(i, k), max(i, k)))
                present[k].add((j, i))
    M_t = entries(tangents(graph, list(moving.values()), {scene.t: graph.one}))
    c_q = [tangents(graph, c, {q: graph.one}) for q in scene.q]  # [k][i]
    c_t = tangents(graph, c, {scene.t: graph.one})
    dL_dq = gradient(graph, L_0, scene.q)
    v, h = scene.v, []
    for i in range(n):
        terms: list[tuple[Node, float]] = [(dL_dq[i], -1.0), (c_t[i], 1.0)]
        for j, k in sorted(present[i]):
            gamma = [(slopes[k](i, j), 1.0), (slopes[j](i, k), 1.0), (slopes[i](j, k), -1.0)]
            both = graph.scale(graph.sum(gamma), 0.5 if j == k else 1.0)
            terms.append((graph.product([(both, 1), (v[j], 1), (v[k], 1)]), 1.0))
        for j in range(n):
            symbol = [(M_t(i, j), 1.0), (c_q[j][i], 1.0), (c_q[i][j], -1.0)]
            terms.append((graph.mul(graph.sum(symbol), v[j]), 1.0))
        h.append(graph.sum(terms))
    return h


def rate_form(scene: SymbolicSystem, L: Node, M: Sequence[Sequence[Node]]) -> list[Node]:
    """h = dM/dt v + dc/dt - dL/dq along the motion, for L quadratic in v: p = M v + c."""
    graph, n = scene.graph, len(scene.q)
    at_rest = dict.fromkeys(scene.v, graph.zero)
    c = substitute(graph, gradient(graph, L, scene.v), at_rest)
    seeds = dict(zip(scene.q, scene.v, strict=True)) | {scene.t: graph.one}
    flat = [M[i][j] for i in range(n) for j in range(i + 1)]
    rates = tangents(graph, [*flat, *c], seeds)
    dL_dq = gradient(graph, L, scene.q)
    h = []
    for i in range(n):
        row = [rates[max(i, j) * (max(i, j) + 1) // 2 + min(i, j)] for j in range(n)]
        terms = [(graph.mul(rate, v), 1.0) for rate, v in zip(row, scene.v, strict=True)]
        h.append(graph.sum([*terms, (rates[len(flat) + i], 1.0), (dL_dq[i], -1.0)]))
    return h


def degree(roots: Sequence[Node], variables: Sequence[Node]) -> float:
    """Degree of polynomials in the variables with coefficients free of them; else inf."""
    known = degrees(roots, variables)
    return max((known[root] for root in roots), default=0.0)


def degrees(roots: Sequence[Node], variables: Sequence[Node]) -> dict[Node, float]:
    """Degrees of all nodes below the roots as polynomials in the variables; else inf.

    The graph alone decides: a function, a choice or a stopped derivative of a variable counts as
    inf, even if it cancels.
    """
    wanted, known = set(variables), dict[Node, float]()
    for node in order(roots):
        below = [known[arg] for arg in node.args]
        if node in wanted:
            known[node] = 1.0
        elif not any(below):
            known[node] = 0.0
        elif node.op in ("sum", "let"):
            known[node] = max(below)
        elif node.op == "product":
            powers = zip(below, (e for _, e in node.data), strict=True)
            known[node] = sum(d * e if e > 0 else math.inf for d, e in powers if d)
        else:
            known[node] = math.inf
    return known


def varies(M: Sequence[Sequence[Node]], inputs: Sequence[Node]) -> bool:
    """Whether any entry depends on any of the inputs."""
    wanted = set(inputs)
    return any(node in wanted for node in order(x for row in M for x in row))


def nonzeros(graph: Graph, M: Sequence[Sequence[Node]]) -> int:
    """Entries that are not structurally zero."""
    return sum(x is not graph.zero for row in M for x in row)


def cost(graph: Graph, M: Sequence[Sequence[Node]]) -> float:
    """Cost of the entries alone."""
    return assemble(graph, [x for row in M for x in row]).cost
