"""A turn of a loop over lanes: which operations are on numbers, and which come before and after."""

from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

from jaxlag._integration._vector_loop._divisions import with_fewer_divisions
from jaxlag._integration._vector_loop._flat_program import FlatProgram, Operation, Value
from jaxlag._integration._vector_loop._on_numbers import is_supported, on_numbers

# Operations on arrays before a turn: more would cost more than the turn.
MOST_BEFORE = 64
WRITES = frozenset(("custom_vmap_call", "dynamic_update_slice", "scatter"))


class NotVectorizable(Exception):
    """A loop contains an operation without a form on numbers; the text names it."""


class Turn(NamedTuple):
    """The body of a loop in three parts.

    Attributes:
        body: the whole program.
        before: operations on arrays, which come first.
        found: their results that the numbers depend on.
        writes: the operation that writes into a buffer, by the number of its input; last.
        written: what the writes read apart from their buffers.
        numbers: the rest, on numbers. Its outputs are the elements of the next state apart from
            buffers, and those of `written`.
        elements: the inputs of `numbers` that are the elements of a value of the body.
    """

    body: FlatProgram
    before: list[Operation]
    found: list[int]
    writes: dict[int, Operation]
    written: list[Value]
    numbers: FlatProgram
    elements: dict[int, list[int]]


def turn_of(body: FlatProgram) -> Turn:
    """The parts of the body of a loop.

    Raises:
        NotVectorizable: an operation on numbers has no form on numbers.
    """
    writes = _writes(body)
    last = {result for operation in writes.values() for result in operation.results}
    beyond = [
        operation
        for operation in body.needed(body.outputs)
        if not (is_supported(body, operation) or last.intersection(operation.results))
    ]
    known = [result for operation in beyond for result in operation.results]
    before = body.needed(known)
    if len(before) > MOST_BEFORE:
        names = ", ".join(sorted({operation.name for operation in beyond}))
        raise NotVectorizable(f"{names} on computed numbers")
    following = zip(body.inputs, body.outputs, strict=True)
    written = [x for operation in writes.values() for x in operation.operands[1:]]
    targets = [*(after for start, after in following if start not in writes), *written]
    read = body.read_by(body.needed(targets, known), targets)
    found = sorted(read.intersection(known))
    consts = [x for x in body.consts if x in read]  # not tables, which are read before the turn
    sources = [*consts, *(x for x in body.inputs if x not in writes), *found]
    numbers = with_fewer_divisions(on_numbers(body, sources, targets))
    elements = dict(zip(sources, split(body, sources, numbers.inputs), strict=True))
    return Turn(body, before, found, writes, written, numbers, elements)


def _writes(body: FlatProgram) -> dict[int, Operation]:
    """Writes into a part of the state that nothing else reads, and whose next value they are."""
    by_result = {x: operation for operation in body.operations for x in operation.results}
    everything = (*body.outputs, *(x for one in body.operations for x in one.operands))
    readers = Counter(x for x in everything if isinstance(x, int))
    found = {}
    for start, after in zip(body.inputs, body.outputs, strict=True):
        operation = by_result.get(after) if isinstance(after, int) else None
        if operation is None or operation.name not in WRITES:
            continue
        buffer, results = operation.operands[0], operation.results
        alone = results == (after,) and readers[start] == readers[results[0]] == 1
        if alone and isinstance(buffer, int) and buffer == start:
            found[start] = operation
    return found


def changing(turn: Turn, wanted: Collection[int]) -> dict[int, Value]:
    """The next value of every number of the state that changes and is needed.

    Args:
        turn: the turn.
        wanted: parts of the state that must be known on every turn.
    """
    numbers, elements = turn.numbers, turn.elements
    states = [x for x in turn.body.inputs if x not in turn.writes]
    start = [number for x in states for number in elements[x]]
    following = dict(zip(start, numbers.outputs, strict=False))
    written = numbers.outputs[len(start) :]
    needed = {number for x in states if x in wanted for number in elements[x]}
    count = -1
    while count != len(needed):
        count = len(needed)
        outputs = [*written, *(following[x] for x in needed)]
        read = numbers.read_by(numbers.needed(outputs), outputs)
        needed |= read.intersection(start)
    same = {x for x in start if isinstance(following[x], int) and following[x] == x}
    return {x: following[x] for x in start if x in needed - same}


def split(body: FlatProgram, values: Sequence[Value], row: Sequence[Any]) -> list[list[Any]]:
    """A row of all elements of several values, divided among them."""
    rest, parts = list(row), []
    for value in values:
        size = body.aval(value).size
        parts.append(rest[:size])
        rest = rest[size:]
    assert not rest
    return parts
