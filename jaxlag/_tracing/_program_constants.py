"""Copies of a program's constants: numpy arrays and views of them can change in place."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from jaxlag._core._arrays import concrete
from jaxlag._core._jaxprs import rewritten


def copy_constants(code: ClosedJaxpr) -> ClosedJaxpr:
    """The same program with copies of all constants that can be changed elsewhere."""
    return rewritten(code, _equation, _copied)


def _equation(eqn: Any) -> Any:
    atoms = list(map(_atom, eqn.invars))
    same = all(new is old for new, old in zip(atoms, eqn.invars, strict=True))
    return eqn if same else eqn.replace(invars=atoms)


def _atom(atom: Any) -> Any:
    if not isinstance(atom, Literal) or not isinstance(atom.val, np.ndarray):
        return atom
    return Literal(atom.val.copy(), atom.aval)


def _copied(x: Any) -> Any:
    if not concrete(x):
        return x
    if isinstance(x, np.ndarray):
        return x.copy()
    if isinstance(x, jax.Array) and not jnp.issubdtype(x.dtype, jax.dtypes.extended):
        with jax.ensure_compile_time_eval():
            return jnp.array(x, copy=True)
    return x
