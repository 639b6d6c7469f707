"""Dependence of the outputs of a traced program on its inputs."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxlag._core._jaxprs import called, scan_sizes

Names = frozenset[str]

_NOTHING: Names = frozenset()

Seen = Callable[[Any, list[Names]], None]


def outputs_depend_on(
    jaxpr: Jaxpr, given: list[Names], seen: Seen | None = None, continuous: bool = False
) -> list[Names]:
    """Names on which each output of a traced program depends.

    A dependence that cancels only algebraically is still listed; one that is not listed is
    certainly absent. Calls, loops and branches are followed output by output.

    Args:
        jaxpr: the traced program.
        given: names of each of its inputs; its constants have none.
        seen: called with every operation, and the names of its operands; within calls, but not
            within loops and branches.
        continuous: whether integers and truth values, which change in jumps, depend on nothing;
            except within loops and branches.
    """
    known: dict[Any, Names] = dict(zip(jaxpr.invars, given, strict=True))
    numbers: dict[Any, Any] = {}

    def of(atom: Any) -> Names:
        return _NOTHING if isinstance(atom, Literal) else known.get(atom, _NOTHING)

    def number(atom: Any) -> Any:
        """The value of a scalar literal, or of a difference of two; else None."""
        if not isinstance(atom, Literal):
            return numbers.get(atom)
        return np.asarray(atom.val) if np.ndim(atom.val) == 0 else None

    for eqn in jaxpr.eqns:
        operands = [of(atom) for atom in eqn.invars]
        if seen is not None:
            seen(eqn, operands)
        stated = [number(atom) for atom in eqn.invars]
        if eqn.primitive.name == "sub" and all(x is not None for x in stated):
            numbers[eqn.outvars[0]] = stated[0] - stated[1]  # y - 1 in differentiating x**y
        results = [_NOTHING] if _is_one(eqn, stated) else _results(eqn, operands, seen, continuous)
        if continuous:
            pairs = zip(results, eqn.outvars, strict=True)
            results = [x if _is_inexact(atom) else _NOTHING for x, atom in pairs]
        known.update(zip(eqn.outvars, results, strict=True))
    return [of(atom) for atom in jaxpr.outvars]


def _is_one(eqn: Any, stated: list[Any]) -> bool:
    """Whether it is x**0, which is 1 for every x and results from differentiating x**1."""
    if eqn.primitive.name == "pow":
        return stated[1] is not None and bool(stated[1] == 0)
    return eqn.primitive.name == "integer_pow" and eqn.params["y"] == 0


def _is_inexact(atom: Any) -> bool:
    return jnp.issubdtype(atom.aval.dtype, jnp.inexact)


def _results(eqn: Any, operands: list[Names], seen: Seen | None, continuous: bool) -> list[Names]:
    inner = called(eqn)
    if inner is not None:
        return outputs_depend_on(inner.jaxpr, operands, seen, continuous)
    follow = _CONTROL_FLOW.get(eqn.primitive.name)
    if follow is not None:
        return follow(eqn.params, operands)
    return [_NOTHING.union(*operands)] * len(eqn.outvars)


def _open(jaxpr: Any) -> Any:
    return jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr


def _cond(params: Any, operands: list[Names]) -> list[Names]:
    """Dependences of all branches, and of the index."""
    index, *rest = operands
    branches = [outputs_depend_on(_open(branch), rest) for branch in params["branches"]]
    return [index.union(*outputs) for outputs in zip(*branches, strict=True)]


def _scan(params: Any, operands: list[Names]) -> list[Names]:
    """Dependences of the start and of all iterations, also through the other carries."""
    body, (consts, carries) = _open(params["jaxpr"]), scan_sizes(params)
    fixed, carry, rows = (
        operands[:consts],
        operands[consts : consts + carries],
        operands[consts + carries :],
    )
    outputs: list[Names] = []

    def body_fun(carry: list[Names]) -> list[Names]:
        outputs[:] = outputs_depend_on(body, [*fixed, *carry, *rows])
        return outputs[:carries]

    return _fixpoint(body_fun, carry) + outputs[carries:]


def _while(params: Any, operands: list[Names]) -> list[Names]:
    """As in a scan; the condition affects every carry that the body changes."""
    body, condition = _open(params["body_jaxpr"]), _open(params["cond_jaxpr"])
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]
    asked, fixed, carry = operands[:first], operands[first:second], operands[second:]
    same = [x is y for x, y in zip(body.invars[second - first :], body.outvars, strict=True)]

    def body_fun(carry: list[Names]) -> list[Names]:
        (cond_fun,) = outputs_depend_on(condition, [*asked, *carry])
        after = outputs_depend_on(body, [*fixed, *carry])
        return [x if is_same else x | cond_fun for x, is_same in zip(after, same, strict=True)]

    return _fixpoint(body_fun, carry)


def _fixpoint(body_fun: Callable[[list[Names]], list[Names]], carry: list[Names]) -> list[Names]:
    """The carries of a loop when further iterations add no name; the start is included."""
    while True:
        grown = [x | y for x, y in zip(carry, body_fun(carry), strict=True)]
        if grown == carry:
            return grown
        carry = grown


_CONTROL_FLOW: dict[str, Callable[[Any, list[Names]], list[Names]]] = {
    "cond": _cond,
    "scan": _scan,
    "while": _while,
}
