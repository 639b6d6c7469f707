"""Cofactor inverse of a small general matrix on the graph, such as dU/dv."""

from collections.abc import Sequence
from functools import partial, reduce

from jaxlag._lowering._graph._eliminate import GREATER
from jaxlag._lowering._graph._expression import Graph, Node
from jaxlag._lowering._graph._simplify import Expansion
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported
from jaxlag._lowering._symbolic._bias_forms import attempt

LARGEST = 4  # size of a block, solved by its cofactors
FLOOR = 64.0  # roundings of a determinant, over the lengths of the rows


class Inverse:
    """x = J^-1 r, with divisions by factors of det J alone.

    A row with one unknown gives it directly. A column with one row is solved for last. The rest
    forms blocks, solved by cofactors. No division is by an expression that may vanish for a regular
    J, as a fixed pivot in a matrix of sines and cosines could.

    Args:
        graph: of all nodes.
        expansion: of the same graph, to simplify cofactors.
        J: n rows.
        eps: of the numbers; 0 for no truth values.

    Attributes:
        healthy: truth values, all true if J is regular to working precision.
        determinants: of the blocks; their product is det J up to its sign.

    Raises:
        Unsupported: J is singular in every state, or couples more than LARGEST unknowns.
    """

    def __init__(
        self, graph: Graph, expansion: Expansion, J: Sequence[Sequence[Node]], eps: float
    ) -> None:
        self.graph, self.expansion, self.J, self.floor = graph, expansion, J, FLOOR * eps
        self.healthy: list[Node] = []
        self.determinants: list[Node] = []
        self._steps: list[tuple[list[int], list[int], list[list[Node]], Node]] = []
        n, zero = len(J), graph.zero
        rows, columns = set(range(n)), set(range(n))
        late = []
        while True:
            known = {i: [j for j in columns if J[i][j] is not zero] for i in rows}
            single = next((i for i in sorted(rows) if len(known[i]) == 1), None)
            if single is not None:
                (j,) = known[single]
                self._steps.append(self._block([single], [j]))
                rows.remove(single)
                columns.remove(j)
                continue
            found = {j: [i for i in rows if J[i][j] is not zero] for j in columns}
            alone = next((j for j in sorted(columns) if len(found[j]) == 1), None)
            if alone is None:
                break
            (i,) = found[alone]
            late.append(self._block([i], [alone]))
            rows.remove(i)
            columns.remove(alone)
        while rows:
            near, ahead = {min(rows)}, set[int]()
            while True:
                ahead = {j for j in columns if any(J[i][j] is not zero for i in near)}
                wider = {i for i in rows if any(J[i][j] is not zero for j in ahead)}
                if wider == near:
                    break
                near = wider
            if len(near) != len(ahead) or len(near) > LARGEST:
                raise Unsupported(f"kinematics that couple {len(near)} quasi-velocities")
            self._steps.append(self._block(sorted(near), sorted(ahead)))
            rows -= near
            columns -= ahead
        self._steps += reversed(late)

    def __call__(self, right: Sequence[Node]) -> list[Node]:
        """The x with J x = right."""
        graph, x = self.graph, dict[int, Node]()
        for rows, columns, adjugate, determinant in self._steps:
            rest = []
            for i in rows:
                known = [(graph.mul(self.J[i][j], x[j]), -1.0) for j in x]
                rest.append(graph.sum([(right[i], 1.0), *known]))
            for j, line in zip(columns, adjugate, strict=True):
                top = graph.sum([(graph.mul(a, r), 1.0) for a, r in zip(line, rest, strict=True)])
                x[j] = graph.div(top, determinant)
        return [x[j] for j in range(len(self.J))]

    def _block(
        self, rows: list[int], columns: list[int]
    ) -> tuple[list[int], list[int], list[list[Node]], Node]:
        graph = self.graph
        part = [[self.J[i][j] for j in columns] for i in rows]
        n = len(rows)
        if n == 1:
            adjugate, determinant = [[graph.one]], part[0][0]
        else:
            adjugate = [[self._cofactor(part, i, j) for i in range(n)] for j in range(n)]
            terms = [(graph.mul(part[0][j], adjugate[j][0]), 1.0) for j in range(n)]
            determinant = self._short(graph.sum(terms))
        if determinant is graph.zero:
            raise Unsupported("kinematics that are singular in every state")
        self.determinants.append(determinant)
        if determinant.constant is None and self.floor:
            lengths = [graph.sum([(graph.power(x, 2), 1.0) for x in self.J[i]]) for i in rows]
            bound = graph.scale(reduce(graph.mul, map(self._short, lengths)), self.floor**2)
            self.healthy.append(graph.call(GREATER, graph.power(determinant, 2), bound))
        return rows, columns, adjugate, determinant

    def _cofactor(self, part: list[list[Node]], i: int, j: int) -> Node:
        n = len(part)
        rows, columns = ([k for k in range(n) if k != gone] for gone in (i, j))
        minor = self._determinant(part, tuple(rows), tuple(columns))
        return self._short(self.graph.scale(minor, (-1.0) ** (i + j)))

    def _determinant(
        self, part: list[list[Node]], rows: tuple[int, ...], columns: tuple[int, ...]
    ) -> Node:
        if not rows:
            return self.graph.one
        first, *rest = rows
        terms = []
        for place, (j, others) in enumerate(
            (j, columns[:k] + columns[k + 1 :]) for k, j in enumerate(columns)
        ):
            entry = part[first][j]
            if entry is not self.graph.zero:
                minor = self._determinant(part, tuple(rest), others)
                terms.append((self.graph.mul(entry, minor), (-1.0) ** place))
        return self.graph.sum(terms)

    def _short(self, node: Node) -> Node:
        short = attempt(partial(self.expansion.simplified, [node]))
        return node if short is None else short[0]
