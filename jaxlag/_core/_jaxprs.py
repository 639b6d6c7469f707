"""Traversal and rewriting of jaxprs: their equations and the jaxprs nested in them.

Only this module reads the names and parameters of JAX's primitives for calls and loops.
"""

from collections.abc import Callable, Iterator
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr

_CALLS = {
    *("jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint"),
    *("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"),
}
_PROGRAM = ("jaxpr", "call_jaxpr", "fun_jaxpr")


def equations(program: Any) -> Iterator[Any]:
    """All equations of a program, each before those of its nested programs."""
    for eqn in getattr(program, "jaxpr", program).eqns:
        yield eqn
        yield from within(eqn)


def within(eqn: Any) -> Iterator[Any]:
    """All equations of the programs nested in an operation."""
    for inner in _among(eqn.params.values()):
        yield from equations(inner)


def _among(values: Any) -> Iterator[Any]:
    for value in values:
        if isinstance(value, tuple | list):
            yield from _among(value)
        elif isinstance(value, ClosedJaxpr | Jaxpr):
            yield value


def closed(program: ClosedJaxpr | Jaxpr) -> ClosedJaxpr:
    """A program as a ClosedJaxpr, with its constants if it has any."""
    return program if isinstance(program, ClosedJaxpr) else ClosedJaxpr(program, ())


def called(eqn: Any) -> ClosedJaxpr | None:
    """The program of a call with the same operands and results; None for other equations."""
    if eqn.primitive.name not in _CALLS:
        return None
    for key in _PROGRAM:
        inner = eqn.params.get(key)
        if inner is not None:
            inner = closed(inner)
            sizes = len(inner.jaxpr.invars), len(inner.jaxpr.outvars)
            return inner if sizes == (len(eqn.invars), len(eqn.outvars)) else None
    return None


def scan_sizes(params: Any) -> tuple[int, int]:
    """(number of constants, number of carried operands) of a scan; the rest are scanned over.

    Args:
        params: of the equation.
    """
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carried, _ = params["ft_in"].unpack()  # jax 0.12
    return len(consts), len(carried)


def rewritten(
    code: ClosedJaxpr,
    equation: Callable[[Any], Any],
    constant: Callable[[Any], Any] = lambda x: x,
) -> ClosedJaxpr:
    """The program with every equation and every constant replaced.

    Unchanged parts are the same objects: JAX recognizes equal functions by the
    identity of their programs.

    Args:
        code: the program.
        equation: old equation -> new equation. Nested programs are replaced first.
        constant: the same for constants.
    """
    jaxpr = _inside(code.jaxpr, equation, constant)
    consts = list(map(constant, code.consts))
    same = all(new is old for new, old in zip(consts, code.consts, strict=True))
    if jaxpr is code.jaxpr and same:
        return code
    return ClosedJaxpr(jaxpr, consts)


def constants(program: ClosedJaxpr) -> list[Any]:
    """All constants of a program and of those nested in it."""
    found: list[Any] = []

    def seen(x: Any) -> Any:
        found.append(x)
        return x

    rewritten(program, lambda eqn: eqn, seen)
    return found


def _inside(jaxpr: Any, *change: Callable) -> Any:
    eqns = [_equation(eqn, *change) for eqn in jaxpr.eqns]
    same = all(new is old for new, old in zip(eqns, jaxpr.eqns, strict=True))
    return jaxpr if same else jaxpr.replace(eqns=eqns)


def _equation(eqn: Any, equation: Callable, constant: Callable) -> Any:
    params = {key: _param(value, equation, constant) for key, value in eqn.params.items()}
    same = all(params[key] is value for key, value in eqn.params.items())
    return equation(eqn if same else eqn.replace(params=params))


def _param(value: Any, *change: Callable) -> Any:
    if isinstance(value, ClosedJaxpr):
        return rewritten(value, *change)
    if isinstance(value, Jaxpr):
        return _inside(value, *change)
    if isinstance(value, tuple):  # branches, and records of several programs
        inner = [_param(x, *change) for x in value]
        if all(new is old for new, old in zip(inner, value, strict=True)):
            return value
        return tuple(inner) if type(value) is tuple else type(value)(*inner)
    return value
