"""Scalar nodes from a jaxpr: the user's program is run on arrays of nodes.

An array is a numpy array of nodes (dtype object). If its values are known while tracing
(constants, indices, shapes), it is an ordinary numpy array. Operations that only move elements run
once on an array of positions. JAX itself evaluates operations on known values.
"""

from collections.abc import Callable, Container, Sequence
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxlag._core._arrays import concrete
from jaxlag._core._custom_jvp import with_rule_kept
from jaxlag._core._jaxprs import called, scan_sizes
from jaxlag._lowering._graph._expression import Graph, Node, named
from jaxlag._lowering._jaxpr._array_primitives import MOVES, SHIFTS, WHOLE, move
from jaxlag._lowering._jaxpr._elementwise_primitives import ELEMENTWISE, elementwise
from jaxlag._lowering._jaxpr._node_arrays import Missing, broadcast, each, nodes
from jaxlag._tracing._interpret import NUMPY, equation, held

LIMIT = 50_000  # nodes of a graph: far beyond the useful size of a scalar program
MAX_ITERATIONS = 10_000  # largest number of iterations of an unrolled loop


class Unsupported(Exception):
    """An operation without scalar form, with its place in the user's source."""


class Rule:
    """One call of a function with a custom derivative rule.

    Attributes:
        avals: shapes and dtypes of its operands.
        call: the function on arrays, with its rule.
        body: its program without the rule.
    """

    def __init__(self, eqn: Any) -> None:
        self.eqn = eqn = with_rule_kept(eqn)
        self.avals = [v.aval for v in eqn.invars]
        self.shapes = [v.aval.shape for v in eqn.outvars]
        self.body: ClosedJaxpr = eqn.params["call_jaxpr"]
        known = None if self.body.consts else (str(self.body), eqn.params["rule"].key)
        self.key = known or id(self)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Rule) and self.key == other.key

    def call(self, *operands: Any) -> list[Any]:
        """The results, as arrays; derivatives use the rule."""
        return self.eqn.primitive.bind(*operands, **self.eqn.params)

    @cached_property
    def tangents(self) -> ClosedJaxpr:
        """The program (operands, their tangents) -> tangents of the results."""

        def along(operands: Sequence[Any], tangents: Sequence[Any]) -> Sequence[Any]:
            return jax.jvp(self.call, operands, tangents)[1]

        given = tuple(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in self.avals)
        return jax.make_jaxpr(along)(given, given)

    def flat(self, arrays: Sequence[np.ndarray]) -> tuple[Node, ...]:
        """All elements of the operands in one row."""
        return tuple(node for array in arrays for node in array.ravel())

    def unflat(self, nodes: Sequence[Any]) -> list[np.ndarray]:
        """Inverse of `flat`."""
        arrays, start = [], 0
        for aval in self.avals:
            array = np.empty(aval.size, object)
            array[:] = nodes[start : start + aval.size]
            arrays.append(array.reshape(aval.shape))
            start += aval.size
        return arrays


def read(
    graph: Graph, closed: ClosedJaxpr, *args: np.ndarray, once: Container[str] = ()
) -> list[np.ndarray]:
    """The results of a program on arrays of nodes.

    Args:
        graph: of all nodes.
        closed: the program.
        args: its arguments.
        once: names of primitives whose results are computed once: no sum or product opens them.

    Raises:
        Unsupported: an operation without scalar form, with its place in the user's source.
    """
    if not concrete(*closed.consts):
        raise Unsupported("a value traced by a transform comes from outside the arguments")
    before, graph.once = graph.once, once
    try:
        return _read(graph, closed, *args)
    except Missing as missing:
        raise Unsupported(str(missing)) from None
    finally:
        graph.once = before


def _read(graph: Graph, closed: ClosedJaxpr, *args: Any) -> list:
    return _run(graph, closed.jaxpr, list(map(held, closed.consts)), list(args))


def _run(graph: Graph, jaxpr: Jaxpr, consts: list, args: list) -> list:
    known: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    known.update(zip(jaxpr.invars, args, strict=True))

    def value(atom: Any) -> Any:
        return held(atom.val) if isinstance(atom, Literal) else known[atom]

    for eqn in jaxpr.eqns:
        operands = [value(atom) for atom in eqn.invars]
        try:
            results = _equation(graph, eqn, operands)
        except Missing as missing:
            # Operations inside JAX functions have no user line: the line of the call is used.
            where = source_info_util.summarize(eqn.source_info)
            if not where:
                raise
            raise Unsupported(f"{missing} at {where}") from None
        if len(graph.nodes) > LIMIT:
            raise Unsupported(f"more than {LIMIT} scalar operations")
        if eqn.primitive.name in graph.once:
            results = [each(graph.let, array) for array in results]
        for var, array in zip(eqn.outvars, results, strict=True):
            # An empty array contains no nodes: its values are known.
            empty = array.dtype == object and array.size == 0
            aval: Any = var.aval
            known[var] = np.zeros(aval.shape, aval.dtype) if empty else array
    return [value(atom) for atom in jaxpr.outvars]


def _equation(graph: Graph, eqn: Any, operands: list) -> list:
    name = eqn.primitive.name
    if not any(array.dtype == object for array in operands) and name != "while":
        return known_results(eqn, operands)
    if name in _CONTROL:
        return _CONTROL[name](graph, eqn, operands)
    inner = None if name.startswith("custom_vjp_call") else called(eqn)
    if inner is not None:
        return _read(graph, inner, *operands)
    _check_kinds(eqn, operands)
    if name in MOVES:
        return move(graph, eqn, operands)
    if name in WHOLE:
        return [WHOLE[name](graph, eqn, operands)]
    if name in ELEMENTWISE:
        return [elementwise(graph, eqn, operands)]
    raise Missing(name)


def known_results(eqn: Any, operands: list) -> list:
    """The results of one equation at known values.

    JAX computes them and compiles each operation; exact ones are computed by numpy.
    """
    name = eqn.primitive.name
    if name in SHIFTS:
        return [np.asarray(NUMPY[name](eqn, *operands))]
    if name == "iota" or _exact(eqn):
        with np.errstate(all="ignore"):
            return equation(eqn, operands)
    params = eqn.primitive.get_bind_params(eqn.params)
    with jax.ensure_compile_time_eval():
        found = eqn.primitive.bind(*operands, **params)
    return [held(x) for x in (found if eqn.primitive.multiple_results else [found])]


def _exact(eqn: Any) -> bool:
    """Whether numpy's result is JAX's: arithmetic of integers and truth values, conversions."""
    name = eqn.primitive.name
    if name not in _EXACT:
        return False
    kinds = [v.aval.dtype for v in (*eqn.invars, *eqn.outvars)]
    whole = [kind == np.bool_ or jax.dtypes.issubdtype(kind, np.integer) for kind in kinds]
    if name == "convert_element_type":
        return whole[0] or kinds[0] == kinds[1]
    return all(whole) and (name != "select_n" or kinds[0] == np.bool_)


_EXACT = {"add", "sub", "mul", "neg", "eq", "ne", "lt", "le", "gt", "ge", "max", "min"}
_EXACT |= {"select_n", "reduce_sum", "cumsum", "convert_element_type"}


def _check_kinds(eqn: Any, operands: list) -> None:
    """Raise on integers and truth values unless real arithmetic gives the same result."""
    name = eqn.primitive.name
    kinds = [v.aval.dtype for v, x in zip(eqn.invars, operands, strict=True) if x.dtype == object]
    if name not in _OF_TRUTHS and any(kind == np.bool_ for kind in kinds):
        raise Missing(f"{name} of booleans")
    whole = [kind for kind in kinds if np.issubdtype(kind, np.integer)]
    if whole and (name not in _OF_INTEGERS or any(kind.itemsize < 4 for kind in whole)):
        raise Missing(f"{name} of integers")


_OF_TRUTHS = {"and", "or", "xor", "not", "eq", "ne", "select_n", "convert_element_type"}
_OF_TRUTHS |= {"reduce_and", "reduce_or", "argmax", "argmin", "stop_gradient", *MOVES}
_OF_INTEGERS = {"add", "sub", "mul", "neg", "eq", "ne", "lt", "le", "gt", "ge", "max", "min"}
_OF_INTEGERS |= {"select_n", "convert_element_type", "reduce_sum", "reduce_max", "reduce_min"}
_OF_INTEGERS |= {"stop_gradient", "cumsum", "clamp", "argmax", "argmin", *MOVES}


# ---- Calls and control flow ------------------------------------------------------------------


def _custom_jvp(graph: Graph, eqn: Any, operands: list) -> list:
    rule = Rule(eqn)
    if not all(jax.numpy.issubdtype(aval.dtype, np.floating) for aval in rule.avals):
        raise Missing("custom_jvp of values that are not real numbers")
    args = rule.flat([nodes(graph, array) for array in operands])
    results, index = [], 0
    for shape in rule.shapes:
        array = np.empty(int(np.prod(shape)), object)
        for i in range(array.size):
            array[i] = graph.custom(rule, index, args)
            index += 1
        results.append(array.reshape(shape))
    return results


def _scan(graph: Graph, eqn: Any, operands: list) -> list:
    params, closed = eqn.params, eqn.params["jaxpr"]
    fixed, carried = scan_sizes(params)
    consts, carry = operands[:fixed], operands[fixed : fixed + carried]
    rows, length = operands[fixed + carried :], params["length"]
    if length > MAX_ITERATIONS:
        raise Missing(f"scan of length {length}")
    stacked: list[list] = [[] for _ in eqn.outvars[carried:]]
    for i in reversed(range(length)) if params["reverse"] else range(length):
        results = _read(graph, closed, *consts, *carry, *(np.asarray(row[i]) for row in rows))
        carry = results[:carried]
        for column, result in zip(stacked, results[carried:], strict=True):
            column.append(result)
    if params["reverse"]:
        stacked = [column[::-1] for column in stacked]
    shapes = [v.aval.shape for v in eqn.outvars[carried:]]
    return [
        *carry,
        *(_stack(graph, column, s) for column, s in zip(stacked, shapes, strict=True)),
    ]


def _stack(graph: Graph, column: list, shape: tuple) -> np.ndarray:
    if any(array.dtype == object for array in column):
        column = [nodes(graph, array) for array in column]
    return np.stack(column) if column else np.zeros(shape)


def _while(graph: Graph, eqn: Any, operands: list) -> list:
    params = eqn.params
    of_condition, of_body = params["cond_nconsts"], params["body_nconsts"]
    condition_consts = operands[:of_condition]
    body_consts = operands[of_condition : of_condition + of_body]
    carry = operands[of_condition + of_body :]
    for _ in range(MAX_ITERATIONS):
        (going,) = _read(graph, params["cond_jaxpr"], *condition_consts, *carry)
        if going.dtype == object:
            if going.item().op != "const":
                raise Missing("while with a condition that depends on values")
            going = np.asarray(going.item().data)
        if not going:
            return carry
        carry = _read(graph, params["body_jaxpr"], *body_consts, *carry)
    raise Missing(f"while of more than {MAX_ITERATIONS} iterations")


def _cond(graph: Graph, eqn: Any, operands: list) -> list:
    index, *rest = operands
    branches = eqn.params["branches"]
    if index.dtype != object:
        return _read(graph, branches[int(np.clip(index, 0, len(branches) - 1))], *rest)
    results = [_read(graph, branch, *rest) for branch in branches]
    chosen = results[0]
    for k in range(1, len(branches)):
        at_least = graph.call(named("ge"), index.item(), graph.const(float(k)))
        chosen = [
            broadcast(graph, lambda a, b, at_least=at_least: graph.select(at_least, b, a), *pair)
            for pair in zip(chosen, results[k], strict=True)
        ]
    return chosen


_CONTROL: dict[str, Callable] = {
    "custom_jvp_call": _custom_jvp,
    "scan": _scan,
    "while": _while,
    "cond": _cond,
}
