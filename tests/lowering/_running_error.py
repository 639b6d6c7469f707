"""Running error bounds of a graph, and its exact values to 50 digits.

Every node has its value in double precision, its value in 50 digits, and a first-order bound on the
difference: the propagated errors of its operands and its own rounding (Higham, Accuracy and
Stability of Numerical Algorithms, sec. 3.3).
"""

import operator
from typing import NamedTuple

import mpmath
import numpy as np

from jaxlag._lowering._graph._expression import order

U = 2.0**-53
DIGITS = 50
ULPS = 2.0  # of a function of numpy or XLA

_TRUTHS = {name: getattr(operator, name) for name in ("gt", "ge", "lt", "le", "eq", "ne", "and_")}
_TRUTHS["and"] = _TRUTHS.pop("and_")
_NAMES = {"log": "ln", "atan2": "atan2", "asin": "asin", "acos": "acos", "atan": "atan"}


class BoundedValue(NamedTuple):
    """A number in double precision, in 50 digits, and a bound on the difference."""

    value: float
    exact: mpmath.mpf
    bound: float


def evaluate_with_bounds(roots, inputs):
    """The roots at inputs {(name, index): double}, which count as exact."""
    known = {}
    with mpmath.workdps(DIGITS):
        for node in order(roots):
            args = [known[arg] for arg in node.args]
            known[node] = _OPS[node.op](node, args, inputs)
    return [known[root] for root in roots]


def _const(node, args, inputs):
    return BoundedValue(float(node.data), mpmath.mpf(float(node.data)), 0.0)


def _input(node, args, inputs):
    x = float(inputs[node.data])
    return BoundedValue(x, mpmath.mpf(x), 0.0)


def _sum(node, args, inputs):
    constant, terms = node.data
    value, exact, bound = constant, mpmath.mpf(constant), 0.0
    for x, (_, c) in zip(args, terms, strict=True):
        part = c * x.value
        value += part
        exact += mpmath.mpf(c) * x.exact
        bound += abs(c) * x.bound + U * (abs(value) + (abs(part) if abs(c) != 1.0 else 0.0))
    return BoundedValue(value, exact, bound)


def _product(node, args, inputs):
    value, exact, bound = 1.0, mpmath.mpf(1), 0.0
    for x, (_, e) in zip(args, node.data, strict=True):
        power = x.value ** float(e)
        slope = abs(e * x.value ** float(e - 1))
        bound = abs(power) * bound + abs(value) * (slope * x.bound + U * abs(e) * abs(power))
        value *= power
        exact *= x.exact**e
        bound += U * abs(value)
    return BoundedValue(value, exact, bound)


def _call(node, args, inputs):
    name = node.data.name
    if name in _TRUTHS:
        return BoundedValue(*[_TRUTHS[name](*(x[k] for x in args)) for k in range(2)], 0.0)
    function = getattr(mpmath, _NAMES.get(name, name))
    exact = function(*(x.exact for x in args))
    value = float(function(*(mpmath.mpf(x.value) for x in args)))
    bound = ULPS * U * abs(value)
    for k, x in enumerate(args):
        point = [mpmath.mpf(y.value) for y in args]
        function_of_one = lambda z, k=k, point=point: function(*point[:k], z, *point[k + 1 :])  # noqa: E731
        bound += abs(float(mpmath.diff(function_of_one, point[k]))) * x.bound if x.bound else 0.0
    return BoundedValue(value, exact, bound)


def _select(node, args, inputs):
    condition, on_true, on_false = args
    return on_true if condition.exact else on_false


def _same(node, args, inputs):
    return args[0]


_OPS = {"const": _const, "input": _input, "sum": _sum, "product": _product, "call": _call}
_OPS |= {"select": _select}
_OPS |= {"let": _same, "stop": _same}


def rounded(roots, inputs, dtype):
    """The roots in the arithmetic of a dtype, including overflow."""
    known = {}
    with np.errstate(all="ignore"):
        for node in order(roots):
            known[node] = _round(node, [known[arg] for arg in node.args], inputs, dtype)
    return np.array([known[root] for root in roots])


def _round(node, args, inputs, dtype):
    if node.op in ("const", "input"):
        value = node.data if node.op == "const" else inputs[node.data]
        return value if isinstance(value, bool) else dtype(value)
    if node.op == "sum":
        constant, terms = node.data
        total = dtype(constant)
        for x, (_, c) in zip(args, terms, strict=True):
            total = total + dtype(c) * x
        return total
    if node.op == "product":
        over, under = dtype(1), dtype(1)
        for x, (_, e) in zip(args, node.data, strict=True):
            for _ in range(abs(e)):  # as the program does it, factor by factor
                over, under = (over * x, under) if e > 0 else (over, under * x)
        return over / under
    if node.op == "select":
        return args[1] if args[0] else args[2]
    if node.op in ("let", "stop"):
        return args[0]
    name = node.data.name
    if name in _TRUTHS:
        return bool(_TRUTHS[name](*args))
    return dtype(getattr(np, _NUMPY.get(name, name))(*args))


_NUMPY = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2"}
