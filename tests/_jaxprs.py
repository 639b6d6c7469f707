"""Programs as jaxprs: their operations, how often these are executed, and sizes of arrays."""

import math
from typing import NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

from jaxlag._lowering._emit._sincos import by_polynomials


class Operation(NamedTuple):
    """One equation of a jaxpr: its primitive, its outputs' shapes, how often it is executed."""

    name: str
    shapes: tuple[tuple[int, ...], ...]
    times: int
    inside: tuple[str, ...]


def operations(function, *args, iterations=None):
    """Every operation that one call of `function` executes, including those of nested programs.

    A while loop has no known number of iterations: `iterations` is assumed.
    """
    return list(_walk(jax.make_jaxpr(function)(*args).jaxpr, 1, (), iterations))


def names(program):
    return {operation.name for operation in program}


def count(program, *wanted, without=()):
    """How often operations of these names are executed outside the nested programs `without`."""
    return sum(o.times for o in program if o.name in wanted and not set(without) & set(o.inside))


def loop(program):
    """The operations inside while loops: for a solve those of its steps."""
    return [operation for operation in program if "while" in operation.inside]


def largest(program):
    """Number of entries of the largest array that the program computes."""
    return max(math.prod(shape) for operation in program for shape in operation.shapes)


def _walk(jaxpr, times, inside, iterations):
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        shapes = tuple(getattr(v.aval, "shape", ()) for v in eqn.outvars)
        if eqn.params.get("name") == by_polynomials.__name__:  # jaxlag's own elementary function
            yield Operation("sincos", shapes, times, inside)
            continue
        yield Operation(name, shapes, times, inside)
        repeats = eqn.params["length"] if name == "scan" else 1
        if name == "while":
            assert iterations is not None, "a while loop has no known number of iterations"
            repeats = iterations
        for inner in _executed(name, eqn):
            yield from _walk(inner, times * repeats, (*inside, name), iterations)


def _executed(name, eqn):
    params = eqn.params
    if name == "linear_map":  # its programs are functions
        form, count = params["form"], params["count"]
        like = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in eqn.invars]
        return [jax.make_jaxpr(form.forward)(like[:count], like[count:]).jaxpr]
    if name == "custom_linear_solve":  # its product and its transpose are for derivatives only
        return [params["jaxprs"].solve.jaxpr]
    found = [leaf for value in params.values() for leaf in _leaves(value)]
    return [leaf.jaxpr if isinstance(leaf, ClosedJaxpr) else leaf for leaf in found]


def _leaves(value):
    if isinstance(value, ClosedJaxpr | Jaxpr):
        return [value]
    if isinstance(value, tuple | list):
        return [leaf for item in value for leaf in _leaves(item)]
    return []
