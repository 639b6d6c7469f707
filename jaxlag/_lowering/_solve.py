"""M a = r on the graph: blocks apart, elimination along the pattern of nonzeros."""

from collections.abc import Sequence

import numpy as np

from jaxlag._lowering._graph import Graph, Node, named

GREATER = named("gt")


def blocks(M: Sequence[Sequence[Node]], zero: Node) -> list[list[int]]:
    """Coordinates that inertia couples: connected by nonzero entries of M."""
    n = len(M)
    left, found = set(range(n)), []
    while left:
        stack, block = [min(left)], set()
        while stack:
            i = stack.pop()
            if i not in block:
                block.add(i)
                stack.extend(j for j in left if M[i][j] is not zero)
        left -= block
        found.append(sorted(block))
    return found


def least_operations(pattern: Sequence[Sequence[bool]]) -> int:
    """Multiplications and subtractions of an elimination along a pattern, fill included."""
    n, total = len(pattern), 0
    near = {i: {j for j in range(n) if pattern[i][j] and j != i} for i in range(n)}
    while near:
        k = min(near, key=lambda i: len(near[i]))
        row = near.pop(k)
        for i in row:
            near[i] |= row - {i}
            near[i].discard(k)
        total += len(row) * (len(row) + 1) + 4 * len(row)
    return total


def solve(graph: Graph, M: Sequence[Sequence[Node]], r: Sequence[Node], eps: float) -> list[Node]:
    """The a with M a = r, each ending in a division; NaN where M is not positive definite.

    L D L^T (Golub, Van Loan, Matrix Computations, sec. 4.1) of every block in order of least
    coupling, the last two unknowns by Cramer's rule. A pivot must exceed 4 n eps M_ii, as in
    `jaxlag._linalg.factor_mass`.
    """
    out: list[Node] = [graph.zero] * len(M)
    for block in blocks(M, graph.zero):
        for i, x in zip(block, _Elimination(graph, M, r, block, eps).solve(), strict=True):
            out[i] = x
    return out


class _Elimination:
    def __init__(
        self,
        graph: Graph,
        M: Sequence[Sequence[Node]],
        r: Sequence[Node],
        block: list[int],
        eps: float,
    ) -> None:
        self.graph, self.block = graph, block
        self.floor = 4 * len(M) * eps
        self.entry = {(i, j): graph.let(M[i][j]) for i in block for j in block}
        self.right = {i: graph.let(r[i]) for i in block}
        self.diagonal = {i: self.entry[i, i] for i in block}
        self.touched: set[int] = set()

    def solve(self) -> list[Node]:
        graph, left = self.graph, list(self.block)
        steps = []
        while len(left) > 2:
            k = min(left, key=lambda i: (self._coupling(i, left), i))
            left.remove(k)
            steps.append((k, self._eliminate(k, left), self._pivot(k)))
        found: dict[int, Node] = {}
        if len(left) == 1:
            (i,) = left
            found[i] = graph.div(self.right[i], self._pivot(i))
        else:
            self._cramer(left[0], left[1], found)
        for k, row, pivot in reversed(steps):
            known = [(graph.mul(c, found[j]), -1.0) for j, c in row.items()]
            found[k] = graph.div(graph.let(graph.sum([(self.right[k], 1.0), *known])), pivot)
            found[k] = graph.let(found[k])
        return [found[i] for i in self.block]

    def _coupling(self, i: int, left: list[int]) -> int:
        return sum(self.entry[i, j] is not self.graph.zero for j in left)

    def _pivot(self, i: int) -> Node:
        """D_i, NaN where it is not positive to working precision."""
        graph, pivot = self.graph, self.entry[i, i]
        healthy = graph.call(GREATER, pivot, self._bound(i))
        return graph.let(graph.select(healthy, pivot, graph.const(np.nan)))

    def _bound(self, i: int) -> Node:
        """What cancellation may leave of a pivot that is zero; nothing was taken off the first."""
        graph = self.graph
        return graph.scale(self.diagonal[i], self.floor) if i in self.touched else graph.zero

    def _eliminate(self, k: int, left: list[int]) -> dict[int, Node]:
        graph, pivot = self.graph, self._pivot(k)
        row = {j: self.entry[k, j] for j in left if self.entry[k, j] is not graph.zero}
        for i, c in row.items():
            ratio = graph.let(graph.div(c, pivot))
            for j, d in row.items():
                if j >= i:
                    reduced = graph.sub(self.entry[i, j], graph.mul(ratio, d))
                    self.entry[i, j] = self.entry[j, i] = graph.let(reduced)
            reduced = graph.sub(self.right[i], graph.mul(ratio, self.right[k]))
            self.right[i] = graph.let(reduced)
            self.touched.add(i)
        return row

    def _cramer(self, i: int, j: int, found: dict[int, Node]) -> None:
        graph = self.graph
        a, b, c = self._pivot(i), self.entry[i, j], self.entry[j, j]
        determinant = graph.let(graph.sub(graph.mul(a, c), graph.power(b, 2)))
        # Rounding left its share of M_ii in a and of M_jj in c.
        shares = graph.add(graph.mul(a, self.diagonal[j]), graph.mul(c, self.diagonal[i]))
        bound = graph.scale(shares, self.floor)
        healthy = graph.call(GREATER, determinant, bound)
        determinant = graph.let(graph.select(healthy, determinant, graph.const(np.nan)))
        r, s = self.right[i], self.right[j]
        first = graph.sub(graph.mul(c, r), graph.mul(b, s))
        second = graph.sub(graph.mul(a, s), graph.mul(b, r))
        found[i] = graph.let(graph.div(graph.let(first), determinant))
        found[j] = graph.let(graph.div(graph.let(second), determinant))
