"""Pairs of operands that several sums or products contain, to be computed once.

A token is a node, or a pair of tokens found worth sharing.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from heapq import heappop, heappush
from typing import Any

from jaxlag._lowering._graph import Node, node_id

Term = tuple[Any, float]  # (token, coefficient)


class Shared:
    """Finds pairs, and puts tokens in an order: nodes by id, then pairs by age.

    Args:
        first: the rank of the first pair, above the ids of all nodes.
    """

    def __init__(self, first: int) -> None:
        self._first = first
        self._ranks: dict[Any, int] = {}

    def sums(self, given: Mapping[Node, list[Term]]) -> dict[Node, list[Term]]:
        """The sums with pairs x + k y that several contain in place of their terms.

        The most frequent pair comes first, of equally frequent ones the one met first.
        """
        groups = {node: list(terms) for node, terms in given.items()}
        occurs = Counter(token for terms in groups.values() for token, _ in terms)
        places: dict[Any, set[Node]] = {}
        ages: dict[Any, int] = {}
        queue: list[tuple[int, int, Any]] = []  # (- of how many sums at least, age, pair)

        def pairs(terms: list[Term]) -> Iterable[tuple[Any, ...]]:
            shared = [(x, a) for x, a in terms if occurs[x] > 1]
            for i, (x, a) in enumerate(shared):
                for y, b in shared[i + 1 :]:
                    yield self._pair(x, a, y, b)[0]

        def enter(node: Node) -> None:
            for key in pairs(groups[node]):
                users = places.setdefault(key, set())
                users.add(node)
                age = ages.setdefault(key, len(ages))
                if len(users) > 1:
                    heappush(queue, (-len(users), age, key))

        for node in groups:
            enter(node)
        while queue:
            count, age, best = heappop(queue)
            found = len(places[best])
            if found != -count:
                if found > 1:
                    heappush(queue, (-found, age, best))
                continue
            users = places[best]
            places[best] = set()
            occurs[best] = found
            for node in sorted(users, key=node_id):
                for key in pairs(groups[node]):
                    places[key].discard(node)
                rest, chosen = _without(groups[node], best)
                groups[node] = [*rest, (best, chosen)]
                enter(node)
        return groups

    def factors(self, groups: dict[Node, list[Any]]) -> None:
        """In place: products x y that several products contain, or one contains twice."""
        counts: Counter[Any] = Counter()
        places: dict[Any, set[Node]] = defaultdict(set)

        def enter(node: Node, sign: int) -> None:
            for pair, times in self._factor_pairs(groups[node]):
                counts[pair] += sign * times
                (places[pair].add if sign > 0 else places[pair].discard)(node)

        for node in groups:
            enter(node, 1)
        while counts:
            best, count = max(counts.items(), key=_count)
            if count < 2:
                return
            self._rank(best)
            for node in sorted(places[best], key=node_id):
                enter(node, -1)
                groups[node] = _with_pair(groups[node], best)
                enter(node, 1)
            del counts[best], places[best]

    def _factor_pairs(self, factors: list[Any]) -> list[tuple[Any, int]]:
        """Pairs of factors, each as often as disjoint pairs of it fit."""
        if len(factors) < 2:
            return []
        powers = Counter(factors)
        tokens = sorted(powers, key=self._rank)
        out: list[tuple[Any, int]] = []
        for i, x in enumerate(tokens):
            if powers[x] > 1:
                out.append((("times", x, x), powers[x] // 2))
            out += [(("times", x, y), min(powers[x], powers[y])) for y in tokens[i + 1 :]]
        return out

    def _rank(self, token: Any) -> int:
        """Place in an order of tokens: nodes by id, then what is shared by age."""
        if isinstance(token, Node):
            return token.id
        return self._ranks.setdefault(token, self._first + len(self._ranks))

    def _pair(self, x: Any, a: float, y: Any, b: float) -> tuple[tuple[Any, ...], float]:
        """a x + b y as (("plus", first, second, ratio), factor)."""
        if self._rank(x) > self._rank(y):
            x, a, y, b = y, b, x, a
        return ("plus", x, y, b / a), a


def _count(item: tuple[Any, int]) -> int:
    return item[1]


def _without(terms: list[Term], pair: tuple[Any, ...]) -> tuple[list[Term], float]:
    """The terms without the pair, and the factor it had."""
    _, x, y, _ = pair
    factor = next(c for t, c in terms if t == x)
    return [(t, c) for t, c in terms if t not in (x, y)], factor


def _with_pair(factors: list[Any], pair: tuple[Any, ...]) -> list[Any]:
    _, x, y = pair
    powers = Counter(factors)
    times = powers[x] // 2 if x == y else min(powers[x], powers[y])
    if not times:
        return factors
    powers.subtract([x, y] * times)
    powers[pair] += times
    return list(powers.elements())
