"""M and h from partial velocities: d'Alembert's principle on the graph.

L is a sum of products of functions x that are linear in v, such as velocities of points and body
rates, of such functions alone, and of a rest L_0(t, q):

    L = sum_k c_k x_k y_k + sum_l c_l x_l + L_0,  x = sum_i x_i v_i + x_0

With the partial velocities x_i and the rate x' along the motion at a = 0,

    M_ij = sum_k c_k (x_ki y_kj + y_ki x_kj)
    h_i = sum_k c_k (x_ki y_k' + y_ki x_k' + K_i(x_k) y_k + K_i(y_k) x_k)
          + sum_l c_l K_i(x_l) - dL_0/dq_i
    K_i(x) = d/dt (dx/dv_i) - dx/dq_i

K is zero if x is the rate of a function of (t, q). For quasi-velocities, such as body rates, it is
often

    K_i(x) = s (a_i b - b_i a)

with two other of the functions and a number s, as in the Boltzmann-Hamel equations. L is never
multiplied out. Every property is tested by residues.

Source: Kane and Levinson, Dynamics: Theory and Applications (1985), secs. 2.14 and 6.1; Pila,
eqs. 4.44 to 4.58, for K.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from heapq import heappop, heappush
from typing import NamedTuple

from jaxlag._lowering._graph._expression import Graph, Node, node_id, order
from jaxlag._lowering._graph._residues import PRIME, ZERO, Residue, Residues, fraction
from jaxlag._lowering._jaxpr._differentiate import gradient, tangents
from jaxlag._lowering._symbolic._bias_forms import degrees
from jaxlag._lowering._symbolic._symbolic_system import SymbolicSystem


class QuadraticTerms(NamedTuple):
    """L as a sum of terms; their coefficients depend on params alone.

    Attributes:
        products: (c, x, y) of c x y.
        linear: (c, x) of c x.
        rest: (c, f) of c f(t, q).
    """

    products: list[tuple[Node, Node, Node]]
    linear: list[tuple[Node, Node]]
    rest: list[tuple[Node, Node]]


def terms_of(graph: Graph, L: Node, v: Sequence[Node]) -> QuadraticTerms | None:
    """The terms of L; None if it is no polynomial of at most degree 2 in v.

    Sums are opened from the root downwards. Each node is opened once for each factor that depends
    on the state, with the sum of its coefficients.
    """
    degree = degrees([L], v)
    if not degree[L] <= 2.0:
        return None
    found = QuadraticTerms([], [], [])
    coefficients: dict[tuple[Node, Node], list[tuple[Node, float]]] = {}
    waiting: list[tuple[int, int]] = []

    def enter(node: Node, factor: Node, c: Node, number: float = 1.0) -> None:
        """Add number * c * factor * node; the factor is free of v, c depends on params alone."""
        if (node, factor) not in coefficients:
            heappush(waiting, (-node.id, factor.id))
        coefficients.setdefault((node, factor), []).append((c, number))

    enter(L, graph.one, graph.one)
    while waiting:
        place, of_factor = heappop(waiting)
        node, factor = graph.nodes[-place], graph.nodes[of_factor]
        c = graph.sum(coefficients.pop((node, factor)))
        if degree[node] == 0.0:
            found.rest.append((c, graph.mul(factor, node)))
        elif degree[node] == 1.0:
            found.linear.append((c, graph.mul(factor, node)))
        elif node.op == "let":
            enter(node.args[0], factor, c)
        elif node.op == "sum":
            constant, terms = node.data
            if constant:
                found.rest.append((graph.scale(c, constant), factor))
            for term, number in terms:
                enter(term, factor, c, number)
        else:
            free = [f for f in node.data if degree[f[0]] == 0.0]
            (x, _), *more = [f for f in node.data if degree[f[0]] > 0.0]
            c = graph.product([(c, 1), *(f for f in free if f[0].fixed)])
            moving = [f for f in free if not f[0].fixed]
            if not more and degree[x] == 2.0:
                enter(x, graph.product([(factor, 1), *moving]), c)
                continue
            y, moving = more[0][0] if more else x, [(factor, 1), *moving]
            if x is y:
                inside = [(base, e // 2) for base, e in moving if e % 2 == 0]
                moving = [f for f in moving if f[1] % 2]
                x = y = graph.product([*inside, (x, 1)])
            found.products.append((c, graph.product([*moving, (x, 1)]), y))
    return found


class _Function(NamedTuple):
    """A function x that is linear in v.

    Attributes:
        partial: x_i.
        slope: dx/dq_i.
        rate: x' at a = 0.
    """

    partial: list[Node]
    slope: list[Node]
    rate: Node


def principle_of_dalembert(
    scene: SymbolicSystem, L: Node, residues: Residues
) -> tuple[list[list[Node]], list[Node]] | None:
    """(M, h); None if L is no polynomial of degree 2 in v."""
    graph, n = scene.graph, len(scene.q)
    terms = terms_of(graph, L, scene.v)
    if terms is None:
        return None
    functions = _functions(scene, terms)
    pairs = _ordered(graph, terms.products, functions, residues)
    used = dict.fromkeys([x for _, x, _ in pairs] + [x for _, x in terms.linear])
    curls = {x: K for x in used if not residues.vanish(K := _curl(scene, functions[x]))}
    rotations = _rotations(functions, curls, residues)

    # h_i = sum of x_i times its load, plus the other terms.
    loads: dict[Node, list[tuple[Node, float]]] = defaultdict(list)
    others: list[list[tuple[Node, float]]] = [[] for _ in range(n)]

    def turn(x: Node, momentum: Node) -> None:
        """Add K_i(x) times a momentum."""
        if x in rotations:
            a, b, s = rotations[x]
            loads[a].append((graph.mul(b, momentum), s))
            loads[b].append((graph.mul(a, momentum), -s))
        elif x in curls:
            for i, K in enumerate(curls[x]):
                others[i].append((graph.mul(K, momentum), 1.0))

    momenta: dict[Node, list[list[tuple[Node, float]]]] = {}
    for c, x, y in pairs:
        of_x = momenta.setdefault(x, [[] for _ in range(n)])
        for j, partial in enumerate(functions[y].partial):
            of_x[j].append((graph.mul(c, partial), 1.0))
        loads[x].append((graph.mul(c, functions[y].rate), 1.0))
        turn(x, graph.mul(c, y))
    for c, x in terms.linear:
        turn(x, c)
    _potential(scene, terms, functions, residues, loads, others)

    def present(vector: Sequence[Node]) -> list[tuple[int, Node]]:
        return [(i, x) for i, x in enumerate(vector) if x is not graph.zero]

    entries: dict[tuple[int, int], list[tuple[Node, float]]] = defaultdict(list)
    for x, of_x in momenta.items():
        column = present([graph.sum(p) for p in of_x])
        for i, partial in present(functions[x].partial):
            for j, p in column:
                if j >= i:
                    entries[i, j].append((graph.mul(partial, p), 1.0))
    M: list[list[Node]] = [[graph.zero] * n for _ in range(n)]
    for (i, j), entry in entries.items():
        M[i][j] = M[j][i] = graph.sum(entry)
    whole = {x: graph.sum(load) for x, load in loads.items()}
    h = []
    for i in range(n):
        driven = [(graph.mul(functions[x].partial[i], load), 1.0) for x, load in whole.items()]
        h.append(graph.sum([*driven, *others[i]]))
    return M, h


def _functions(scene: SymbolicSystem, terms: QuadraticTerms) -> dict[Node, _Function]:
    """All functions that are linear in v, with their derivatives."""
    graph, unit = scene.graph, scene.graph.one
    along = dict(zip(scene.q, scene.v, strict=True)) | {scene.t: unit}
    found = [f for _, x, y in terms.products for f in (x, y)] + [x for _, x in terms.linear]
    functions = list(dict.fromkeys(found))
    partial = list(zip(*(tangents(graph, functions, {v: unit}) for v in scene.v), strict=True))
    slope = list(zip(*(tangents(graph, functions, {q: unit}) for q in scene.q), strict=True))
    rate = tangents(graph, functions, along)
    found = zip(map(list, partial), map(list, slope), rate, strict=True)
    return {x: _Function(*derivatives) for x, derivatives in zip(functions, found, strict=True)}


def _curl(scene: SymbolicSystem, x: _Function) -> list[Node]:
    """K_i."""
    along = dict(zip(scene.q, scene.v, strict=True)) | {scene.t: scene.graph.one}
    moved = tangents(scene.graph, x.partial, along)
    return [scene.graph.sub(*pair) for pair in zip(moved, x.slope, strict=True)]


def _ordered(
    graph: Graph,
    given: list[tuple[Node, Node, Node]],
    functions: dict[Node, _Function],
    residues: Residues,
) -> list[tuple[Node, Node, Node]]:
    """(c, x, y) with M_ij = sum c x_i y_j and, for example, T = w.Iw/2 as (1, w, Iw).

    If the sum of c x_i y_j is symmetric, as I is, x and y are not exchanged.
    """
    pairs, mixed = [], []
    for c, x, y in given:
        if x is y:
            pairs.append((graph.scale(c, 2.0), x, x))
        else:
            mixed.append((c, x, y) if x in order([y]) else (c, y, x))
    for group in _connected(mixed):
        if _symmetric(graph, group, functions, residues):
            pairs += [(graph.scale(c, 2.0), x, y) for c, x, y in group]
        else:
            pairs += [(c, x, y) for c, x, y in group] + [(c, y, x) for c, x, y in group]
    return pairs


def _connected(given: list[tuple[Node, Node, Node]]) -> list[list[tuple[Node, Node, Node]]]:
    """Products whose y contain each other's x, in groups."""
    groups: list[tuple[set[Node], list]] = []
    first = {x for _, x, _ in given}
    for item in given:
        _, x, y = item
        touched, members = {x, *(first & set(order([y])))}, [item]
        apart = []
        for nodes, others in groups:
            if nodes & touched:
                touched, members = nodes | touched, [*others, *members]
            else:
                apart.append((nodes, others))
        groups = [*apart, (touched, members)]
    return [members for _, members in groups]


def _symmetric(
    graph: Graph,
    group: list[tuple[Node, Node, Node]],
    functions: dict[Node, _Function],
    residues: Residues,
) -> bool:
    """Whether dx y = x dy in the sum over the group, for derivatives in v and in q."""
    for field in ("partial", "slope"):
        for i in range(len(next(iter(functions.values())).partial)):
            terms = []
            for c, x, y in group:
                dx, dy = (getattr(functions[f], field)[i] for f in (x, y))
                terms += [(graph.mul(c, dx, y), 1.0), (graph.mul(c, dy, x), -1.0)]
            if not residues.vanish([graph.sum(terms)]):
                return False
    return True


def _rotations(
    functions: dict[Node, _Function], curls: dict[Node, list[Node]], residues: Residues
) -> dict[Node, tuple[Node, Node, float]]:
    """x -> (a, b, s) with K_i(x) = s (a_i b - b_i a)."""
    curved = list(curls)
    values = dict(zip(curved, residues(curved), strict=True))
    partial = {x: residues(functions[x].partial) for x in curved}
    known: dict[tuple, tuple[Node, Node, Residue]] = {}
    for k, a in enumerate(curved):
        for b in curved[k + 1 :]:
            pair = [
                tuple((x * w - y * u) % PRIME for x, y, u, w in zip(*at, strict=True))
                for at in (
                    (a_i, b_i, values[a], values[b])
                    for a_i, b_i in zip(partial[a], partial[b], strict=True)
                )
            ]
            direction, size = _normalized(pair)
            if direction is not None:
                known.setdefault(direction, (a, b, size))
    found = {}
    for x in curved:
        direction, size = _normalized(residues(curls[x]))
        if direction in known:
            a, b, of_pair = known[direction]
            s = _ratio(size, of_pair)
            if s is not None:
                found[x] = a, b, s
    return found


def _normalized(vector: list[Residue]) -> tuple[tuple | None, Residue]:
    """(the vector over its first nonzero entry, this entry); None for zero."""
    for size in vector:
        if all(size):
            over = [pow(s, -1, PRIME) for s in size]
            return tuple(
                tuple(x * o % PRIME for x, o in zip(entry, over, strict=True)) for entry in vector
            ), size
    return None, ZERO


def _ratio(above: Residue, below: Residue) -> float | None:
    """Their quotient if it is a fraction of small integers."""
    pairs = zip(above, below, strict=True)
    return fraction(tuple(x * pow(y, -1, PRIME) % PRIME for x, y in pairs))


def _potential(
    scene: SymbolicSystem,
    terms: QuadraticTerms,
    functions: dict[Node, _Function],
    residues: Residues,
    loads: dict[Node, list[tuple[Node, float]]],
    others: list[list[tuple[Node, float]]],
) -> None:
    """Subtract dL_0/dq_i; of a position whose velocity is an x, as a load of x."""
    graph = scene.graph
    known = {}
    for x in loads:
        direction, size = _normalized(residues(functions[x].partial))
        if direction is not None:
            known.setdefault(direction, (x, size))

    parts = _linear_parts(f for _, f in terms.rest)
    slopes = zip(*(tangents(graph, parts, {q: graph.one}) for q in scene.q), strict=True)
    driven: dict[Node, tuple[Node, float]] = {}
    opened: set[Node] = set()
    for f, df_dq in zip(parts, slopes, strict=True) if known else ():
        direction, size = _normalized(residues(df_dq))
        if direction in known:
            x, of_x = known[direction]
            if (s := _ratio(size, of_x)) is not None:
                driven[f] = x, s
        elif any(part in opened or part in driven for part in _inside(f)):
            opened.add(f)

    coefficients: dict[Node, list[tuple[Node, float]]] = defaultdict(list)
    for c, f in terms.rest:
        coefficients[f].append((c, 1.0))
    left = []
    for f in reversed(parts):
        if f not in coefficients:
            continue
        c = graph.sum(coefficients.pop(f))
        if f in driven:
            x, s = driven[f]
            loads[x].append((c, -s))
        elif f in opened and f.op == "sum":
            for term, number in f.data[1]:
                coefficients[term].append((c, number))
        elif f in opened:
            (moving,), fixed = _inside(f), [factor for factor in f.data if factor[0].fixed]
            coefficients[moving].append((graph.product([(c, 1), *fixed]), 1.0))
        else:
            left.append((graph.mul(c, f), 1.0))
    for i, slope in enumerate(gradient(graph, graph.sum(left), scene.q)):
        others[i].append((slope, -1.0))


def _linear_parts(roots: Iterable[Node]) -> list[Node]:
    """The roots and all nodes that they contain linearly, without those of params alone."""
    found: set[Node] = set()
    stack = [root for root in roots if not root.fixed]
    while stack:
        node = stack.pop()
        if node not in found:
            found.add(node)
            stack += _inside(node)
    return sorted(found, key=node_id)


def _inside(node: Node) -> list[Node]:
    """The terms of a sum, or the only factor of a product, that depend on the state."""
    if node.op == "sum":
        return [term for term in node.args if not term.fixed]
    if node.op == "product":
        moving = [(base, e) for base, e in node.data if not base.fixed]
        return [base for base, e in moving if e == 1 and len(moving) == 1]
    return []
