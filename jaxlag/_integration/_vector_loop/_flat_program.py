"""A program as a flat list of operations, with calls replaced by what they call."""

from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal

from jaxlag._core._arrays import concrete
from jaxlag._core._jaxprs import called
from jaxlag._core._linear_map import program_of
from jaxlag._tracing._interpret import held

BARRIER = "optimization_barrier"

Value = int | np.ndarray
"""A value of the program by its number, or a constant."""


class Operation(NamedTuple):
    """One operation.

    Attributes:
        primitive: what it does.
        params: its parameters.
        operands: what it reads.
        results: numbers of its results.
    """

    primitive: Any
    params: Any
    operands: tuple[Value, ...]
    results: tuple[int, ...]

    @property
    def name(self) -> str:
        """The name of its primitive."""
        return self.primitive.name

    def __call__(self, *operands: Any) -> Sequence[Any]:
        """Its results at other operands."""
        params = self.primitive.get_bind_params(self.params)
        found = self.primitive.bind(*operands, **params)
        return found if self.primitive.multiple_results else [found]


class FlatProgram(NamedTuple):
    """Operations in their order.

    Attributes:
        operations: none of them is a call.
        consts: numbers of the traced constants.
        inputs: numbers of the arguments.
        outputs: the results.
        avals: shape and dtype of every value.
    """

    operations: list[Operation]
    consts: tuple[int, ...]
    inputs: tuple[int, ...]
    outputs: tuple[Value, ...]
    avals: list[Any]

    def aval(self, value: Value) -> Any:
        """Its shape and dtype."""
        return self.avals[value] if isinstance(value, int) else value

    def last(self, count: int) -> tuple[Value, ...]:
        """The last outputs."""
        return self.outputs[len(self.outputs) - count :]

    def needed(self, values: Iterable[Value], known: Collection[int] = ()) -> list[Operation]:
        """The operations that these values depend on, in their order.

        Args:
            values: some of its values.
            known: values that need no operations.
        """
        wanted = ids(values).difference(known)
        found = []
        for operation in reversed(self.operations):
            if wanted.intersection(operation.results):
                found.append(operation)
                wanted.update(ids(operation.operands).difference(known))
        return found[::-1]

    def read_by(self, operations: Iterable[Operation], values: Iterable[Value] = ()) -> set[int]:
        """Values that operations read, and these, apart from results of the operations."""
        read, made = ids(values), set[int]()
        for operation in operations:
            read |= ids(operation.operands)
            made |= set(operation.results)
        return read - made

    def evaluate(
        self, operations: Iterable[Operation], known: dict[int, Any], values: Iterable[Value]
    ) -> list[Any]:
        """These values by some of its operations.

        Args:
            operations: those that the values need.
            known: what they start from.
            values: what is looked up.
        """
        known = dict(known)

        def read(value: Value) -> Any:
            return known[value] if isinstance(value, int) else value

        for operation in operations:
            found = operation(*map(read, operation.operands))
            known |= dict(zip(operation.results, found, strict=True))
        return list(map(read, values))

    def __call__(self, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
        """The outputs."""
        known = dict(zip((*self.consts, *self.inputs), (*consts, *inputs), strict=True))
        return self.evaluate(self.operations, known, self.outputs)


def ids(values: Iterable[Value]) -> set[int]:
    """The numbers of those that are no constants."""
    return {value for value in values if isinstance(value, int)}


def flat(function: Callable, *args: Any) -> tuple[FlatProgram, list[Any]]:
    """The flat program of a function, and its traced constants."""
    program = jax.make_jaxpr(function)(*args)
    return _flat_program(program), [x for x in program.consts if isinstance(x, Tracer)]


def _flat_program(program: ClosedJaxpr) -> FlatProgram:
    avals: list[Any] = []
    operations: list[Operation] = []

    def new(var: Any) -> int:
        avals.append(var.aval)
        return len(avals) - 1

    def add(code: ClosedJaxpr, consts: Sequence[Value], given: Sequence[Value]) -> list[Value]:
        jaxpr = code.jaxpr
        values: dict[Any, Value] = dict(zip(jaxpr.constvars, consts, strict=True))
        values |= dict(zip(jaxpr.invars, given, strict=True))

        def read(atom: Any) -> Value:
            if isinstance(atom, Literal):
                aval: Any = atom.aval
                return np.asarray(atom.val, aval.dtype)
            return values[atom]

        for eqn in jaxpr.eqns:
            operands = tuple(map(read, eqn.invars))
            inner, results = called(eqn) or program_of(eqn), list[Value]()
            if inner is not None and concrete(inner.consts):
                results = add(inner, list(map(held, inner.consts)), operands)
            else:
                made = tuple(map(new, eqn.outvars))
                operations.append(Operation(eqn.primitive, eqn.params, operands, made))
                results += made
            values |= dict(zip(eqn.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    jaxpr = program.jaxpr
    consts: list[Value] = [
        new(var) if isinstance(x, Tracer) else held(x)
        for var, x in zip(jaxpr.constvars, program.consts, strict=True)
    ]
    inputs = list(map(new, jaxpr.invars))
    outputs = add(program, consts, inputs)
    traced = tuple(x for x in consts if isinstance(x, int))
    return FlatProgram(operations, traced, tuple(inputs), tuple(outputs), avals)
