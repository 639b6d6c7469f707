"""Global value numbering: of expressions that are equal, one is computed.

Expressions are equal if their residues are (`_residues`). The normal form of the graph merges
equal expressions of one shape. Derivatives also have equal ones of different shapes, such as
velocities of a point in two orders of summation, or the entries of R^T dR/dt and their negatives.

An expression is replaced only if nothing is lost:

- The other one has no division, function or choice that it does not have. (1 - cos x) / sin x has
  no value at 0, where sin x / (1 + cos x) is 0.
- At all sample states its running error is not larger. 1 - cos^2 x has no digits near 0, where
  sin^2 x has all of them.

Source: Gulwani and Necula, Global Value Numbering Using Random Interpretation, Symposium on
Principles of Programming Languages (2004), 342-352.
"""

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxlag._lowering._graph._expression import COS, SIN, Graph, Node, order
from jaxlag._lowering._graph._residues import PRIME, ZERO, Residue, Residues
from jaxlag._lowering._graph._straight_line import operations
from jaxlag._lowering._graph._traversal import rebuilt
from jaxlag._lowering._symbolic._running_error import running_errors

Cost = tuple[float, float]

WORSE = 8.0  # times the running error of the replaced expression
NEAR = 1e-7  # relative distance of sample states from those where terms cancel
RANDOM = 2  # sample states at random


class _Member(NamedTuple):
    """A node of a class of equal ones: its cost, and where it has no value.

    Attributes:
        node: the node.
        cost: of its operations without sharing: those of the state, and of params alone.
        partial: residues of its divisors, and of the arguments of its functions and choices.
    """

    node: Node
    cost: Cost
    partial: frozenset


def merged(graph: Graph, roots: Sequence[Node], residues: Residues) -> list[Node]:
    """The roots with one node, or its negative, for all equal ones: the one of least cost.

    A node of params alone is preferred to any other, and of equal costs the first. Costs are
    without sharing: an operand costs less than its result, so that no node is computed from itself.
    A "let" stays where it is.
    """
    nodes = order(roots)
    found = dict(zip(nodes, residues(nodes), strict=True))
    classes: dict[Residue, list[_Member]] = defaultdict(list)
    described: dict[Node, _Member] = {}
    for node in nodes:
        described[node] = member = _described(node, described, found)
        if node.op != "let":
            classes[_up_to_sign(found[node])].append(member)

    several = [each for each in classes.values() if len(each) > 1]
    errors = running_errors([each.node for members in several for each in members], _samples(nodes))
    chosen: dict[Node, Node] = {}
    for members in several:
        members.sort(key=lambda each: (each.cost, each.node.id))
        for k, member in enumerate(members):
            for other in members[:k]:
                if other.partial <= member.partial:
                    a, b = errors[other.node], errors[member.node]
                    if np.all((a <= WORSE * b) | np.isnan(b)):
                        chosen[member.node] = other.node
                        break

    done: dict[Node, Node] = {}
    stack = list(roots)
    while stack:
        node = stack[-1]
        other = chosen.get(node)
        if node in done:
            stack.pop()
        elif found[node] == ZERO and not described[node].partial:
            done[node] = graph.zero
        elif other is not None and other in done:
            same = found[other] == found[node]
            done[node] = done[other] if same else graph.scale(done[other], -1.0)
        elif other is not None:
            stack.append(other)
        elif missing := [arg for arg in node.args if arg not in done]:
            stack.extend(missing)
        else:
            done[node] = rebuilt(graph, node, [done[arg] for arg in node.args], {})
    return [done[root] for root in roots]


def _described(node: Node, known: dict[Node, _Member], found: dict[Node, Residue]) -> _Member:
    own = (0, operations(node)) if node.fixed else (operations(node), 0)
    below = [known[arg] for arg in node.args]
    cost = own[0] + sum(c.cost[0] for c in below), own[1] + sum(c.cost[1] for c in below)
    partial = frozenset().union(*(c.partial for c in below))
    if node.op == "product":
        over = {_up_to_sign(found[base]) for base, e in node.data if e < 0}
        partial = partial | over if over else partial
    elif node.op in ("select", "custom", "stop") or (
        node.op == "call" and node.data not in (SIN, COS)
    ):
        partial = partial | {(node.op, *(found[arg] for arg in node.args), found[node])}
    return _Member(node, cost, partial)


def _samples(nodes: Sequence[Node]) -> dict[tuple[str, int], np.ndarray]:
    """Values of all inputs at the sample states.

    Besides states at random there are states with all coordinates near 0, 0.7, 1, pi/2 and pi, and
    exactly there. In those at 0.7 all other inputs have this value, too.
    """
    rng = np.random.default_rng(0)
    inputs = {}
    for node in nodes:
        if node.op != "input":
            continue
        name, _ = node.data
        at_random = rng.uniform(0.5, 1.5, RANDOM + 2)
        if name in ("q", "v", "t"):
            at_random = at_random * rng.choice([-1.0, 1.0], RANDOM + 2)
        places = np.array([0.0, 0.7, 1.0, np.pi / 2, np.pi])
        near = places + NEAR * rng.uniform(0.5, 1.5, places.size)
        if name != "q":
            places = np.array([at_random[-1], 0.7, at_random[-2], *rng.uniform(0.5, 1.5, 2)])
            near = places * (1.0 + NEAR * rng.uniform(0.5, 1.5, places.size))
        inputs[node.data] = np.concatenate([at_random[:RANDOM], near, places])
    return inputs


def _up_to_sign(residue: Residue) -> Residue:
    """The same for a residue and its negative."""
    if residue[0] <= PRIME - residue[0]:
        return residue
    return tuple(-x % PRIME for x in residue)
