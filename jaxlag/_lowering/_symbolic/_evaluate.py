"""Numeric evaluation of a graph: the interpreter that checks compiled programs."""

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import jax
import numpy as np

from jaxlag._lowering._graph._expression import Node, order
from jaxlag._tracing._interpret import interpret


def evaluate(roots: Sequence[Node], values: Mapping[tuple[str, int], Any]) -> list:
    """The roots at given values of the inputs, arrays of one shape with one entry per state."""
    known: dict[Node, Any] = {}
    with np.errstate(all="ignore"):
        for node in order(roots):
            known[node] = value(node, [known[arg] for arg in node.args], values)
    return [known[root] for root in roots]


def value(node: Node, args: list, values: Mapping[tuple[str, int], Any]) -> Any:
    """The value of a node from those of its arguments, or of the inputs."""
    if node.op == "const":
        return np.asarray(node.data)
    if node.op == "input":
        return np.asarray(values[node.data])
    if node.op == "sum":
        constant, terms = node.data
        return constant + sum(c * x for x, (_, c) in zip(args, terms, strict=True))
    if node.op == "product":
        out = np.asarray(1.0)
        for x, (_, exponent) in zip(args, node.data, strict=True):
            out = out * np.asarray(x) ** float(exponent)
        return out
    if node.op == "select":
        return np.where(*args)
    if node.op in ("stop", "let"):
        return args[0]
    if node.op == "custom":
        rule, index = node.data
        shape = np.broadcast_shapes(*(np.shape(x) for x in args))
        rows = [np.broadcast_to(x, shape).ravel() for x in args]
        out = np.empty(int(np.prod(shape)))
        for k in range(out.size):
            operands = [
                array.astype(aval.dtype)
                for array, aval in zip(
                    rule.unflat([row[k] for row in rows]), rule.avals, strict=True
                )
            ]
            out[k] = np.concatenate([np.ravel(r) for r in interpret(rule.body, *operands)])[index]
        return out.reshape(shape)
    if node.data.name in _NUMPY:
        return _NUMPY[node.data.name](*args)
    with jax.ensure_compile_time_eval():
        return np.asarray(node.data(*np.broadcast_arrays(*args)))


_NUMPY = {name: getattr(np, name) for name in ("sin", "cos", "tan", "sqrt", "exp", "log", "tanh")}
_NUMPY |= {"atan2": np.arctan2, "abs": np.abs, "ge": np.greater_equal, "lt": np.less}
_NUMPY |= {
    "largest": lambda *xs: reduce(np.maximum, xs),
    "smallest": lambda *xs: reduce(np.minimum, xs),
}
_NUMPY |= {"gt": np.greater, "le": np.less_equal, "max": np.maximum, "min": np.minimum}
