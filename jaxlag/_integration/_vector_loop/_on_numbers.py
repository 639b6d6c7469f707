"""Programs on small arrays as programs on numbers: every element is a number of its own."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxlag._core._xla import ELEMENTWISE
from jaxlag._integration._vector_loop._flat_program import (
    BARRIER,
    FlatProgram,
    Operation,
    Value,
    flat,
)
from jaxlag._tracing._interpret import NUMPY, PARTS

_MOVES = frozenset(
    """broadcast_in_dim concatenate pad reshape rev slice split squeeze stack transpose
    unstack""".split()  # noqa: SIM905
)
# A power with a constant exponent up to this, as in step-size controllers, is exp(y log x). It has
# vector code. Its error is (1 + |y log x|) eps.
ROOTS = 0.5
# What all trajectories have in common, any or max, decides only whether work is done. For one of
# them its own value does.
_SAME = frozenset(("unvmap_all", "unvmap_any", "unvmap_max"))
_REDUCTIONS = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}
_COMBINED = frozenset(_REDUCTIONS) | {"dot_general"}
_SUPPORTED = ELEMENTWISE | _MOVES | _SAME | _COMBINED | {"add_any", "iota", BARRIER}


def is_supported(program: FlatProgram, operation: Operation) -> bool:
    """Whether the operation has a form on numbers."""
    given = [program.aval(x) for x in operation.operands]
    if operation.name in _COMBINED and not all(x.size for x in given):
        return False  # the value of nothing
    if operation.name == "bitcast_convert_type":
        return given[0].shape == program.aval(operation.results[0]).shape
    return operation.name in _SUPPORTED


def numbers_of(array: Any) -> np.ndarray:
    """The elements of a constant."""
    array = np.asarray(array)
    return _objects(array.shape, [np.asarray(x, array.dtype) for x in array.ravel()])


def on_numbers(
    program: FlatProgram, sources: Sequence[int], targets: Sequence[Value]
) -> FlatProgram:
    """The program of all elements of `targets` as functions of all elements of `sources`."""
    operations = program.needed(targets, sources)

    def function(*numbers: Any) -> list[Any]:
        given, values = iter(numbers), dict[int, np.ndarray]()
        for source in sources:
            shape = program.avals[source].shape
            values[source] = _objects(shape, [next(given) for _ in range(int(np.prod(shape)))])

        def read(value: Value) -> np.ndarray:
            return values[value] if isinstance(value, int) else numbers_of(value)

        for operation in operations:
            avals = [program.avals[result] for result in operation.results]
            found = _executed(operation, list(map(read, operation.operands)), avals[0].shape)
            values |= dict(zip(operation.results, found, strict=True))
        return [jnp.asarray(x) for target in targets for x in read(target).ravel()]

    kinds = [program.avals[source] for source in sources]
    inputs = [
        jax.ShapeDtypeStruct((), x.dtype) for x in kinds for _ in range(int(np.prod(x.shape)))
    ]
    return flat(function, *inputs)[0]


def _executed(
    operation: Operation, operands: list[np.ndarray], shape: tuple[int, ...]
) -> Sequence[np.ndarray]:
    name = operation.name
    if name in _SAME:
        return operands
    if name == BARRIER:
        return [
            _objects(x.shape, [_element(operation, number) for number in x.ravel()])
            for x in operands
        ]
    if name in ELEMENTWISE or name == "add_any":
        wide = [np.broadcast_to(x, shape).ravel() for x in operands]
        return [_objects(shape, [_element(operation, *x) for x in zip(*wide, strict=True)])]
    if name in _MOVES:
        return _moved(operation, operands)
    if name == "dot_general":
        return [_product(operation, operands, shape)]
    if name in _REDUCTIONS:
        return [_reduced(_REDUCTIONS[name], operands[0], operation.params["axes"])]
    with jax.ensure_compile_time_eval():
        return [numbers_of(operation()[0])]


def _moved(operation: Operation, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The results of an operation that moves elements, found by moving their positions."""
    elements, places = np.concatenate([x.ravel() for x in operands]), list[np.ndarray]()
    for x in operands:
        start = sum(y.size for y in places)
        places.append(np.arange(start, start + x.size).reshape(x.shape))
    name = operation.name
    found = PARTS[name](operation, *places) if name in PARTS else [NUMPY[name](operation, *places)]
    return [elements[np.ravel(x)].reshape(np.shape(x)) for x in found]


def _element(operation: Operation, *numbers: Any) -> Any:
    if operation.name == "add_any":  # cotangents, many of which are 0
        x, y = numbers
        return y if _is_zero(x) else x if _is_zero(y) else lax.add(*map(jnp.asarray, numbers))
    if operation.name == "pow":
        x, y = numbers
        if isinstance(y, np.ndarray) and 0.0 < abs(y) <= ROOTS:
            root = lax.exp(y * lax.log(lax.abs(x)))
            return jnp.where((x < 0.0) & (x > -jnp.inf), jnp.nan, root)
    if operation.name in ("sqrt", "rsqrt"):
        # XLA makes one operation of a division by a root, which has no vector code.
        (x,) = map(jnp.asarray, numbers)
        root = lax.select(x < 0.0, jnp.full_like(x, jnp.nan), lax.sqrt(x))
        return root if operation.name == "sqrt" else 1.0 / root
    return operation(*map(jnp.asarray, numbers))[0]


def _is_zero(number: Any) -> bool:
    return isinstance(number, np.ndarray) and not number.any()


def _product(
    operation: Operation, operands: Sequence[np.ndarray], shape: tuple[int, ...]
) -> np.ndarray:
    a, b = operands
    ((left, right), (left_batch, right_batch)) = operation.params["dimension_numbers"]

    def rows(array: np.ndarray, batch: Sequence[int], summed: Sequence[int]) -> np.ndarray:
        """(batch, free, summed)."""
        free = [axis for axis in range(array.ndim) if axis not in (*batch, *summed)]
        sizes = [int(np.prod([array.shape[i] for i in axes])) for axes in (batch, free, summed)]
        return array.transpose(*batch, *free, *summed).reshape(sizes)

    pairs = zip(rows(a, left_batch, left), rows(b, right_batch, right), strict=True)
    found = [
        reduce(lax.add, [lax.mul(*map(jnp.asarray, xy)) for xy in zip(x, y, strict=True)])
        for one, other in pairs
        for x in one
        for y in other
    ]
    return _objects(shape, found)


def _reduced(combine: Callable, array: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    rest = [axis for axis in range(array.ndim) if axis not in axes]
    shape = tuple(array.shape[axis] for axis in rest)
    rows = array.transpose(*rest, *axes).reshape(int(np.prod(shape)), -1)
    return _objects(shape, [reduce(combine, row) for row in rows])


def _objects(shape: tuple[int, ...], numbers: Sequence[Any]) -> np.ndarray:
    out = np.empty(len(numbers), object)
    for i, number in enumerate(numbers):
        out[i] = number
    return out.reshape(shape)
