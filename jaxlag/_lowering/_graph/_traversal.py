"""Functions over all nodes below some roots of a graph."""

from collections.abc import Iterable, Sequence

from jaxlag._lowering._graph._expression import Graph, Node, order


def dependencies(roots: Iterable[Node]) -> dict[Node, frozenset[tuple[str, int]]]:
    """node -> its inputs, for every node under the roots."""
    known: dict[Node, frozenset[tuple[str, int]]] = {}
    for node in order(roots):
        if node.op == "input":
            known[node] = frozenset((node.data,))
        else:
            known[node] = frozenset().union(*(known[arg] for arg in node.args))
    return known


def rebuilt(graph: Graph, node: Node, args: list[Node], values: dict[Node, Node]) -> Node:
    """The node with new arguments."""
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


def substitute(graph: Graph, roots: Sequence[Node], values: dict[Node, Node]) -> list[Node]:
    """The roots with inputs replaced."""
    known: dict[Node, Node] = {}
    for node in order(roots):
        known[node] = rebuilt(graph, node, [known[arg] for arg in node.args], values)
    return [known[root] for root in roots]
