"""Fewer divisions: these take as long as ten other operations."""

from collections import Counter

import jax
import numpy as np
from jax import lax

from jaxlag._integration._vector_loop._flat_program import (
    BARRIER,
    FlatProgram,
    Operation,
    Value,
)


def with_fewer_divisions(program: FlatProgram) -> FlatProgram:
    """The program with x / (1 / y) = x y, and x / y = x (1 / y) for a y that divides twice or more.

    Each changes a quotient by up to 1 eps, for |y| from 1e-308 to 1e308.

    Args:
        program: on numbers.
    """
    divisions = [x for x in program.operations if _divides(program, x)]
    counts = Counter(x.operands[1] for x in divisions if isinstance(x.operands[1], int))
    product = jax.make_jaxpr(lax.mul)(1.0, 1.0).eqns[0].params
    inverse: dict[int, Value] = {}
    operations, avals = list[Operation](), list(program.avals)
    for operation in program.operations:
        if not _divides(program, operation):
            operations.append(operation)
            value = operation.operands[0] if operation.name == BARRIER else None
            if isinstance(value, int) and value in inverse:
                inverse[operation.results[0]] = inverse[value]
            continue
        x, y = operation.operands
        if isinstance(y, int) and y not in inverse and counts[y] > 1:
            avals.append(avals[y])
            inverse[y] = len(avals) - 1
            one = np.ones((), avals[y].dtype)
            operations.append(Operation(lax.div_p, {}, (one, y), (len(avals) - 1,)))
        if isinstance(y, int) and y in inverse:
            operation = Operation(lax.mul_p, product, (x, inverse[y]), operation.results)
        elif isinstance(y, int) and not isinstance(x, int) and x == 1.0:
            inverse[operation.results[0]] = y
        operations.append(operation)
    return program._replace(operations=operations, avals=avals)


def _divides(program: FlatProgram, operation: Operation) -> bool:
    kind = program.avals[operation.results[0]].dtype
    return operation.primitive is lax.div_p and jax.numpy.issubdtype(kind, jax.numpy.floating)
