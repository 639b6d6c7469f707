"""A program with constants of its own: arrays of numpy's, and views of them, change in place."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxlag import _params


def owned(code: ClosedJaxpr) -> ClosedJaxpr:
    """The same program, no constant of which anybody else can change.

    What has no constants is left as it is: JAX knows equal functions by the identity of theirs.
    """
    jaxpr = _inside(code.jaxpr)
    if jaxpr is code.jaxpr and not code.consts:
        return code
    return ClosedJaxpr(jaxpr, list(map(_copied, code.consts)))


def _inside(jaxpr: Any) -> Any:
    eqns = [_equation(eqn) for eqn in jaxpr.eqns]
    same = all(new is old for new, old in zip(eqns, jaxpr.eqns, strict=True))
    return jaxpr if same else jaxpr.replace(eqns=eqns)


def _equation(eqn: Any) -> Any:
    params = {key: _param(value) for key, value in eqn.params.items()}
    atoms = list(map(_atom, eqn.invars))
    same = all(params[key] is value for key, value in eqn.params.items())
    if same and all(new is old for new, old in zip(atoms, eqn.invars, strict=True)):
        return eqn
    return eqn.replace(invars=atoms, params=params)


def _atom(atom: Any) -> Any:
    if not isinstance(atom, Literal) or not isinstance(atom.val, np.ndarray):
        return atom
    return Literal(atom.val.copy(), atom.aval)


def _param(value: Any) -> Any:
    if isinstance(value, ClosedJaxpr):
        return owned(value)
    if isinstance(value, Jaxpr):
        return _inside(value)
    if isinstance(value, tuple):  # branches, and records of several programs
        inner = list(map(_param, value))
        if all(new is old for new, old in zip(inner, value, strict=True)):
            return value
        return tuple(inner) if type(value) is tuple else type(value)(*inner)
    return value


def _copied(x: Any) -> Any:
    if not _params.concrete(x):
        return x
    if isinstance(x, np.ndarray):
        return x.copy()
    if isinstance(x, jax.Array) and not jnp.issubdtype(x.dtype, jax.dtypes.extended):
        with jax.ensure_compile_time_eval():
            return jnp.array(x, copy=True)
    return x
