"""Straight-line code from a graph: one operation a line, shared expressions computed once.

Lines of `FIXED` inputs alone form the prelude, computed once per solve. The others form the body.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxlag._lowering._graph._common_pairs import Shared
from jaxlag._lowering._graph._expression import (
    FIXED,
    POWERS,
    SQRT,
    TRUTHS,
    Graph,
    Node,
    order,
    scaled,
)
from jaxlag._lowering._graph._traversal import rebuilt

ANALYTIC = frozenset(["sin", "cos", "tan", "exp", "log", "sqrt", "sinh", "cosh", "tanh", "atan"])
"""Functions that are analytic within the interior of their domains."""

_ARITHMETIC = frozenset(["add", "sub", "mul", "div", "neg"])


class Line(NamedTuple):
    """One operation: slot `to` = op(slots `args`)."""

    op: str
    to: int
    args: tuple[int, ...]
    data: Any


class Program(NamedTuple):
    """Straight-line code from inputs to results.

    Attributes:
        prelude: lines that depend on `FIXED` inputs alone.
        carried: slots of the prelude that the body reads.
        body: lines evaluated at every state.
        results: slots, or numbers, of the results.
        inputs: (name, index) -> slot of the inputs that are read.
        numbers: slot -> value of the constants.
        truths: slots of truth values.
        whole: slots that are raised to a high power as a whole.
    """

    prelude: tuple[Line, ...]
    carried: tuple[int, ...]
    body: tuple[Line, ...]
    results: tuple[int, ...]
    inputs: Mapping[tuple[str, int], int]
    numbers: Mapping[int, float | bool]
    truths: frozenset[int]
    whole: frozenset[int]

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    @property
    def has_rules(self) -> bool:
        """Whether it calls functions with derivative rules of their own."""
        return any(line.op == "custom" for line in (*self.prelude, *self.body))

    @property
    def is_analytic(self) -> bool:
        """Whether the body consists of arithmetic, powers and functions in `ANALYTIC`."""
        return all(
            line.op in _ARITHMETIC or (line.op == "call" and line.data.name in ANALYTIC | {"pow"})
            for line in self.body
        )

    @property
    def operations(self) -> int:
        """Operations of the body, each function call and division one."""
        return sum(line.op not in _FREE for line in self.body)

    @property
    def cost(self) -> float:
        """Cost of the body, in additions (measured: a division 5, a sine 15)."""
        return float(sum(_cost(line) for line in self.body))

    def count(self, *names: str) -> int:
        """Calls of the named functions, or lines of the named kinds, in the body."""
        return sum(_kind(line) in names for line in self.body)


DIVISION, RULE = 5.0, 30.0  # cost of a division, of a function with a rule of its own
_FREE = ("stop",)
_CHEAP = TRUTHS | {"abs", "max", "min", "largest", "sign", "smallest"}


def _kind(line: Line) -> str:
    return line.data.name if line.op == "call" else line.op


def _cost(line: Line) -> float:
    if line.op in _FREE:
        return 0.0
    if line.op == "div":
        return DIVISION
    if line.op == "custom":
        return RULE
    if line.op == "call" and line.data.name not in _CHEAP:
        return 5.0 if line.data.name == "sqrt" else 15.0
    return 1.0


def operations(node: Node) -> float:
    """Cost of one node in additions, without that of its operands; more than 0 but for a "let"."""
    if node.op == "sum":
        constant, terms = node.data
        lines = len(terms) - 1 + sum(abs(c) != 1.0 for _, c in terms) + (constant != 0.0)
        return float(max(lines, 1))
    if node.op == "product":
        over = sum(e for _, e in node.data if e > 0)
        under = -sum(e for _, e in node.data if e < 0)
        return max(over + under - 1.0, 0.0) + (DIVISION if under else 0.0)
    if node.op == "call":
        return _cost(Line("call", 0, (), node.data))
    return {"let": 0.0, "custom": RULE}.get(node.op, 1.0)


def assemble(graph: Graph, roots: Sequence[Node]) -> Program:
    """Straight-line code for the roots."""
    hoisted = _Hoist(graph)
    roots = [hoisted(root) for root in roots]
    return _Assembly(graph, roots).program()


def _open(node: Node) -> Node:
    while node.op == "let":
        (node,) = node.args
    return node


class _Hoist:
    """Rewrites sums and products so that their parts on params alone are one node each."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._done: dict[Node, Node] = {}

    def __call__(self, root: Node) -> Node:
        for node in order([root], self._done):
            self._done[node] = self._rewrite(node)
        return self._done[root]

    def _rewrite(self, node: Node) -> Node:
        graph, args = self.graph, [self._done[arg] for arg in node.args]
        if node.op in ("const", "input") or node.fixed:
            return node
        if node.op == "sum":
            constant, terms = node.data
            fixed, varying = [], []
            for arg, (_, c) in zip(args, terms, strict=True):
                (fixed if arg.fixed else varying).append((arg, c))
            if fixed:
                varying.append((graph.let(graph.sum(fixed, constant)), 1.0))
                constant = 0.0
            return graph.sum([self._term(x, c) for x, c in varying], constant)
        if node.op == "product":
            factors = [(arg, e) for arg, (_, e) in zip(args, node.data, strict=True)]
            return self._gathered(factors, 1.0)
        return rebuilt(graph, node, args, {})

    def _term(self, node: Node, coefficient: float) -> tuple[Node, float]:
        """A coefficient other than +-1 is moved into the known factor of its product."""
        inner = _open(node)
        if abs(coefficient) == 1.0 or inner.op != "product":
            return node, coefficient
        if not any(base.fixed for base, _ in inner.data):
            return node, coefficient
        sign = 1.0 if coefficient > 0 else -1.0
        return self._gathered(list(inner.data), abs(coefficient)), sign

    def _gathered(self, factors: list[tuple[Node, int]], coefficient: float) -> Node:
        graph = self.graph
        fixed = [(base, e) for base, e in factors if base.fixed]
        varying = [(base, e) for base, e in factors if not base.fixed]
        if not fixed:
            return graph.product(varying, coefficient)
        known = graph.product(fixed, coefficient)
        if known.op == "const":
            return graph.product(varying, known.data)
        return graph.product([*varying, (graph.let(known), 1)])


def _is_nonnegative(node: Node, depth: int = 8) -> bool:
    """Whether a node is a sum of squares, or of other numbers that are never negative."""
    node = _open(node)
    if depth == 0:
        return False
    if node.op == "const":
        return node.data >= 0
    if node.op == "sum":
        constant, terms = node.data
        return constant >= 0 and all(c >= 0 and _is_nonnegative(x, depth - 1) for x, c in terms)
    if node.op == "product":
        return all(e % 2 == 0 or _is_nonnegative(base, depth - 1) for base, e in node.data)
    return node.op == "call" and node.data.name in ("sqrt", "abs", "exp")


class _Assembly:
    """Chooses the shared pairs and writes the lines."""

    def __init__(self, graph: Graph, roots: Sequence[Node]) -> None:
        self.graph = graph
        self.roots = [_open(root) for root in roots]
        self.nodes = self._reachable(self.roots)
        self.slot: dict[Any, int] = {}
        self.lines: list[Line] = []
        self.known: list[bool] = []  # by slot: whether it depends on params alone
        self.inputs: dict[tuple[str, int], int] = {}
        self.numbers: dict[int, float | bool] = {}
        # Operands as lists of tokens: a token is a node, or a pair of tokens that is shared.
        self.sums: dict[Node, list[tuple[Any, float]]] = {}
        self.over: dict[Node, list[Any]] = {}
        self.under: dict[Node, list[Any]] = {}
        self.whole: set[Node] = set()
        self.inverse_roots: dict[Node, Node] = {}  # x -> sqrt(x), if 1 / sqrt(x) is shared

    @staticmethod
    def _reachable(roots: Iterable[Node]) -> list[Node]:
        found: set[Node] = set()
        stack = list(roots)
        while stack:
            node = _open(stack.pop())
            if node not in found:
                found.add(node)
                stack.extend(node.args)
        return sorted(found, key=lambda node: node.id)

    def program(self) -> Program:
        self._operands()
        shared = Shared(len(self.graph.nodes))
        self.sums = shared.sums(self.sums)
        shared.factors(self.over)
        shared.factors(self.under)
        results = tuple(self._at(root) for root in self.roots)
        prelude = tuple(line for line in self.lines if self.known[line.to])
        body = tuple(line for line in self.lines if not self.known[line.to])
        made = {line.to for line in prelude}
        made |= {slot for (name, _), slot in self.inputs.items() if name in FIXED}
        read = [slot for line in body for slot in line.args] + list(results)
        carried = tuple(sorted({slot for slot in read if slot in made}))
        whole = frozenset(self.slot[base] for base in self.whole if base in self.slot)
        slots = self.inputs, self.numbers, self._truths(), whole
        return Program(prelude, carried, body, results, *slots)

    def _truths(self) -> frozenset[int]:
        truths = {line.to for line in self.lines if getattr(line.data, "name", None) in TRUTHS}
        truths |= {slot for slot, value in self.numbers.items() if isinstance(value, bool)}
        for line in self.lines:
            if line.op == "select" and line.args[1] in truths:
                truths.add(line.to)
        return frozenset(truths)

    # ---- Operands ----------------------------------------------------------------------------

    def _operands(self) -> None:
        below: Counter[Node] = Counter()
        ends = set(self.roots)
        for node in self.nodes:
            if node.op == "product" and node not in ends:
                below.update(_open(base) for base, e in node.data if e < 0)
        for node in self.nodes:
            if node.op == "sum":
                self.sums[node] = [(_open(term), c) for term, c in node.data[1]]
            elif node.op == "product":
                over: list[Any] = []
                under: list[Any] = []
                for base, exponent in node.data:
                    base = _open(base)
                    if abs(exponent) > POWERS and scaled(base):
                        self.whole.add(base)
                    if exponent > 0:
                        over += [base] * exponent
                    elif below[base] > 1 and node not in ends:
                        over += [("inverse", base)] * -exponent
                        if base.op == "call" and base.data == SQRT:
                            self.inverse_roots[_open(base.args[0])] = base
                    else:
                        under += [base] * -exponent
                self.over[node], self.under[node] = over, under

    # ---- Lines -------------------------------------------------------------------------------

    def _emit(self, op: str, args: Sequence[int], data: Any = None) -> int:
        key = (op, tuple(args), data if op != "const" else (type(data), repr(data)))
        found = self.slot.get(key)
        if found is None:
            found = len(self.known)
            self.slot[key] = found
            fixed = data[0] in FIXED if op == "input" else all(self.known[a] for a in args)
            self.known.append(fixed)
            if op == "input":
                self.inputs[data] = found
            elif op == "const":
                self.numbers[found] = data
            else:
                self.lines.append(Line(op, found, tuple(args), data))
        return found

    def _at(self, token: Any) -> int:
        """The slot of a token; its lines are written at the first use."""
        stack = [token]
        while stack:
            top = stack[-1]
            if top in self.slot:
                stack.pop()
                continue
            missing = [t for t in self._needs(top) if t not in self.slot]
            if missing:
                stack.extend(missing)
            else:
                self.slot[top] = self._write(stack.pop())
        return self.slot[token]

    def _needs(self, token: Any) -> list[Any]:
        if isinstance(token, Node):
            if token.op == "sum":
                return [t for t, _ in self.sums[token]]
            if token.op == "product":
                return [*self.over[token], *self.under[token]]
            return [_open(arg) for arg in token.args]
        kind, *rest = token
        if kind != "inverse":
            return [rest[0], rest[1]]
        root = self._root(rest[0])
        return [rest[0]] if root is None else [("inverse", root)]

    def _root(self, base: Node) -> Node | None:
        """sqrt(base) if its inverse is shared: 1 / base is then the square of that.

        Divisions take longest: accelerations by inverse squares take 0.7 of the time. The square
        has the range of the quotient, infinity and 0 included. It is NaN for negative numbers,
        which the quotient need not be: the base must be a sum of squares.
        """
        root = self.inverse_roots.get(base)
        return root if root is not None and _is_nonnegative(base) else None

    def _write(self, token: Any) -> int:
        if not isinstance(token, Node):
            kind, *rest = token
            if kind == "inverse":
                root = self._root(rest[0])
                if root is None:
                    return self._emit("div", [self._number(1.0), self.slot[rest[0]]])
                return self._emit("mul", [self.slot["inverse", root]] * 2)
            x, y = self.slot[rest[0]], self.slot[rest[1]]
            if kind == "times":
                return self._emit("mul", sorted((x, y)))
            return self._combined([(x, 1.0), (y, rest[2])], 0.0)
        node = token
        if node.op == "const":
            return self._number(node.data)
        if node.op == "input":
            return self._emit("input", [], node.data)
        if node.op == "sum":
            terms = [(self.slot[t], c) for t, c in self.sums[node]]
            return self._combined(terms, node.data[0])
        if node.op == "product":
            over = self._multiplied([self.slot[t] for t in self.over[node]])
            under = self._multiplied([self.slot[t] for t in self.under[node]])
            if under is None:
                assert over is not None
                return over
            return self._emit("div", [self._number(1.0) if over is None else over, under])
        args = [self.slot[_open(arg)] for arg in node.args]
        return self._emit(node.op, args, node.data)

    def _number(self, value: float | bool) -> int:
        return self._emit("const", [], value)

    def _multiplied(self, slots: list[int]) -> int | None:
        """Known factors first, then pairwise."""
        if not slots:
            return None
        slots = sorted(slots, key=lambda s: (not self.known[s], s))
        out = slots[0]
        for slot in slots[1:]:
            out = self._emit("mul", [out, slot])
        return out

    def _combined(self, terms: list[tuple[int, float]], constant: float) -> int:
        """Sum of coefficient times slot; terms of one coefficient share its multiplication."""
        by_size: dict[float, list[tuple[int, bool]]] = defaultdict(list)
        for slot, c in terms:
            by_size[abs(c)].append((slot, c < 0))
        parts: list[tuple[int, bool]] = []
        for size, group in sorted(by_size.items()):
            if size == 1.0:
                parts += group
                continue
            negative = all(minus for _, minus in group)
            inner = self._signed([(s, minus != negative) for s, minus in group])
            parts.append((self._emit("mul", [self._number(size), inner]), negative))
        if constant != 0.0:
            parts.append((self._number(abs(constant)), constant < 0))
        return self._signed(parts)

    def _signed(self, parts: list[tuple[int, bool]]) -> int:
        plus = [s for s, minus in parts if not minus]
        less = [s for s, minus in parts if minus]
        if not plus:
            return self._emit("neg", [self._signed([(s, False) for s in less])])
        out = plus[0]
        for slot in plus[1:]:
            out = self._emit("add", [out, slot])
        for slot in less:
            out = self._emit("sub", [out, slot])
        return out
