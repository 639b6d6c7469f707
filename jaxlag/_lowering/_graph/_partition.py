"""Partition of expressions into values known beforehand and what follows from them."""

from collections.abc import Sequence

from jaxlag._lowering._graph._expression import KNOWN, Graph, Node, order
from jaxlag._lowering._graph._traversal import rebuilt


def partitioned(
    graph: Graph, roots: Sequence[Node], late: Sequence[Node], values: list[Node]
) -> list[Node]:
    """The roots as functions of the late inputs and of values that do not depend on them.

    The i-th value is the input (`KNOWN`, i) of the results. None of them may be a truth value.

    Args:
        graph: of all nodes.
        roots: expressions.
        late: inputs that are known later than the others.
        values: receives the values, after those of other roots.
    """
    inputs, after = set(late), set(late)
    nodes = order(roots)
    for node in nodes:
        if any(arg in after for arg in node.args):
            after.add(node)
    found: dict[Node, Node] = {}

    def part(node: Node) -> Node:
        if node not in found:
            constant = node.constant is not None
            found[node] = node if constant else graph.input(KNOWN, len(values))
            if not constant:
                values.append(node)
        return found[node]

    for node in nodes:
        if node in after:
            args = [part(arg) for arg in node.args]
            found[node] = node if node in inputs else rebuilt(graph, node, args, {})
    return [part(root) for root in roots]
