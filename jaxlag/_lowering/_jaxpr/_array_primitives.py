"""Array primitives on nodes: moves of elements, sums and products along axes."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product as every
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlag._lowering._graph._expression import LARGEST, SMALLEST, Graph, Node, Primitive, named
from jaxlag._lowering._jaxpr._node_arrays import Missing, broadcast, nodes, scalar, take
from jaxlag._tracing._interpret import NUMPY

# ---- Moving elements -------------------------------------------------------------------------

# Number of leading operands with elements; the rest are indices. None: all have elements.
MOVES: dict[str, int | None] = {
    "broadcast_in_dim": 1,
    "reshape": 1,
    "transpose": None,
    "squeeze": None,
    "expand_dims": None,
    "rev": None,
    "slice": None,
    "concatenate": None,
    "stack": None,
    "unstack": None,
    "split": None,
    "pad": None,
    "tile": None,
    "copy": None,
    "copy_p": None,
    "dynamic_slice": 1,
    "dynamic_update_slice": 2,
    "gather": 1,
}


# Those among them that the interpreter has in numpy; nothing else is common to both.
SHIFTS = frozenset(MOVES) & frozenset(NUMPY)


def move(graph: Graph, eqn: Any, operands: list) -> list:
    """Run the primitive on an array of positions of all elements."""
    count = MOVES[eqn.primitive.name]
    count = len(operands) if count is None else count
    data, indices = operands[:count], operands[count:]
    if any(array.dtype == object for array in indices):
        raise Missing(f"{eqn.primitive.name} with an index that depends on values")
    pool = [node for array in data for node in nodes(graph, array).ravel()]
    row = np.empty(len(pool) + 1, object)
    row[:-1] = pool
    if "fill_value" in eqn.params:  # outside of the array; NaN by default
        given = eqn.params["fill_value"]
        row[-1] = graph.const(np.nan if given is None else float(given))
    moved = moved_positions(eqn, [array.shape for array in data], indices)
    return [row[index] if np.ndim(index) else scalar(row[int(index)]) for index in moved]


def moved_positions(
    eqn: Any, shapes: Sequence[tuple[int, ...]], indices: Sequence[Any]
) -> list[np.ndarray]:
    """The results of a primitive of `MOVES` on the positions of all elements.

    Args:
        eqn: the equation.
        shapes: of the operands that have elements, which come first.
        indices: the others.

    Returns:
        Positions in all elements, one operand after the other; their number stands for the value
        outside of an array.
    """
    positions, size = [], 0
    for shape in shapes:
        count = int(np.prod(shape))
        positions.append(np.arange(size, size + count, dtype=np.int32).reshape(shape))
        size += count
    params = dict(eqn.params)
    if "fill_value" in params:
        params["fill_value"] = size
    if eqn.primitive.name in SHIFTS:  # with numpy: JAX would compile each
        return [np.asarray(NUMPY[eqn.primitive.name](eqn, *positions, *indices))]
    with jax.ensure_compile_time_eval():
        moved = eqn.primitive.bind(*map(jnp.asarray, (*positions, *indices)), **params)
    return [np.asarray(x) for x in (moved if eqn.primitive.multiple_results else [moved])]


def _scatter(graph: Graph, eqn: Any, operands: list) -> np.ndarray:
    params = dict(eqn.params)
    return _moved_scatter(graph, eqn.primitive, params, operands)


def _moved_scatter(graph: Graph, primitive: Any, params: dict, operands: list) -> np.ndarray:
    operand, indices, updates = operands
    if indices.dtype == object:
        raise Missing(f"{primitive.name} with an index that depends on values")
    operand, updates = nodes(graph, operand), nodes(graph, updates)
    pool = [*operand.ravel(), *updates.ravel()]
    positions = np.arange(operand.size, dtype=np.int32).reshape(operand.shape)
    incoming = operand.size + np.arange(updates.size, dtype=np.int32).reshape(updates.shape)
    with jax.ensure_compile_time_eval():
        bind = jax.lax.scatter_p.bind
        params = params | {"update_jaxpr": None, "update_consts": ()}
        moved = np.asarray(bind(*map(jnp.asarray, (positions, indices, incoming)), **params))
    return take(pool, moved)


def _scatter_with(combine: Callable) -> Callable:
    """Scatter that combines updates with elements; the target of each update is found singly."""

    def scattered(graph: Graph, eqn: Any, operands: list) -> np.ndarray:
        operand, indices, updates = operands
        if indices.dtype == object:
            raise Missing(f"{eqn.primitive.name} with an index that depends on values")
        operand, updates = nodes(graph, operand), nodes(graph, updates)
        size = updates.size
        p = eqn.params
        with jax.ensure_compile_time_eval():
            ones = jnp.eye(size).reshape(size, *updates.shape)
            into, where = jnp.zeros(operand.shape), jnp.asarray(indices)
            add = partial(
                jax.lax.scatter_add, dimension_numbers=p["dimension_numbers"], mode=p["mode"]
            )
            landed = [np.ravel(add(into, where, one)) != 0 for one in ones]
        row = updates.ravel()
        joined = [
            combine(graph, [node, *(row[k] for k in range(size) if landed[k][i])])
            for i, node in enumerate(operand.ravel())
        ]
        return take(joined, np.arange(operand.size).reshape(operand.shape))

    return scattered


# ---- Sums and products -----------------------------------------------------------------------


def _dot_general(graph: Graph, eqn: Any, operands: list) -> np.ndarray:
    ((left, right), (left_batch, right_batch)) = eqn.params["dimension_numbers"]
    a, b = (nodes(graph, array) for array in operands)

    def arranged(array: np.ndarray, batch: Any, summed: Any, last: bool) -> np.ndarray:
        free = [i for i in range(array.ndim) if i not in (*batch, *summed)]
        size = int(np.prod([array.shape[i] for i in summed]))
        array = array.transpose(*batch, *free, *summed)
        return array.reshape(*array.shape[: array.ndim - len(summed)], size)

    a, b = arranged(a, left_batch, left, True), arranged(b, right_batch, right, True)
    batch = a.shape[: len(left_batch)]
    rows, columns = a.shape[len(batch) : -1], b.shape[len(batch) : -1]
    out = np.empty((*batch, *rows, *columns), object)
    for k in every(*map(range, batch)):
        for i in every(*map(range, rows)):
            for j in every(*map(range, columns)):
                pairs = zip(a[k + i], b[k + j], strict=True)
                out[k + i + j] = graph.sum([(graph.mul(x, y), 1.0) for x, y in pairs])
    return out


def _reduce(combine: Callable) -> Callable:
    def reduced(graph: Graph, eqn: Any, operands: list) -> np.ndarray:
        (array,) = operands
        axes = tuple(eqn.params["axes"])
        remaining = [i for i in range(array.ndim) if i not in axes]
        shape = tuple(array.shape[i] for i in remaining)
        size = int(np.prod([array.shape[i] for i in axes]))
        rows = array.transpose(*remaining, *axes).reshape(int(np.prod(shape)), size)
        return take(
            [combine(graph, list(row)) for row in rows], np.arange(len(rows)).reshape(shape)
        )

    return reduced


def _sum(graph: Graph, nodes: list[Node]) -> Node:
    return graph.sum([(node, 1.0) for node in nodes])


def _product(graph: Graph, nodes: list[Node]) -> Node:
    return graph.mul(*nodes)


def _pairwise(name: str) -> Callable:
    def combine(graph: Graph, nodes: list[Node]) -> Node:
        first, *rest = nodes
        for node in rest:
            first = graph.call(named(name), first, node)
        return first

    return combine


def _of_row(name: str, many: Primitive) -> Callable:
    """The largest, or smallest; of two nodes by the primitive for two."""
    pair = _pairwise(name)

    def combine(graph: Graph, nodes: list[Node]) -> Node:
        return pair(graph, nodes) if len(nodes) < 3 else graph.call(many, *nodes)

    return combine


_LARGEST, _SMALLEST = _of_row("max", LARGEST), _of_row("min", SMALLEST)


def _scanned(combine: Callable) -> Callable:
    """Running extremes in the pairing of JAX's scan, so that ties share the derivative equally."""

    def scan(graph: Graph, rows: list[np.ndarray]) -> list[np.ndarray]:
        if len(rows) < 2:
            return rows

        def joined(left: list[np.ndarray], right: list[np.ndarray]) -> list[np.ndarray]:
            pairs = zip(left, right, strict=False)
            return [broadcast(graph, lambda a, b: combine(graph, [a, b]), x, y) for x, y in pairs]

        odd = scan(graph, joined(rows[:-1:2], rows[1::2]))
        out = list(rows)
        out[1::2] = odd
        out[2::2] = joined(odd, rows[2::2])
        return out

    def running(graph: Graph, eqn: Any, operands: list) -> np.ndarray:
        array = np.moveaxis(operands[0], eqn.params["axis"], 0)
        array = array[::-1] if eqn.params["reverse"] else array
        out = array.copy()
        for i, row in enumerate(scan(graph, [array[i : i + 1] for i in range(len(array))])):
            out[i : i + 1] = row
        out = out[::-1] if eqn.params["reverse"] else out
        return np.moveaxis(out, 0, eqn.params["axis"])

    return running


def _cumulative(combine: Callable) -> Callable:
    def running(graph: Graph, eqn: Any, operands: list) -> np.ndarray:
        array = np.moveaxis(operands[0], eqn.params["axis"], 0)
        array = array[::-1] if eqn.params["reverse"] else array
        out = array.copy()
        for i in range(1, len(array)):
            last, here = out[i - 1 : i], array[i : i + 1]
            out[i : i + 1] = broadcast(graph, lambda a, b: combine(graph, [a, b]), last, here)
        out = out[::-1] if eqn.params["reverse"] else out
        return np.moveaxis(out, 0, eqn.params["axis"])

    return running


def _extreme(name: str) -> Callable:
    """Index of the first largest or smallest element, as a number."""

    def found(graph: Graph, eqn: Any, operands: list) -> np.ndarray:
        (axis,) = eqn.params["axes"]
        array = np.moveaxis(nodes(graph, operands[0]), axis, -1)
        truths = eqn.invars[0].aval.dtype == np.bool_
        out = np.empty(array.shape[:-1], object)
        for place in np.ndindex(out.shape):
            row = [graph.select(x, graph.one, graph.zero) if truths else x for x in array[place]]
            best, index = row[0], graph.zero
            for k, x in enumerate(row[1:], start=1):
                beats = graph.call(named(name), x, best)
                best = graph.select(beats, x, best)
                index = graph.select(beats, graph.const(float(k)), index)
            out[place] = index
        return out

    return found


WHOLE: dict[str, Callable] = {
    "scatter": _scatter,
    "scatter-add": _scatter_with(_sum),
    "scatter-mul": _scatter_with(_product),
    "scatter-min": _scatter_with(_SMALLEST),
    "scatter-max": _scatter_with(_LARGEST),
    "argmax": _extreme("gt"),
    "argmin": _extreme("lt"),
    "dot_general": _dot_general,
    "reduce_sum": _reduce(_sum),
    "reduce_prod": _reduce(_product),
    "reduce_max": _reduce(_LARGEST),
    "reduce_min": _reduce(_SMALLEST),
    "reduce_and": _reduce(_pairwise("and")),
    "reduce_or": _reduce(_pairwise("or")),
    "cumsum": _cumulative(_sum),
    "cumprod": _cumulative(_product),
    "cummax": _scanned(_pairwise("max")),
    "cummin": _scanned(_pairwise("min")),
}
