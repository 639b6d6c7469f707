"""Kinks and jumps of a traced program: the outcomes of its comparisons.

A function of `max`, `where`, `abs` and the like is smooth as long as all comparisons in it keep
their outcome. For a loop only its integer results are examined (an interval of a table), not the
comparisons in its body. For a `cond` its index is examined.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.core import ClosedJaxpr, Literal

from jaxlag._core._jaxprs import called

_SMOOTH = "jaxlag smooth"
smooth = jax.named_scope(_SMOOTH)
"""Decorator of a function that contains comparisons but is smooth."""

# Comparisons at single points, and pivoting, which does not affect the results of an elimination.
_GUARDS = ("eq", "ne", "is_finite", "lu")


def outcomes(
    program: ClosedJaxpr,
    args: Sequence[Array],
    moving: Sequence[bool],
    only: Any = None,
    guards: bool = False,
) -> Array | None:
    """Outcomes of the comparisons of moving values, as a row of numbers; None if there are none.

    A comparison with == or != counts as the guard of a single point, and is not listed, nor is the
    cut of an angle.

    Args:
        program: the traced program.
        args: its arguments.
        moving: which of these vary.
        only: the equation to examine; None for all.
        guards: whether guards and cuts are listed, too.
    """
    found: list[Array] = []
    _run(program, list(args), list(moving), found, only, guards)
    return jnp.concatenate(found) if found else None


def _run(
    program: ClosedJaxpr,
    args: list[Any],
    moving: list[bool],
    found: list[Array],
    only: Any,
    guards: bool,
) -> tuple[list[Any], list[bool]]:
    """(results, which of them vary); outcomes of comparisons are added to `found`."""
    jaxpr = program.jaxpr
    known = dict(zip(jaxpr.constvars, program.consts, strict=True))
    known |= dict(zip(jaxpr.invars, args, strict=True))
    moves = {x for x, does in zip(jaxpr.invars, moving, strict=True) if does}
    for eqn in jaxpr.eqns:
        given = [x.val if isinstance(x, Literal) else known[x] for x in eqn.invars]
        touched = [not isinstance(x, Literal) and x in moves for x in eqn.invars]
        inner, listed = called(eqn), _SMOOTH not in str(eqn.source_info.name_stack)
        if inner is not None:
            results, does = _run(inner, given, touched, found if listed else [], only, guards)
        else:
            results = eqn.primitive.bind(*given, **eqn.params)
            results = results if eqn.primitive.multiple_results else [results]
            does = [any(touched)] * len(results)
            if any(touched) and listed and only in (None, eqn):
                found.extend(_outcomes(eqn, given, results, guards))
        known.update(zip(eqn.outvars, results, strict=True))
        moves.update(x for x, moved in zip(eqn.outvars, does, strict=True) if moved)
    ends = [x.val if isinstance(x, Literal) else known[x] for x in jaxpr.outvars]
    return ends, [not isinstance(x, Literal) and x in moves for x in jaxpr.outvars]


def _outcomes(eqn: Any, given: list[Any], results: list[Any], guards: bool) -> Iterator[Array]:
    """Outcomes of one operation."""
    name, first = eqn.primitive.name, given[0]
    if (name in _GUARDS and not guards) or not any(_is_inexact(x) for x in given):
        return
    for x in results:
        if not _is_inexact(x):
            yield _row(x)
    if not _is_inexact(first):
        return
    if name in ("max", "min"):
        yield _row(jnp.sign(given[0] - given[1]))
    elif name in ("abs", "sign"):
        yield _row(jnp.sign(first))
    elif name == "clamp":
        low, x, high = given
        yield _row(jnp.sign(x - low) + jnp.sign(x - high))
    elif name in ("floor", "ceil", "round"):
        yield _row(results[0])
    elif name == "atan2" and guards:
        yield _row(jnp.where(given[1] < 0, jnp.sign(first), jnp.zeros_like(first)))
    elif name == "rem":
        yield _row(jnp.trunc(given[0] / given[1]))
    elif name in ("reduce_max", "reduce_min"):
        yield _row(first == jnp.expand_dims(results[0], eqn.params["axes"]))
    elif name in ("cummax", "cummin", "sort"):
        yield _row(first == results[0])


def _is_inexact(x: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.inexact)


def _row(x: Any) -> Array:
    return jnp.ravel(jnp.asarray(x)).astype(float)
