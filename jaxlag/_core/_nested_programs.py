"""Programs within a traced program."""

from collections.abc import Iterator
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr

_CALLS = ("jaxpr", "call_jaxpr", "fun_jaxpr")


def equations(program: Any) -> Iterator[Any]:
    """All equations of a program, each before those of the programs within it."""
    for eqn in getattr(program, "jaxpr", program).eqns:
        yield eqn
        yield from within(eqn)


def within(eqn: Any) -> Iterator[Any]:
    """All equations of the programs within an operation."""
    for inner in _among(eqn.params.values()):
        yield from equations(inner)


def _among(values: Any) -> Iterator[Any]:
    for value in values:
        if isinstance(value, tuple | list):
            yield from _among(value)
        elif isinstance(value, ClosedJaxpr | Jaxpr):
            yield value


def called(eqn: Any) -> ClosedJaxpr | None:
    """The program of a call; None of a loop, a choice, or an operation."""
    if eqn.primitive.name in ("scan", "while", "cond"):
        return None
    for key in _CALLS:
        inner = eqn.params.get(key)
        if inner is None:
            continue
        closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        return closed if len(closed.jaxpr.invars) == len(eqn.invars) else None
    return None
