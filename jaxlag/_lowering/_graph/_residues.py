"""Identity testing: expressions are evaluated modulo a prime at random points.

Two rational functions of degree d that differ agree at a random point with a probability of at
most d / PRIME (Schwartz and Zippel); for d = 1000 at two points 2e-31 for each pair. Numbers of
double precision are fractions with a power of two below the line: nothing is rounded.

Sines and cosines are points of the unit circle. All other functions, and choices, are random
functions of their arguments; square roots, too, since a root of x^2 modulo a prime may be x or -x.
So some equal expressions are not recognized, but different ones are called equal only with that
probability. Equal ones may have values at different places: (x^2 - 1) / (x - 1) and x + 1.

Source: Schwartz, Fast Probabilistic Algorithms for Verification of Polynomial Identities, Journal
of the ACM 27 (1980), 701-717.
"""

from collections.abc import Iterable, Sequence
from math import isfinite
from random import Random

from jaxlag._lowering._graph._expression import COS, SIN, Node, order

PRIME = (1 << 61) - 2373
"""p and (p - 1)/2 are prime. Powers of two therefore differ, up to exponents of 2^60."""
POINTS = 2

Residue = tuple[int, ...]
"""Values of one node at all points."""

ZERO: Residue = (0,) * POINTS


class Residues:
    """Residues of the nodes of one graph at fixed random points."""

    def __init__(self) -> None:
        self._known: dict[Node, Residue] = {}
        self._drawn: dict[tuple, int] = {}
        self._numbers: dict[float, int] = {}
        self._rules: dict[object, int] = {}

    def __call__(self, roots: Iterable[Node]) -> list[Residue]:
        """The residues of the roots."""
        roots = list(roots)
        for node in order(roots, self._known):
            self._known[node] = tuple(self._value(node, point) for point in range(POINTS))
        return [self._known[root] for root in roots]

    def vanish(self, roots: Iterable[Node]) -> bool:
        """Whether all roots are zero for all values of their inputs."""
        return all(residue == ZERO for residue in self(roots))

    def _value(self, node: Node, point: int) -> int:
        if node.op == "const":
            return self._constant(node.data, point)
        if node.op == "input":
            return self._draw(point, "input", *node.data)
        args = [self._known[arg][point] for arg in node.args]
        if node.op == "sum":
            constant, terms = node.data
            terms = zip(args, (c for _, c in terms), strict=True)
            scaled = (self._number(c, point) * x for x, c in terms)
            return (self._number(constant, point) + sum(scaled)) % PRIME
        if node.op == "product":
            return self._product(node, args, point)
        if node.op == "let":
            return args[0]
        if node.op == "call":
            return self._call(node, args, point)
        if node.op == "custom":
            rule, index = node.data
            number = self._rules.setdefault(rule, len(self._rules))
            return self._draw(point, "custom", number, index, *args)
        # A choice between equal expressions is not one of them: one may have no value where the
        # other has. Derivatives do not pass a "stop".
        return self._draw(point, node.op, *args)

    def _constant(self, data: float | bool, point: int) -> int:
        return (
            self._draw(point, repr(data)) if isinstance(data, bool) else self._number(data, point)
        )

    def _number(self, x: float, point: int) -> int:
        if not isfinite(x):
            return self._draw(point, repr(x))
        if x not in self._numbers:
            above, below = x.as_integer_ratio()
            self._numbers[x] = above * pow(below, -1, PRIME) % PRIME
        return self._numbers[x]

    def _product(self, node: Node, args: Sequence[int], point: int) -> int:
        out = 1
        for x, (_, exponent) in zip(args, node.data, strict=True):
            if x == 0 and exponent < 0:
                return self._draw(point, "division by zero", node.id)
            out = out * pow(x, exponent, PRIME) % PRIME
        return out

    def _call(self, node: Node, args: Sequence[int], point: int) -> int:
        if node.data in (SIN, COS):
            (x,) = args
            positive = min(x, PRIME - x)
            half = self._draw(point, "tangent of half an angle", positive)
            below = pow(1 + half * half, -1, PRIME)
            if node.data == COS:
                return (1 - half * half) * below % PRIME
            sine = 2 * half * below % PRIME
            return sine if positive == x else PRIME - sine
        return self._draw(point, "call", repr(node.data.key), *args)

    def _draw(self, point: int, *key: object) -> int:
        """A random number for a key."""
        key = (point, *key)
        if key not in self._drawn:
            self._drawn[key] = Random(repr(key)).randrange(2, PRIME)
        return self._drawn[key]


def fraction(residue: Residue, largest: int = 64) -> float | None:
    """The number, the same at all points, that is a fraction of small integers; else None."""
    if any(x != residue[0] for x in residue):
        return None
    for below in range(1, largest + 1):
        above = residue[0] * below % PRIME
        if min(above, PRIME - above) <= largest:
            return (above if above <= largest else above - PRIME) / below
    return None
