"""Numbers of a declaration as parameters while its equations are derived.

Products and sums of numbers such as 0.1 are rounded, and then expressions that are equal by
algebra differ. Such numbers stand as inputs until the equations are known; small multiples of
powers of two remain.
"""

from collections.abc import Sequence
from math import frexp, isfinite

from jaxlag._lowering._graph._expression import Graph, Node, order
from jaxlag._lowering._graph._traversal import rebuilt, substitute

NAME = "literal"
BITS = 12  # of a number whose products with a few others are exact


class Literals:
    """The numbers of one graph that have been replaced by inputs."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._inputs: dict[float, Node] = {}

    def without(self, roots: Sequence[Node]) -> list[Node]:
        """The roots with inputs in place of the coefficients of their sums."""
        done: dict[Node, Node] = {}
        for node in order(roots):
            args = [done[arg] for arg in node.args]
            if node.op != "sum":
                done[node] = rebuilt(self.graph, node, args, {})
                continue
            constant, terms = node.data
            scaled = [self._times(arg, c) for arg, (_, c) in zip(args, terms, strict=True)]
            if constant:
                scaled.append(self._times(self.graph.one, constant))
            done[node] = self.graph.sum(scaled)
        return [done[root] for root in roots]

    def restored(self, roots: Sequence[Node]) -> list[Node]:
        """The roots with the numbers."""
        values = {node: self.graph.const(x) for x, node in self._inputs.items()}
        return substitute(self.graph, roots, values) if values else list(roots)

    def _times(self, node: Node, c: float) -> tuple[Node, float]:
        """A node and its coefficient, the number as a factor of the node."""
        if not isfinite(c) or (frexp(c)[0] * 2.0**BITS).is_integer():
            return node, c
        sign, size = (1.0, c) if c > 0 else (-1.0, -c)
        if size not in self._inputs:
            self._inputs[size] = self.graph.input(NAME, len(self._inputs))
        return self.graph.mul(self._inputs[size], node), sign
