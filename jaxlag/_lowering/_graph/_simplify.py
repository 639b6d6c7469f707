"""Simplification: expressions are expanded to polynomials in atoms, then factored.

An atom is an input, a call of a function of simplified arguments, the reciprocal of a simplified
sum, or a sum that stays unexpanded. Only velocities, sines and cosines are multiplied out:
the expansion of a difference of coordinates or of parameters would lose digits.
Of sines and cosines m sin^2 + m cos^2 = m is used, and m - m cos^2 = m sin^2, never the reverse.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping

from jaxlag._lowering._graph._expression import COS, POWERS, SIN, SQRT, Graph, Node, order, scaled

Monomial = tuple[tuple[int, int], ...]  # (id of an atom, exponent), ascending
Polynomial = dict[Monomial, float]

CAP = 2000  # terms of a polynomial
WORK = 200_000  # terms processed in total, about half a second; a chain of 12 links takes 36,000
SPEEDS = ("v", "speed", "bound")


class TooLong(Exception):
    """A polynomial of more than `CAP` terms, or more than `WORK` of them in all."""


class Expansion:
    """Polynomials of the nodes of one graph.

    A polynomial is converted back to a sum over the products of varying factors. All known
    factors of a product form one coefficient.
    """

    def __init__(self, graph: Graph, cap: int = CAP) -> None:
        self.graph, self.cap, self.work = graph, cap, 0
        self._known: dict[Node, Polynomial] = {}
        self._cosine: dict[int, int] = {}
        self._sine: dict[int, int] = {}
        self._radicand: dict[int, Node] = {}

    def simplified(self, roots: Iterable[Node]) -> list[Node]:
        """The roots as short sums of products."""
        return [self.build(self.polynomial(root)) for root in roots]

    # ---- Apart -------------------------------------------------------------------------------

    def polynomial(self, root: Node) -> Polynomial:
        """The polynomial of a node."""
        for node in order([root], self._known):
            self._known[node] = self._expand(node)
        return self._known[root]

    def _expand(self, node: Node) -> Polynomial:
        if node.op == "const" and node.constant is not None:
            return {(): node.constant} if node.constant != 0.0 else {}
        if node.op == "sum":
            constant, terms = node.data
            total: Polynomial = {(): constant} if constant != 0.0 else {}
            for term, coefficient in terms:
                _add(total, self._known[term], coefficient)
            return self._capped(self._guarded(node, self._paired(_nonzero(total))))
        if node.op == "product":
            out: Polynomial = {(): 1.0}
            for base, exponent in node.data:
                out = self._times(out, self._raised(base, exponent))
            return out
        return {((self._atom(node).id, 1),): 1.0}

    def _raised(self, base: Node, exponent: int) -> Polynomial:
        factor = self._known[base]
        if abs(exponent) > POWERS and scaled(built := self.build(factor)):
            return {((built.id, exponent),): 1.0}
        if exponent < 0:
            if len(factor) == 1:
                ((monomial, coefficient),) = factor.items()
                inverse = tuple((atom, -e) for atom, e in monomial)
                factor = {inverse: 1.0 / coefficient}
            else:
                inverse = self.graph.power(self.build(factor), -1)
                factor = self._of_inverse(inverse)
            exponent = -exponent
        out: Polynomial = {(): 1.0}
        for _ in range(exponent):
            out = self._times(out, factor)
        return out

    def _of_inverse(self, inverse: Node) -> Polynomial:
        """1/x of a built x: number times powers of atoms."""
        coefficient, node = 1.0, inverse
        if node.op == "sum":
            _, ((node, coefficient),) = node.data
        factors = node.data if node.op == "product" else ((node, 1),)
        return {tuple(sorted((base.id, e) for base, e in factors)): coefficient}

    def _atom(self, node: Node) -> Node:
        """The node with simplified arguments."""
        graph = self.graph
        if node.op in ("input", "const"):
            return node
        args = [self.build(self._known[arg]) for arg in node.args]
        if node.op == "call":
            node = graph.call(node.data, *args)
            if node.op == "call" and node.data in (SIN, COS):
                sine, cosine = graph.call(SIN, *node.args), graph.call(COS, *node.args)
                self._cosine[sine.id], self._sine[cosine.id] = cosine.id, sine.id
            elif node.op == "call" and node.data == SQRT:
                self._radicand[node.id] = node.args[0]
            elif node.op == "sum":  # an odd function of a negative argument
                self._expand_again(node)
        elif node.op == "select":
            node = graph.select(*args)
        elif node.op == "custom":
            rule, index = node.data
            node = graph.custom(rule, index, args)
        elif node.op == "stop":
            node = graph.stop(args[0])
        else:
            node = graph.let(args[0])
        return node

    def _expand_again(self, node: Node) -> None:
        for below in order([node]):
            self._known.setdefault(below, {((below.id, 1),): 1.0})

    def _times(self, a: Polynomial, b: Polynomial) -> Polynomial:
        self._spend(len(a) * len(b))
        out: Polynomial = defaultdict(float)
        for left, x in a.items():
            for right, y in b.items():
                self._collect(out, _merged(left, right), x * y)
        return self._capped(self._paired(_nonzero(out)))

    def _guarded(self, node: Node, polynomial: Polynomial) -> Polynomial:
        """Sums of different coordinates, or of parameters alone, as one atom for each velocity."""
        if len(polynomial) < 2:
            return polynomial
        if node.fixed:
            return self._as_atom(self.build(polynomial))
        groups: dict[Monomial, Polynomial] = defaultdict(dict)
        for monomial, coefficient in polynomial.items():
            speeds = tuple(f for f in monomial if self._is(f[0]) == "speed")
            groups[speeds][tuple(f for f in monomial if self._is(f[0]) != "speed")] = coefficient
        out: Polynomial = {}
        for speeds, group in groups.items():
            unexpanded = {tuple(f for f in m if self._is(f[0]) == "unexpanded") for m in group}
            if len(unexpanded) > 1:
                group = self._as_atom(self.build(group))
            for monomial, coefficient in group.items():
                out[_merged(monomial, speeds)] = coefficient
        return out

    def _as_atom(self, node: Node) -> Polynomial:
        number, atom = _split(node)
        if atom is None:
            return {(): number} if number else {}
        if atom.op == "product":
            return {tuple(sorted((base.id, e) for base, e in atom.data)): number}
        self._known.setdefault(atom, {((atom.id, 1),): 1.0})
        return {((atom.id, 1),): number}

    def _is(self, atom: int) -> str:
        """The kind of an atom: "speed", "unexpanded", or "plain" for expanded ones."""
        node = self.graph.nodes[atom]
        if node.fixed or atom in self._cosine or atom in self._sine:
            return "plain"
        if node.op == "input" and node.data[0] in SPEEDS:
            return "speed"
        return "unexpanded"

    def _paired(self, polynomial: Polynomial) -> Polynomial:
        """Apply m sin^2 + m cos^2 = m."""
        waiting = list(polynomial)
        while waiting:
            monomial = waiting.pop()
            for atom, exponent in monomial:
                other = self._cosine.get(atom, self._sine.get(atom))
                if exponent < 2 or other is None or monomial not in polynomial:
                    continue
                rest = _merged(monomial, ((atom, -2),))
                partner = _merged(rest, ((other, 2),))
                if polynomial.get(partner) == polynomial[monomial]:
                    polynomial = dict(polynomial)
                    total = polynomial.get(rest, 0.0) + polynomial.pop(partner)
                    del polynomial[monomial]
                    polynomial.pop(rest, None)
                    if total != 0.0:
                        polynomial[rest] = total
                        waiting.append(rest)
                        waiting.extend(self._near(rest, polynomial))
        return polynomial

    def _near(self, monomial: Monomial, polynomial: Polynomial) -> list[Monomial]:
        """Monomials that may pair with this one."""
        out = []
        for atom, exponent in monomial:
            other = self._cosine.get(atom, self._sine.get(atom))
            if exponent >= 2 and other is not None:
                partner = _merged(_merged(monomial, ((atom, -2),)), ((other, 2),))
                if partner in polynomial:
                    out.append(partner)
        return out

    def _collect(self, out: Polynomial, monomial: Monomial, coefficient: float) -> None:
        """Add a monomial, with sqrt(x)^2 = x applied."""
        for k, (atom, exponent) in enumerate(monomial):
            if exponent >= 2 and atom in self._radicand:
                rest = _merged(monomial[:k] + monomial[k + 1 :], ((atom, exponent - 2),))
                inner = self.polynomial(self._radicand[atom])
                for other, y in self._times({rest: coefficient}, inner).items():
                    out[other] = out.get(other, 0.0) + y
                return
        out[monomial] = out.get(monomial, 0.0) + coefficient

    def _spend(self, terms: int) -> None:
        self.work += terms
        if self.work > WORK:
            raise TooLong

    def _capped(self, polynomial: Polynomial) -> Polynomial:
        if len(polynomial) > self.cap:
            raise TooLong
        return polynomial

    # ---- Together ----------------------------------------------------------------------------

    def build(self, polynomial: Polynomial) -> Node:
        """A node with few operations that equals the polynomial."""
        if len(polynomial) == 1:  # an atom by itself may be a truth value
            ((monomial, coefficient),) = polynomial.items()
            if coefficient == 1.0 and len(monomial) == 1 and monomial[0][1] == 1:
                return self.graph.nodes[monomial[0][0]]
        groups: dict[Monomial, Polynomial] = defaultdict(dict)
        for monomial, coefficient in polynomial.items():
            fixed = tuple(f for f in monomial if self.graph.nodes[f[0]].fixed)
            varying = tuple(f for f in monomial if not self.graph.nodes[f[0]].fixed)
            groups[varying][fixed] = coefficient
        groups = self._with_sines(groups)
        terms = []
        for varying, fixed in groups.items():
            known = self._factored([(c, dict(m)) for m, c in fixed.items()])
            number, atom = _split(known)
            powers = dict(varying)
            if atom is not None:
                powers[atom.id] = 1
            terms.append((number, powers))
        return self._factored(terms)

    def _with_sines(self, groups: Mapping[Monomial, Polynomial]) -> dict[Monomial, Polynomial]:
        """Replace m - m cos^2 by m sin^2, and vice versa: one term less."""
        groups = dict(groups)
        again = True
        while again:
            again = False
            for monomial in list(groups):
                for atom, exponent in monomial:
                    other = self._cosine.get(atom, self._sine.get(atom))
                    if exponent < 2 or other is None or monomial not in groups:
                        continue
                    plain = _merged(monomial, ((atom, -2),))
                    if plain in groups and _opposite(groups[plain], groups[monomial]):
                        coefficient = groups.pop(plain)
                        del groups[monomial]
                        squared = _merged(plain, ((other, 2),))
                        total = dict(groups.get(squared, {}))
                        _add(total, coefficient, 1.0)
                        groups[squared] = _nonzero(total)
                        again = True
        return groups

    def _factored(self, terms: list[tuple[float, dict[int, int]]]) -> Node:
        """Sum of coefficient times powers; the most frequent factor is taken out first."""
        graph = self.graph
        done: list[tuple[Node, float]] = []
        while terms:
            self._spend(len(terms))
            counts: dict[tuple[int, bool], int] = defaultdict(int)
            for _, powers in terms:
                for atom, exponent in powers.items():
                    counts[atom, exponent > 0] += 1
            best = max(counts, key=lambda key: (counts[key], -key[0]), default=None)
            if best is None or counts[best] < 2:
                for coefficient, powers in terms:
                    done.append((self._product(powers), coefficient))
                break
            atom, positive = best
            shared = [t for t in terms if t[1].get(atom, 0) != 0 and (t[1][atom] > 0) == positive]
            taken = {id(t) for t in shared}
            terms = [t for t in terms if id(t) not in taken]
            least = min((powers[atom] for _, powers in shared), key=abs)
            inner = []
            for coefficient, powers in shared:
                rest = {a: e - least if a == atom else e for a, e in powers.items()}
                inner.append((coefficient, {a: e for a, e in rest.items() if e != 0}))
            factor = graph.power(graph.nodes[atom], least)
            done.append((graph.mul(factor, self._factored(inner)), 1.0))
        return graph.sum(done)

    def _product(self, powers: Mapping[int, int]) -> Node:
        return self.graph.product([(self.graph.nodes[a], e) for a, e in powers.items()])


def _merged(a: Monomial, b: Monomial) -> Monomial:
    if not a:
        return tuple(f for f in b if f[1])
    if not b:
        return tuple(f for f in a if f[1])
    powers = dict(a)
    for atom, exponent in b:
        powers[atom] = powers.get(atom, 0) + exponent
    return tuple(sorted((atom, e) for atom, e in powers.items() if e != 0))


def _add(total: Polynomial, other: Polynomial, factor: float) -> None:
    for monomial, coefficient in other.items():
        total[monomial] = total.get(monomial, 0.0) + factor * coefficient


def _nonzero(polynomial: Polynomial) -> Polynomial:
    """Without the terms that canceled."""
    return {m: c for m, c in polynomial.items() if c != 0.0}


def _opposite(a: Polynomial, b: Polynomial) -> bool:
    return a.keys() == b.keys() and all(a[m] == -b[m] for m in a)


def _split(node: Node) -> tuple[float, Node | None]:
    """(number, rest) of a coefficient; no rest if it is a number."""
    if node.op == "const":
        return node.data, None
    if node.op == "sum":
        constant, terms = node.data
        if len(terms) == 1 and constant == 0.0:
            return terms[0][1], terms[0][0]
    return 1.0, node
