"""Gaussian elimination of M a = r on the graph, by independent blocks and the nonzero pattern."""

from collections.abc import Sequence

import numpy as np

from jaxlag._lowering._graph._expression import Graph, Node, named

DOUBLE = 1e-12  # larger than eps of double precision, smaller than that of single precision
GREATER = named("gt")
NO_LESS = named("ge")
_ABS = named("abs")


def blocks(M: Sequence[Sequence[Node]], zero: Node) -> list[list[int]]:
    """Groups of coordinates coupled by nonzero entries of M."""
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
    """Multiplications and subtractions of an elimination with a nonzero pattern, with fill-in."""
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
    """The a with M a = r, each ending in a division; NaN if M is not positive definite.

    L D L^T (Golub, Van Loan, Matrix Computations, sec. 4.1) of every block in order of least
    coupling; in double precision the last two unknowns by Cramer's rule. A pivot must exceed
    4 n eps M_ii, as in `_mass_solve.factor_mass`, even if it divides nothing.
    """
    return bordered(graph, M, [], [(r, [])], eps, checked=True)[0]


def bordered(
    graph: Graph,
    M: Sequence[Sequence[Node]],
    A: Sequence[Sequence[Node]],
    right: Sequence[tuple[Sequence[Node], Sequence[Node]]],
    eps: float,
    active_rows: Sequence[Node] | None = None,
    checked: bool = False,
    crossing: bool = False,
) -> list[list[Node]]:
    """For each right-hand side (r, c) the x with M x = r + A^T lam, A x + c = 0.

    The same elimination of [M, A^T; A, 0] with the unknowns (x, -lam), whose pivots are positive
    for coordinates and negative for rows: a row comes after its coordinates. Its
    pivot must exceed eps^(2/3) times its value after the elimination of the coordinates alone, as
    in `_kkt.factor_kkt`.

    Args:
        graph: of all nodes.
        M: symmetric.
        A: rows.
        right: right-hand sides.
        eps: of the numbers.
        active_rows: for every row 1, or 0 if it is left out; None for all 1.
        checked: whether an x that is 0 for every M, as it has no load, is also NaN if
            a pivot of coordinates is too small.
        crossing: whether a row whose pivot is too small is left out; otherwise x is NaN. With it
            -lam follows x in the results.
    """
    n, m = len(M), len(A)
    whole = [[*M[i], *(row[i] for row in A)] for i in range(n)]
    whole += [[*row, *([graph.zero] * m)] for row in A]
    sides = [[*r, *(graph.scale(x, -1.0) for x in c)] for r, c in right]
    out: list[list[Node]] = [[graph.zero] * (n + m) for _ in right]
    for block in blocks(whole, graph.zero):
        elimination = _Elimination(graph, whole, sides, block, n, eps, active_rows, crossing)
        found = elimination.solve()
        if checked:
            found = [[elimination.checked(x) for x in values] for values in found]
        for i, values in zip(block, found, strict=True):
            for side, x in zip(out, values, strict=True):
                side[i] = x
    return out if crossing else [side[:n] for side in out]


def solve_general(
    graph: Graph, S: Sequence[Sequence[Node]], right: Sequence[Node], relative: float
) -> list[Node]:
    """The x with S x = right, as `_kkt.solve_general`; NaN if a pivot is too small."""
    m, zero = len(S), graph.zero
    lines = [[*row, side] for row, side in zip(S, right, strict=True)]
    for k in range(m):
        # The first pivot has had no subtraction.
        least = graph.scale(graph.call(_ABS, S[k][k]), relative) if k else zero
        fine = graph.call(GREATER, lines[k][k], least)
        lines[k][k] = graph.let(graph.select(fine, lines[k][k], graph.const(np.nan)))
        for i in range(k + 1, m):
            if lines[i][k] is zero:
                continue
            ratio = graph.let(graph.div(lines[i][k], lines[k][k]))
            for j in range(k + 1, m + 1):
                taken = graph.mul(ratio, lines[k][j])
                lines[i][j] = graph.let(graph.sub(lines[i][j], taken))
    x: list[Node] = [zero] * m
    for k in reversed(range(m)):
        known = [(graph.mul(lines[k][j], x[j]), -1.0) for j in range(k + 1, m)]
        x[k] = graph.let(graph.div(graph.sum([(lines[k][m], 1.0), *known]), lines[k][k]))
    return x


class _Elimination:
    """Elimination of one block; unknowns from `coordinates` on are constraint rows."""

    def __init__(
        self,
        graph: Graph,
        matrix: Sequence[Sequence[Node]],
        right: Sequence[Sequence[Node]],
        block: list[int],
        coordinates: int,
        eps: float,
        active_rows: Sequence[Node] | None,
        crossing: bool,
    ) -> None:
        self.graph, self.block, self.coordinates = graph, block, coordinates
        self.active_rows, self.crossing = active_rows, crossing
        self.floor, self.row_floor = 4 * coordinates * eps, eps ** (2 / 3)
        # Products of two entries of M overflow single precision in usual units.
        self.cramer = eps < DOUBLE
        self.entry = {(i, j): graph.let(matrix[i][j]) for i in block for j in block}
        self.coupled = {i: {j for j in block if self._present(i, j)} for i in block}
        self.right = {i: [graph.let(side[i]) for side in right] for i in block}
        self.diagonal = {i: self.entry[i, i] for i in block}
        self.touched: set[int] = set()
        self.sound: dict[int, Node] = {}  # truth values, by coordinate
        zero = graph.zero
        self.contains = {
            i: {j for j in block if j < coordinates and matrix[i][j] is not zero}
            for i in block
            if i >= coordinates
        }

    def solve(self) -> list[list[Node]]:
        graph, left = self.graph, list(self.block)
        steps = []
        rows = bool(self.contains)
        while len(left) > (2 if self.cramer and not rows else 1):
            k = min(self._ready(left), key=lambda i: (len(self.coupled[i]), i))
            left.remove(k)
            steps.append((k, self._eliminate(k), self._pivot(k)))
        found: dict[int, list[Node]] = {}
        if len(left) == 1:
            (i,) = left
            found[i] = self._over(self.right[i], self._pivot(i))
        else:
            self._cramer(left[0], left[1], found)
        for k, row, pivot in reversed(steps):
            values = []
            for s, right in enumerate(self.right[k]):
                known = [(graph.mul(c, found[j][s]), -1.0) for j, c in row.items()]
                values.append(graph.let(graph.sum([(right, 1.0), *known])))
            found[k] = self._over(values, pivot)
        return [found[i] for i in self.block]

    def checked(self, x: Node) -> Node:
        """A solution that is zero without a division; NaN if M is not positive definite."""
        if x is self.graph.zero:
            for healthy in self.sound.values():
                x = self.graph.select(healthy, x, self.graph.const(np.nan))
        return x

    def _over(self, values: Sequence[Node], pivot: Node) -> list[Node]:
        graph = self.graph
        return [x if x is graph.zero else graph.let(graph.div(x, pivot)) for x in values]

    def _ready(self, left: list[int]) -> list[int]:
        """Coordinates, and rows whose coordinates are all eliminated."""
        remaining = set(left)
        return [i for i in left if remaining.isdisjoint(self.contains.get(i, ()))]

    def _present(self, i: int, j: int) -> bool:
        return self.entry[i, j] is not self.graph.zero

    def _pivot(self, i: int) -> Node:
        """D_i; NaN if it does not have its sign to working precision."""
        graph, pivot = self.graph, self.entry[i, i]
        nan = graph.const(np.nan)
        if i < self.coordinates:
            healthy = self.sound[i] = graph.call(GREATER, pivot, self._bound(i))
            return graph.let(graph.select(healthy, pivot, nan))
        bound, left_out = graph.scale(self.diagonal[i], self.row_floor), graph.const(-np.inf)
        if self.crossing:
            dependent = graph.call(NO_LESS, pivot, bound)
            pivot = graph.let(graph.select(dependent, left_out, pivot))
        else:
            pivot = graph.let(graph.select(graph.call(GREATER, bound, pivot), pivot, nan))
        if self.active_rows is None:
            return pivot
        active = graph.call(GREATER, self.active_rows[i - self.coordinates], graph.const(0.5))
        return graph.let(graph.select(active, pivot, left_out))

    def _bound(self, i: int) -> Node:
        """Bound on the rounding of a pivot that is zero; 0 for pivots without subtraction."""
        graph = self.graph
        return graph.scale(self.diagonal[i], self.floor) if i in self.touched else graph.zero

    def _eliminate(self, k: int) -> dict[int, Node]:
        graph, pivot = self.graph, self._pivot(k)
        near = sorted(self.coupled.pop(k) - {k})
        for others in self.coupled.values():  # rounding may leave an entry on one side alone
            others.discard(k)
        row = {j: self.entry[k, j] for j in near}
        for i, c in row.items():
            ratio = graph.let(graph.div(c, pivot))
            for j, d in row.items():
                if j >= i:
                    taken = graph.mul(ratio, d)
                    reduced = graph.let(graph.sub(self.entry[i, j], taken))
                    self.entry[i, j] = self.entry[j, i] = reduced
                    for one, other in ((i, j), (j, i)):
                        if self._present(i, j):
                            self.coupled[one].add(other)
                        else:
                            self.coupled[one].discard(other)
                    if i == j and i >= self.coordinates > k:
                        # The pivot of a row from the coordinates alone, before other rows.
                        self.diagonal[i] = graph.sub(self.diagonal[i], taken)
            for s, right in enumerate(self.right[k]):
                if right is not graph.zero:
                    reduced = graph.sub(self.right[i][s], graph.mul(ratio, right))
                    self.right[i][s] = graph.let(reduced)
            self.touched.add(i)
        return row

    def _cramer(self, i: int, j: int, found: dict[int, list[Node]]) -> None:
        graph = self.graph
        a, b, c = self._pivot(i), self.entry[i, j], self.entry[j, j]
        determinant = graph.let(graph.sub(graph.mul(a, c), graph.power(b, 2)))
        # a has rounding in proportion to M_ii, and c to M_jj.
        shares = graph.add(graph.mul(a, self.diagonal[j]), graph.mul(c, self.diagonal[i]))
        bound = graph.scale(shares, self.floor)
        healthy = self.sound[j] = graph.call(GREATER, determinant, bound)
        determinant = graph.let(graph.select(healthy, determinant, graph.const(np.nan)))
        found[i], found[j] = [], []
        for r, s in zip(self.right[i], self.right[j], strict=True):
            first = graph.sub(graph.mul(c, r), graph.mul(b, s))
            second = graph.sub(graph.mul(a, s), graph.mul(b, r))
            found[i].append(graph.let(graph.div(graph.let(first), determinant)))
            found[j].append(graph.let(graph.div(graph.let(second), determinant)))
