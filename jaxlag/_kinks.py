"""Whether a traced program bends or jumps: comparisons, and what is made of them."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

_BENDS = {"lt", "le", "gt", "ge", "max", "min", "abs", "sign", "clamp", "floor", "ceil", "round"}
_BENDS |= {"rem", "reduce_max", "reduce_min", "argmax", "argmin", "cummax", "cummin", "sort"}
_SMOOTH = "jaxlag smooth"
# JAX's functions that compare to stay in range.
_IN_RANGE = {"softplus", "log_softmax", "hypot"}

smooth = jax.named_scope(_SMOOTH)
"""Decorator of a function that compares, and is smooth all the same."""


def has_kinks(jaxpr: Jaxpr, moving: Sequence[bool]) -> bool:
    """Whether something is compared that moves: a function of it may bend or jump there.

    A comparison that merely guards a singular place is found as well; one with == or != is taken
    for such. What comes out of a call, a loop or a branch moves where anything moves that goes in.

    Args:
        jaxpr: the traced program.
        moving: which of its inputs move.
    """
    moves = {x for x, does in zip(jaxpr.invars, moving, strict=True) if does}
    for eqn in jaxpr.eqns:
        given = [not isinstance(x, Literal) and x in moves for x in eqn.invars]
        if not any(given):
            continue
        if eqn.params.get("name") in _IN_RANGE or _SMOOTH in str(eqn.source_info.name_stack):
            moves.update(eqn.outvars)
            continue
        name = eqn.primitive.name
        if name in _BENDS and _is_inexact(eqn.invars[0]):
            return True
        if any(has_kinks(inner, [True] * len(inner.invars)) for inner in _inner(eqn.params)):
            return True
        moves.update(eqn.outvars)
    return False


def _inner(params: dict[str, Any]) -> list[Jaxpr]:
    """The programs within an equation."""
    found = []
    for value in params.values():
        for x in value if isinstance(value, tuple | list) else (value,):
            if isinstance(x, ClosedJaxpr):
                found.append(x.jaxpr)
            elif isinstance(x, Jaxpr):
                found.append(x)
    return found


def _is_inexact(x: Any) -> bool:
    return jnp.issubdtype(x.aval.dtype, jnp.inexact)
