"""Forward and reverse derivatives on the graph; structural zeros create no nodes."""

from collections.abc import Mapping, Sequence

import jax
import numpy as np

from jaxlag._lowering._graph._expression import (
    CONSTANT_PIECES,
    COS,
    SIN,
    Graph,
    Node,
    Primitive,
    order,
)
from jaxlag._lowering._jaxpr._from_jaxpr import Rule, Unsupported, read


def partials(graph: Graph, node: Node) -> list[Node]:
    """Derivative of a call with respect to each of its arguments."""
    primitive, args = node.data, node.args
    known = _TABLE.get(primitive.name)
    if known is not None:
        return known(graph, node, *args)
    if primitive.name in CONSTANT_PIECES:
        return [graph.zero] * len(args)
    return [_by_jax(graph, primitive, args, i) for i in range(len(args))]


def tangents(graph: Graph, roots: Sequence[Node], seeds: Mapping[Node, Node]) -> list[Node]:
    """Derivatives of the roots along the direction given by the seed of each input."""
    known: dict[Node, Node] = {}
    ruled: dict[tuple, list[Node]] = {}
    for node in order(roots):
        known[node] = _tangent(graph, node, known, seeds, ruled)
    return [known[root] for root in roots]


def _tangent(
    graph: Graph, node: Node, known: dict[Node, Node], seeds: Mapping[Node, Node], ruled: dict
) -> Node:
    moved = [known[arg] for arg in node.args]
    if node.op == "input":
        return seeds.get(node, graph.zero)
    if node.op in ("const", "stop") or all(d is graph.zero for d in moved):
        return graph.zero
    if node.op == "sum":
        coefficients = [c for _, c in node.data[1]]
        return graph.sum(zip(moved, coefficients, strict=True))
    if node.op == "product":
        return graph.sum(
            [
                (_by_factor(graph, node, i, d), 1.0)
                for i, d in enumerate(moved)
                if d is not graph.zero
            ]
        )
    if node.op == "select":
        return graph.select(node.args[0], moved[1], moved[2])
    if node.op == "let":
        return moved[0]
    if node.op == "custom":
        rule, index = node.data
        key = (rule, node.args)
        if key not in ruled:
            ruled[key] = _by_rule(graph, rule, node.args, moved)
        return ruled[key][index]
    pairs = zip(partials(graph, node), moved, strict=True)
    return graph.sum([(graph.mul(p, d), 1.0) for p, d in pairs if d is not graph.zero])


def gradient(graph: Graph, root: Node, inputs: Sequence[Node]) -> list[Node]:
    """Derivatives of one root with respect to inputs, by one reverse sweep."""
    wanted = set(inputs)
    nodes = order([root])
    active: set[Node] = set()
    for node in nodes:
        if node in wanted or (node.op != "stop" and any(arg in active for arg in node.args)):
            active.add(node)
    cotangents: dict[Node, list[tuple[Node, float]]] = {root: [(graph.one, 1.0)]}
    found: dict[Node, Node] = {}
    for node in reversed(nodes):
        if node not in cotangents or node not in active:
            continue
        total = found[node] = graph.sum(cotangents.pop(node))
        if total is graph.zero:
            continue
        for arg, term, coefficient in _cotangents(graph, node, total):
            if arg in active:
                cotangents.setdefault(arg, []).append((term, coefficient))
    return [found.get(node, graph.zero) for node in inputs]


def _cotangents(graph: Graph, node: Node, total: Node) -> list[tuple[Node, Node, float]]:
    """The cotangents of the arguments: (argument, node, coefficient)."""
    if node.op == "sum":
        return [(arg, total, c) for arg, c in node.data[1]]
    if node.op == "product":
        return [
            (base, _by_factor(graph, node, i, total), 1.0) for i, (base, _) in enumerate(node.data)
        ]
    if node.op == "select":
        condition, on_true, on_false = node.args
        return [
            (on_true, graph.select(condition, total, graph.zero), 1.0),
            (on_false, graph.select(condition, graph.zero, total), 1.0),
        ]
    if node.op == "let":
        return [(node.args[0], total, 1.0)]
    if node.op == "custom":
        rule, index = node.data
        out = []
        for i, arg in enumerate(node.args):
            unit = [graph.zero] * len(node.args)
            unit[i] = graph.one
            out.append((arg, graph.mul(_by_rule(graph, rule, node.args, unit)[index], total), 1.0))
        return out
    if node.op == "call":
        pairs = zip(node.args, partials(graph, node), strict=True)
        return [(arg, graph.mul(p, total), 1.0) for arg, p in pairs]
    return []


def _by_factor(graph: Graph, node: Node, i: int, other: Node) -> Node:
    """The derivative of a product with respect to its i-th factor, times another node.

    d(x / y) / dy is -(x / y) / y, not -x / y^2: the square may overflow.
    """
    base, exponent = node.data[i]
    if exponent < 0:
        return graph.product([(node, 1), (graph.div(other, base), 1)], float(exponent))
    lowered = [(base, e - (k == i)) for k, (base, e) in enumerate(node.data)]
    return graph.product([*lowered, (other, 1)], float(exponent))


def _by_rule(graph: Graph, rule: Rule, args: Sequence[Node], moved: Sequence[Node]) -> list[Node]:
    given = [*rule.unflat(args), *rule.unflat(moved)]
    results = read(graph, rule.tangents, *given)
    return [_node(graph, x) for array in results for x in array.ravel()]


def _node(graph: Graph, x: object) -> Node:
    return x if isinstance(x, Node) else graph.const(float(x))  # type: ignore[arg-type]


def _by_jax(graph: Graph, primitive: Primitive, args: Sequence[Node], i: int) -> Node:
    """Derivative of a primitive with respect to one argument, from its rule in JAX."""

    def along(*operands: jax.Array) -> jax.Array:
        def one(x: jax.Array) -> jax.Array:
            return primitive(*operands[:i], x, *operands[i + 1 :])

        return jax.jvp(one, (operands[i],), (jax.numpy.ones_like(operands[i]),))[1]

    like = jax.ShapeDtypeStruct((), jax.numpy.result_type(float))
    try:
        closed = jax.make_jaxpr(along)(*[like] * len(args))
    except Exception as error:
        raise Unsupported(f"derivative of {primitive.name}: {error}") from error
    operands = []
    for arg in args:
        array = np.empty((), object)
        array[()] = arg
        operands.append(array)
    (result,) = read(graph, closed, *operands)
    return _node(graph, result.item())


# ---- Derivatives known in closed form ----------------------------------------------------------


def _sqrt(graph: Graph, node: Node, x: Node) -> list[Node]:
    return [graph.product([(node, -1)], 0.5)]


def _pow(graph: Graph, node: Node, x: Node, y: Node) -> list[Node]:
    if y.constant is None:
        return [_by_jax(graph, node.data, node.args, i) for i in range(2)]
    lower = graph.call(node.data, x, graph.const(y.constant - 1.0))
    return [graph.scale(lower, y.constant), graph.zero]


def _atan2(graph: Graph, node: Node, y: Node, x: Node) -> list[Node]:
    square = graph.add(graph.power(x, 2), graph.power(y, 2))
    return [graph.div(x, square), graph.scale(graph.div(y, square), -1.0)]


def _extreme(graph: Graph, node: Node, *args: Node) -> list[Node]:
    """1/k for each of k equal arguments, as in JAX."""
    ties = [graph.is_extreme(arg, args, node.data) for arg in args]
    count = graph.add(*(graph.select(tie, graph.one, graph.zero) for tie in ties))
    share = graph.power(count, -1)
    return [graph.select(tie, share, graph.zero) for tie in ties]


_TABLE = {
    "sin": lambda g, node, x: [g.call(COS, x)],
    "cos": lambda g, node, x: [g.scale(g.call(SIN, x), -1.0)],
    "tan": lambda g, node, x: [g.sum([(g.power(node, 2), 1.0)], 1.0)],
    "exp": lambda g, node, x: [node],
    "log": lambda g, node, x: [g.power(x, -1)],
    "tanh": lambda g, node, x: [g.sum([(g.power(node, 2), -1.0)], 1.0)],
    "sqrt": _sqrt,
    "pow": _pow,
    "atan2": _atan2,
    "largest": _extreme,
    "smallest": _extreme,
}
