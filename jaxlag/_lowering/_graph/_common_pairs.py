"""Common pairs of operands: pairs that several sums or products contain, computed once.

A token is a node, or a pair of tokens that is shared.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from heapq import heappop, heappush
from typing import Any

from jaxlag._lowering._graph._expression import Node, node_id

Term = tuple[Any, float]  # (token, coefficient)

LONGEST = 32  # factors of the longest product that is searched


class Shared:
    """Finds common pairs, and orders tokens: nodes by id, then pairs by age.

    Args:
        first: the rank of the first pair, above the ids of all nodes.
    """

    def __init__(self, first: int) -> None:
        self._first = first
        self._ranks: dict[Any, int] = {}

    def sums(self, given: Mapping[Node, list[Term]]) -> dict[Node, list[Term]]:
        """The sums with common pairs x + k y in place of their terms.

        The most frequent pair comes first; of equally frequent ones the first found.
        """
        groups = {node: list(terms) for node, terms in given.items()}
        occurs = Counter(token for terms in groups.values() for token, _ in terms)
        places: dict[Any, set[Node]] = {}
        ages: dict[Any, int] = {}
        queue: list[tuple[int, int, Any]] = []  # (- least number of sums, age, pair)

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
        """Replace in place products x y that several products contain, or one contains twice.

        The most frequent pair comes first; of equally frequent ones the first found. Products of
        more than LONGEST factors are unchanged: counting their pairs would take seconds.
        """
        powers = {
            node: Counter(factors) for node, factors in groups.items() if len(factors) <= LONGEST
        }
        counts: dict[Any, int] = {}
        ages: dict[Any, int] = {}
        places: dict[Any, set[Node]] = defaultdict(set)
        queue: list[tuple[int, int, Any]] = []  # (minus the count, age, pair), some outdated

        def change(node: Node, pair: tuple[Any, ...], old: int, new: int) -> None:
            if old == new:
                return
            counts[pair] = counts.get(pair, 0) + new - old
            age = ages.setdefault(pair, len(ages))
            (places[pair].add if new else places[pair].discard)(node)
            if counts[pair] > 1:
                heappush(queue, (-counts[pair], age, pair))

        for node, own in powers.items():
            for pair, times in self._factor_pairs(own):
                change(node, pair, 0, times)
        while queue:
            count, _, best = heappop(queue)
            if counts[best] != -count:  # re-entered with its new count
                continue
            self._rank(best)
            _, x, y = best
            for node in sorted(places[best], key=node_id):
                own = powers[node]
                old = dict(own)
                times = _times(old, x, y)
                own.subtract([x, y] * times)
                own[best] += times
                powers[node] = own = +own
                rank = {token: self._rank(token) for token in (*old, best)}
                touched = (x, best) if x == y else (x, y, best)
                for z in sorted(rank, key=rank.__getitem__):
                    for w in touched:
                        if z in touched and rank[w] < rank[z]:
                            continue  # found from the other side
                        first, second = (z, w) if rank[z] <= rank[w] else (w, z)
                        then, now = (_times(each, first, second) for each in (old, own))
                        change(node, ("times", first, second), then, now)
        for node, own in powers.items():
            groups[node] = list(own.elements())

    def _factor_pairs(self, powers: Mapping[Any, int]) -> Iterable[tuple[Any, int]]:
        """Pairs of factors, each with the number of disjoint pairs."""
        tokens = sorted(powers, key=self._rank)
        for i, x in enumerate(tokens):
            for y in tokens[i:]:
                if times := _times(powers, x, y):
                    yield ("times", x, y), times

    def _rank(self, token: Any) -> int:
        """Place in the order of tokens: nodes by id, then pairs by age."""
        if isinstance(token, Node):
            return token.id
        return self._ranks.setdefault(token, self._first + len(self._ranks))

    def _pair(self, x: Any, a: float, y: Any, b: float) -> tuple[tuple[Any, ...], float]:
        """a x + b y as (("plus", first, second, ratio), factor)."""
        if self._rank(x) > self._rank(y):
            x, a, y, b = y, b, x, a
        return ("plus", x, y, b / a), a


def _times(powers: Mapping[Any, int], x: Any, y: Any) -> int:
    """Number of disjoint pairs x y."""
    if x == y:
        return powers.get(x, 0) // 2
    return min(powers.get(x, 0), powers.get(y, 0))


def _without(terms: list[Term], pair: tuple[Any, ...]) -> tuple[list[Term], float]:
    """The terms without the pair, and the factor of the pair."""
    _, x, y, _ = pair
    factor = next(c for t, c in terms if t == x)
    return [(t, c) for t, c in terms if t not in (x, y)], factor
