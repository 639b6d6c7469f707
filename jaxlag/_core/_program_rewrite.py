"""A traced program with equations of it changed, in programs within it too."""

from collections.abc import Callable
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr


def rewritten(
    code: ClosedJaxpr,
    equation: Callable[[Any], Any],
    constant: Callable[[Any], Any] = lambda x: x,
) -> ClosedJaxpr:
    """The program with every equation and every constant changed.

    What changes in nothing is left as it is, the same object: JAX knows equal functions by the
    identity of their programs.

    Args:
        code: the program.
        equation: from one to the one in its place. Programs within it are changed before.
        constant: the same for constants.
    """
    jaxpr = _inside(code.jaxpr, equation, constant)
    consts = list(map(constant, code.consts))
    same = all(new is old for new, old in zip(consts, code.consts, strict=True))
    if jaxpr is code.jaxpr and same:
        return code
    return ClosedJaxpr(jaxpr, consts)


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
