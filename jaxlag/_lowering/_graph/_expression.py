"""Scalar expressions as a hash-consed graph (CSE): equal expressions are one node.

Sums are n-ary with number coefficients, products n-ary with integer exponents; both are kept in
a normal form, so that like terms merge and cancel and structural zeros never exist. All other
operations are calls of a JAX primitive on scalars, identified by its name.

The normal form uses rules of real algebra that floating point does not satisfy: 0 x = 0 and
x / x = 1 for every x, inf and NaN included, and sqrt(x)^2 = x. sqrt(x^2) is not simplified.
"""

from collections.abc import Container, Iterable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import numpy as np

from jaxlag._core._max_min import largest_p, smallest_p

Terms = tuple[tuple["Node", float], ...]
Factors = tuple[tuple["Node", int], ...]


KNOWN = "known"
FIXED = ("params", "literal", "active_rows", "nonzero", "time_direction", KNOWN)
"""Names of the inputs that are known before the others. During a solve these do not change:
parameters, numbers of the declaration, the rows used in solves, the rows that are more than
rounding, and the direction of time (+1 or -1). `KNOWN` are results of another program at the same
state."""


POWERS = 2
"""A product with numbers or parameters is raised to higher powers as a whole: (q / a)^32 does not
overflow where q^32 / a^32 does."""


CANCELLED = 1e-9
"""A sum of two numbers that is so much smaller than both may be their rounding."""


class Node:
    """One scalar of a graph.

    Attributes:
        op: "const", "input", "sum", "product", "call", "select", "custom", "stop" or "let".
        data: const: its value. input: (name, index). sum: (constant, terms). product: factors.
            call: (primitive, its parameters). custom: (Rule, index of the result). Others: None.
        args: the nodes of its arguments, factors and terms included.
        id: its place in an order in which arguments come first.
        fixed: whether all its inputs are constant during a solve.
    """

    __slots__ = ("args", "data", "fixed", "id", "op")

    def __init__(self, op: str, data: Any, args: tuple["Node", ...], id: int) -> None:
        self.op, self.data, self.args, self.id = op, data, args, id
        self.fixed: bool = data[0] in FIXED if op == "input" else all(a.fixed for a in args)

    def __repr__(self) -> str:
        return f"<{self.op} {self.id}>"

    @property
    def constant(self) -> float | None:
        """Its value if it is a number."""
        number = self.op == "const" and not isinstance(self.data, bool)
        return self.data if number else None


class Primitive:
    """A JAX primitive with its parameters, hashable by both."""

    __slots__ = ("key", "params", "primitive")

    def __init__(self, primitive: Any, params: dict[str, Any]) -> None:
        self.primitive, self.params = primitive, params
        self.key = (primitive.name, tuple(sorted((k, repr(v)) for k, v in params.items())))

    @property
    def name(self) -> str:
        return self.primitive.name

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Primitive) and self.key == other.key

    def __call__(self, *args: Any) -> Any:
        return self.primitive.bind(*args, **self.params)


def named(name: str, **params: Any) -> Primitive:
    """A primitive of jax.lax by its name."""
    return Primitive(getattr(jax.lax, f"{name}_p"), params)


_ACCURACY = {"accuracy": None}
SQRT, SIN, COS = (named(name, **_ACCURACY) for name in ("sqrt", "sin", "cos"))
ODD = {"sin", "tan", "asin", "atan", "sinh", "tanh", "asinh", "atanh", "erf", "cbrt"}
EVEN = {"cos", "cosh", "abs"}
TRUTHS = frozenset({"eq", "ne", "lt", "le", "gt", "ge", "and", "or", "not", "xor", "is_finite"})
CONSTANT_PIECES = TRUTHS | {"floor", "ceil", "round", "sign"}
_AND = named("and")
_ORDER = {"max": "ge", "min": "le", "largest": "ge", "smallest": "le"}
LARGEST, SMALLEST = Primitive(largest_p, {}), Primitive(smallest_p, {})


class Graph:
    """Builds nodes; all nodes of an expression belong to one graph.

    Attributes:
        nodes: all of them, arguments first.
        once: names of JAX primitives whose results become atoms when a program is read.
        flat: whether a product of products is one product; else its factors stay as they are, and
            nothing overflows or underflows that does not in their order.
        cancelled: whether coefficients have cancelled up to what may be their rounding, since this
            was last set to False.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.cancelled = False
        self.once: Container[str] = ()
        self.flat = True
        self._known: dict[Any, Node] = {}
        self.zero, self.one = self.const(0.0), self.const(1.0)

    def copy(self) -> "Graph":
        """A graph with the same nodes, to which others are added independently."""
        other = Graph()
        other.nodes, other._known = list(self.nodes), dict(self._known)
        other.zero, other.one = self.zero, self.one
        other.once, other.flat = self.once, self.flat
        return other

    def _node(self, op: str, data: Any, args: tuple[Node, ...]) -> Node:
        # A Python number equals a node's id and True equals 1.0: the op keeps them apart.
        kind = type(data) if op == "const" else None
        key = (op, kind, data, tuple(arg.id for arg in args))
        if op == "const" and isinstance(data, float):
            key = (op, kind, data.hex())  # tells -0 from 0 and finds nan
        found = self._known.get(key)
        if found is None:
            found = Node(op, data, args, len(self.nodes))
            self.nodes.append(found)
            self._known[key] = found
        return found

    # ---- Leaves ------------------------------------------------------------------------------

    def const(self, value: float | bool) -> Node:
        """A number, or a truth value."""
        plain = bool(value) if isinstance(value, bool | np.bool_) else float(value)
        return self._node("const", 0.0 if plain == 0.0 and plain is not False else plain, ())

    def input(self, name: str, index: int) -> Node:
        """Element `index` of the flat array `name`."""
        return self._node("input", (name, index), ())

    # ---- Algebra -----------------------------------------------------------------------------

    def sum(self, terms: Iterable[tuple[Node, float]], constant: float = 0.0) -> Node:
        """constant + sum of coefficient times node."""
        total: dict[Node, float] = {}
        for node, coefficient in terms:
            constant = self._plus(constant, self._collect(total, node, coefficient))
        remaining = [(node, c) for node, c in total.items() if c != 0.0]
        # A sum inside a sum is opened only if that merges terms: it may be shared.
        for node, c in remaining:
            if node.op == "sum" and _merges(node, constant, total):
                del total[node]
                inner_constant, inner = node.data
                constant = self._plus(constant, c * inner_constant)
                for term, coefficient in inner:
                    more = self._collect(total, term, c * coefficient)
                    constant = self._plus(constant, more)
                return self.sum(total.items(), constant)
        if not remaining:
            return self.const(constant)
        if len(remaining) == 1 and constant == 0.0:
            ((node, c),) = remaining
            if node.op == "sum" and c < 0:  # -(a - b) = b - a
                inner_constant, inner = node.data
                remaining = [(self._sum(-inner_constant, tuple((n, -x) for n, x in inner)), -c)]
            if remaining[0][1] == 1.0:
                return remaining[0][0]
        remaining.sort(key=_by_id)
        return self._sum(constant, tuple(remaining))

    def _collect(self, total: dict[Node, float], node: Node, coefficient: float) -> float:
        """Add coefficient times node to `total`; returns the constant part."""
        if coefficient == 0.0:
            return 0.0
        if node.op == "const":
            return coefficient * float(node.data)
        constant = 0.0
        if node.op == "sum" and len(node.data[1]) == 1:
            inner_constant, ((node, inner),) = node.data
            constant, coefficient = coefficient * inner_constant, coefficient * inner
        before = total.get(node)
        total[node] = coefficient if before is None else self._plus(before, coefficient)
        return constant

    def _plus(self, a: float, b: float) -> float:
        total = a + b
        if 0.0 < abs(total) < CANCELLED * max(abs(a), abs(b)):
            self.cancelled = True
        return total

    def _sum(self, constant: float, terms: Terms) -> Node:
        key = ("sum", constant, tuple((node.id, c) for node, c in terms))
        found = self._known.get(key)
        if found is None:
            found = Node("sum", (constant, terms), tuple(n for n, _ in terms), len(self.nodes))
            self.nodes.append(found)
            self._known[key] = found
        return found

    def add(self, *nodes: Node) -> Node:
        """Sum of nodes."""
        return self.sum([(node, 1.0) for node in nodes])

    def sub(self, a: Node, b: Node) -> Node:
        """Difference a - b."""
        return self.sum([(a, 1.0), (b, -1.0)])

    def scale(self, node: Node, factor: float) -> Node:
        """A number times a node."""
        return self.sum([(node, factor)])

    def product(self, factors: Iterable[tuple[Node, int]], coefficient: float = 1.0) -> Node:
        """coefficient times the product of powers."""
        powers: dict[Node, int] = {}
        for node, exponent in factors:
            coefficient *= self._multiply(powers, node, exponent)
        # At most one root remains of sqrt(x)^k.
        for node in [node for node in powers if node.op == "call" and node.data == SQRT]:
            whole = int(powers[node] / 2)
            if whole:
                powers[node] -= 2 * whole
                coefficient *= self._multiply(powers, node.args[0], whole)
        remaining = [(node, exponent) for node, exponent in powers.items() if exponent != 0]
        if coefficient == 0.0:
            return self.zero
        if not remaining:
            return self.const(coefficient)
        remaining.sort(key=_by_id)
        if len(remaining) == 1 and remaining[0][1] == 1:
            return self.scale(remaining[0][0], coefficient)
        node = self._product(tuple(remaining))
        return node if coefficient == 1.0 else self.sum([(node, coefficient)])

    def _product(self, factors: Factors) -> Node:
        key = ("product", tuple((node.id, e) for node, e in factors))
        found = self._known.get(key)
        if found is None:
            found = Node("product", factors, tuple(n for n, _ in factors), len(self.nodes))
            self.nodes.append(found)
            self._known[key] = found
        return found

    def _multiply(self, powers: dict[Node, int], node: Node, exponent: int) -> float:
        """Multiply node^exponent into `powers`; returns the numeric factor."""
        if exponent == 0:
            return 1.0
        if node.op == "const":
            return _power(float(node.data), exponent)
        if abs(exponent) > POWERS and scaled(node):
            powers[node] = powers.get(node, 0) + exponent
            return 1.0
        if node.op == "product" and self.flat:
            for base, inner in node.data:
                powers[base] = powers.get(base, 0) + inner * exponent
            return 1.0
        if node.op == "sum":
            # A factor of common size is extracted, with the sign of the first term.
            constant, terms = node.data
            size = terms[0][1]
            shared = all(abs(c) == abs(size) for _, c in terms)
            if size != 1.0 and shared and abs(constant) in (0.0, abs(size)):
                rest = self.sum([(n, c / size) for n, c in terms], constant / size)
                return _power(size, exponent) * self._multiply(powers, rest, exponent)
        powers[node] = powers.get(node, 0) + exponent
        return 1.0

    def mul(self, *nodes: Node) -> Node:
        """Product of nodes."""
        return self.product([(node, 1) for node in nodes])

    def div(self, a: Node, b: Node) -> Node:
        """Quotient a / b."""
        return self.product([(a, 1), (b, -1)])

    def power(self, node: Node, exponent: int) -> Node:
        """Integer power."""
        return self.product([(node, exponent)])

    # ---- Everything else ---------------------------------------------------------------------

    def call(self, primitive: Primitive, *args: Node) -> Node:
        """An elementwise primitive."""
        if all(arg.op == "const" for arg in args):
            with jax.ensure_compile_time_eval():
                return self.const(np.asarray(primitive(*(arg.data for arg in args))).item())
        name = primitive.name
        if len(args) == 1 and (name in ODD or name in EVEN) and _negative(args[0]):
            positive = self.call(primitive, self.scale(args[0], -1.0))
            return positive if name in EVEN else self.scale(positive, -1.0)
        if len(args) == 2 and name == "eq":
            a, b = args
            for one, other in ((a, b), (b, a)):
                if other.op == "call" and other.data.name in _ORDER:
                    rest = _operands(other, other.data)
                    if one in rest:
                        return self.is_extreme(one, rest, other.data)
        return self._node("call", primitive, args)

    def is_extreme(self, node: Node, others: Sequence[Node], primitive: Primitive) -> Node:
        """Whether the node is the largest or smallest, by comparisons with all others.

        JAX's derivative of max uses x == max(x, y). XLA's CPU backend may compute x
        twice, once with a fused multiply-add and once without, and x then differs from itself.
        """
        order = named(_ORDER[primitive.name])
        truths = [self.call(order, node, other) for other in others if other is not node]
        if not truths:
            return self.const(True)
        return reduce(partial(self.call, _AND), truths)

    def sqrt(self, node: Node) -> Node:
        """Square root."""
        return self.call(SQRT, node)

    def select(self, condition: Node, on_true: Node, on_false: Node) -> Node:
        """One of two nodes, selected by a truth value."""
        if condition.op == "const":
            return on_true if condition.data else on_false
        if on_true is on_false:
            return on_true
        return self._node("select", None, (condition, on_true, on_false))

    def custom(self, rule: Any, index: int, args: Sequence[Node]) -> Node:
        """Result `index` of a function with a custom derivative rule."""
        return self._node("custom", (rule, index), tuple(args))

    def stop(self, node: Node) -> Node:
        """The node, without derivatives."""
        return node if node.op in ("const", "stop") else self._node("stop", None, (node,))

    def let(self, node: Node) -> Node:
        """The node as one atom that no sum or product opens."""
        return node if node.op in ("const", "input", "let") else self._node("let", None, (node,))


def scaled(node: Node) -> bool:
    """Whether a node has a numeric or parameter factor."""
    if node.op == "sum":
        constant, terms = node.data
        return abs(terms[0][1]) != 1.0 or constant not in (0.0, 1.0, -1.0)
    return node.op == "product" and any(base.fixed for base, _ in node.data)


def _by_id(item: tuple[Node, Any]) -> int:
    return item[0].id


def _merges(node: Node, constant: float, total: dict[Node, float]) -> bool:
    inner_constant, inner = node.data
    return (constant != 0.0 and inner_constant != 0.0) or any(term in total for term, _ in inner)


def _negative(node: Node) -> bool:
    """Whether the leading coefficient is negative: true for exactly one of x and -x."""
    return node.op == "sum" and node.data[1][0][1] < 0


def _operands(node: Node, primitive: Primitive) -> list[Node]:
    """All operands of a nested maximum, or minimum."""
    if node.op == "call" and node.data == primitive:
        return [x for arg in node.args for x in _operands(arg, primitive)]
    return [node]


def _power(base: float, exponent: int) -> float:
    with np.errstate(all="ignore"):
        return float(np.float64(base) ** exponent)


def order(roots: Iterable[Node], known: Container[Node] = ()) -> list[Node]:
    """All nodes below the roots, the roots included, arguments first.

    Known nodes, and nodes used only by them, are left out.
    """
    found: set[Node] = set()
    stack = [root for root in roots if root not in known]
    while stack:
        node = stack.pop()
        if node not in found:
            found.add(node)
            stack.extend(arg for arg in node.args if arg not in found and arg not in known)
    return sorted(found, key=node_id)


def node_id(node: Node) -> int:
    """Sort key that puts arguments first."""
    return node.id
