"""Elementwise primitives on nodes."""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxlag._lowering._graph._expression import Graph, Node, Primitive, named
from jaxlag._lowering._jaxpr._node_arrays import Missing, broadcast


def _convert(graph: Graph, eqn: Any, x: Node) -> Node:
    old, new = eqn.invars[0].aval.dtype, eqn.params["new_dtype"]
    if old == new:
        return x
    if old == np.bool_:
        return graph.select(x, graph.one, graph.zero)
    if new == np.bool_:
        return graph.call(named("ne"), x, graph.zero)
    if jnp.issubdtype(old, jnp.integer):  # made from truth values
        return x
    raise Missing(f"conversion of {old} to {new}")


def _pow(graph: Graph, eqn: Any, x: Node, y: Node) -> Node:
    exponent = y.constant
    if exponent is not None and math.isfinite(exponent) and exponent == int(exponent):
        return graph.power(x, int(exponent))
    if exponent == 0.5:
        return graph.sqrt(x)
    return graph.call(Primitive(eqn.primitive, eqn.params), x, y)


def _select_n(graph: Graph, eqn: Any, which: Node, *cases: Node) -> Node:
    if eqn.invars[0].aval.dtype == np.bool_:
        return graph.select(which, cases[1], cases[0])
    chosen = cases[0]
    for k, case in enumerate(cases[1:], start=1):
        chosen = graph.select(graph.call(named("ge"), which, graph.const(float(k))), case, chosen)
    return chosen


def _quotient(graph: Graph, eqn: Any, x: Node, y: Node) -> Node:
    if jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.integer):
        raise Missing("division of integers")
    return graph.div(x, y)


def _polynomial(graph: Graph, eqn: Any, x: Node, *coefficients: Node) -> Node:
    """Horner's scheme; the constant term comes first."""
    total = graph.zero
    for c in reversed(coefficients):
        total = graph.add(graph.mul(total, x), c)
    return total


def _plain(graph: Graph, eqn: Any, *args: Node) -> Node:
    return graph.call(Primitive(eqn.primitive, eqn.params), *args)


ELEMENTWISE: dict[str, Callable] = {
    "add": lambda g, e, x, y: g.add(x, y),
    "add_any": lambda g, e, x, y: g.add(x, y),
    "sub": lambda g, e, x, y: g.sub(x, y),
    "mul": lambda g, e, x, y: g.mul(x, y),
    "neg": lambda g, e, x: g.scale(x, -1.0),
    "div": _quotient,
    "square": lambda g, e, x: g.power(x, 2),
    "integer_pow": lambda g, e, x: g.power(x, e.params["y"]),
    "pow": _pow,
    "sqrt": lambda g, e, x: g.sqrt(x),
    "one_minus_square": lambda g, e, x: g.sum([(g.power(x, 2), -1.0)], 1.0),
    "polynomial": _polynomial,
    "rsqrt": lambda g, e, x: g.power(g.sqrt(x), -1),
    "stop_gradient": lambda g, e, x: g.stop(x),
    "select_n": _select_n,
    "convert_element_type": _convert,
}
_PLAIN = """
abs acos acosh and asin asinh atan atan2 atanh bessel_i0e bessel_i1e cbrt ceil clamp cos
cosh digamma eq erf erf_inv erfc exp exp2 expm1 floor ge gt is_finite le lgamma log
log1p logistic lt max min ne nextafter not or rem round sign sin sinh tan tanh xor
igamma igammac regularized_incomplete_beta polygamma
"""
ELEMENTWISE |= dict.fromkeys(_PLAIN.split(), _plain)


def elementwise(graph: Graph, eqn: Any, operands: list) -> np.ndarray:
    make = ELEMENTWISE[eqn.primitive.name]
    return broadcast(graph, lambda *args: make(graph, eqn, *args), *operands)
