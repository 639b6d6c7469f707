"""Running error analysis on the graph: how far rounding may change each node at given states.

The bound of a result is the bounds of its operands, times its derivatives, plus its own rounding;
of a sum, that of every partial sum in the order of its terms. Inputs are exact. To first order in
eps, in units of eps.

Source: Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed. (2002), sec. 3.3.
"""

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import mul
from typing import Any

import numpy as np

from jaxlag._lowering._graph._expression import Node, order
from jaxlag._lowering._symbolic._evaluate import value

STEP = 1e-8  # change of an operand for the derivative of a function, in units of its bound


def running_errors(
    roots: Sequence[Node], inputs: Mapping[tuple[str, int], Any]
) -> dict[Node, np.ndarray]:
    """node -> bound at every state, for all nodes below the roots; NaN where it has no value."""
    values: dict[Node, Any] = {}
    errors: dict[Node, Any] = {}
    with np.errstate(all="ignore"):
        for node in order(roots):
            args = [values[arg] for arg in node.args]
            below = [errors[arg] for arg in node.args]
            values[node] = found = value(node, args, inputs)
            errors[node] = _error(node, found, args, below, inputs)
            if np.asarray(found).dtype != np.bool_:
                errors[node] = np.where(np.isfinite(found), errors[node], np.nan)
    return errors


def _error(node: Node, found: Any, args: list, below: list, inputs: Mapping) -> Any:
    if node.op in ("const", "input"):
        return np.zeros(())
    if node.op == "sum":
        constant, terms = node.data
        total = partial_sums = np.zeros(())
        parts = [] if constant == 0.0 else [(np.asarray(constant), 0.0)]
        parts += [(c * x, abs(c) * e) for x, e, (_, c) in zip(args, below, terms, strict=True)]
        for place, (part, error) in enumerate(parts):
            total = total + part
            partial_sums = partial_sums + error + (np.abs(total) if place else 0.0)
        return partial_sums
    if node.op == "product":
        factors = [x ** float(e) for x, (_, e) in zip(args, node.data, strict=True)]
        rounding = sum(abs(e) for _, e in node.data) - 1
        error = rounding * np.abs(found)
        for i, (x, (_, e)) in enumerate(zip(args, node.data, strict=True)):
            others = reduce(mul, (f for k, f in enumerate(factors) if k != i), np.ones(()))
            error = error + np.abs(others * e * x ** float(e - 1)) * below[i]
        return error
    if node.op == "select":
        return np.where(args[0], below[1], below[2])
    if node.op in ("stop", "let"):
        return below[0]
    if np.asarray(found).dtype == np.bool_:
        return np.zeros(())
    error = np.abs(found)
    for i, size in enumerate(below):
        if np.any(size > 0):
            moved = [*args[:i], args[i] + STEP * size, *args[i + 1 :]]
            error = error + np.abs(value(node, moved, inputs) - found) / STEP
    return error
