"""Straight-line code as a function of given numbers, and its derivatives as such code."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

from jaxlag._lowering._graph._expression import FIXED, Graph, Node, named
from jaxlag._lowering._graph._straight_line import Line, Program, assemble
from jaxlag._lowering._jaxpr._differentiate import gradient, tangents

_NE = named("ne")


class Code(NamedTuple):
    """Some lines of a program. Codes are equal if they are the same object.

    Attributes:
        lines: the lines, in order.
        given: slots of the given numbers.
        results: slots, or numbers, of the results.
        numbers: slot -> value of the constants.
        truths: slots of truth values.
    """

    lines: tuple[Line, ...]
    given: tuple[int, ...]
    results: tuple[int, ...]
    numbers: Mapping[int, float | bool]
    truths: frozenset[int]

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other


@lru_cache(maxsize=512)
def body_of(program: Program) -> Code:
    """The body as a function of the carried numbers and the inputs that vary."""
    read = [slot for (name, _), slot in program.inputs.items() if name not in FIXED]
    return _code(program, program.body, [*program.carried, *read], program.results)


@lru_cache(maxsize=512)
def prelude_of(program: Program) -> Code:
    """The prelude as a function of the fixed inputs, with the carried numbers as results."""
    fixed = [slot for (name, _), slot in program.inputs.items() if name in FIXED]
    return _code(program, program.prelude, fixed, program.carried)


@lru_cache(maxsize=512)
def whole_of(program: Program) -> Code:
    """Prelude and body as a function of all inputs."""
    lines = (*program.prelude, *program.body)
    return _code(program, lines, list(program.inputs.values()), program.results)


def _code(
    program: Program, lines: Sequence[Line], given: Sequence[int], results: Sequence[int]
) -> Code:
    return Code(tuple(lines), tuple(given), tuple(results), program.numbers, program.truths)


@lru_cache(maxsize=512)
def tangent(code: Code, moving: tuple[bool, ...]) -> Code:
    """Code for the tangents of the results.

    It is a function of the given numbers, and of the tangents of those that move. The others have
    none, not tangents of 0: a root of a number that is 0 has an infinite slope.

    Raises:
        Unsupported: the derivative of a function has no code.
    """
    graph, given, results = _decoded(code)
    moved = [x for x, m in zip(given, moving, strict=True) if m]
    dots = [graph.input("dot", i) for i in range(len(moved))]
    roots = tangents(graph, results, dict(zip(moved, dots, strict=True)))
    return _assembled(graph, [*given, *dots], roots)


@lru_cache(maxsize=512)
def adjoint(code: Code, moving: tuple[bool, ...]) -> Code:
    """Code for the cotangents of the numbers that move.

    It is a function of the given numbers, and of the cotangents of the results.

    Raises:
        Unsupported: the derivative of a function has no code.
    """
    graph, given, results = _decoded(code)
    bars = [graph.input("bar", k) for k in range(len(results))]
    total = graph.add(*(graph.mul(*pair) for pair in zip(bars, results, strict=True)))
    moved = [x for x, m in zip(given, moving, strict=True) if m]
    return _assembled(graph, [*given, *bars], gradient(graph, total, moved))


def _decoded(code: Code) -> tuple[Graph, list[Node], list[Node]]:
    """The code on a graph of its own: (graph, given numbers, results).

    Its products are not opened: derivatives overflow no sooner than those of the lines, one by one.
    """
    graph = Graph()
    graph.flat = False
    known = {slot: graph.const(value) for slot, value in code.numbers.items()}
    given = [graph.input("given", i) for i in range(len(code.given))]
    for slot, node in zip(code.given, given, strict=True):
        known[slot] = graph.call(_NE, node, graph.zero) if slot in code.truths else node
    for line in code.lines:
        known[line.to] = _node(graph, line, [known[slot] for slot in line.args])
    results = [known[slot] for slot in code.results]
    # The derivative of a truth value is 0.
    return (
        graph,
        given,
        [
            graph.zero if slot in code.truths else node
            for slot, node in zip(code.results, results, strict=True)
        ],
    )


def _node(graph: Graph, line: Line, args: list[Node]) -> Node:
    match line.op:
        case "add":
            return graph.add(*args)
        case "sub":
            return graph.sub(*args)
        case "mul":
            return graph.mul(*args)
        case "div":
            return graph.div(*args)
        case "neg":
            return graph.scale(args[0], -1.0)
        case "select":
            return graph.select(*args)
        case "stop":
            return graph.stop(args[0])
        case _:
            return graph.call(line.data, *args)


def _assembled(graph: Graph, given: Sequence[Node], roots: Sequence[Node]) -> Code:
    """The code for the roots, as a function of all of these inputs, read or not."""
    program = assemble(graph, roots)
    slots, unread = [], max((*program.inputs.values(), *_slots(program)), default=0)
    for node in given:
        slot = program.inputs.get(node.data)
        if slot is None:
            unread += 1
            slot = unread
        slots.append(slot)
    return _code(program, (*program.prelude, *program.body), slots, program.results)


def _slots(program: Program) -> list[int]:
    return [*program.numbers, *(line.to for line in (*program.prelude, *program.body))]
