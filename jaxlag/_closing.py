"""Traced values that a declaration closes over, made arguments of the program."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxlag import _params
from jaxlag._captured import Closed, functions_of
from jaxlag._inputs import evaluate
from jaxlag._lowering import ArrayTerms
from jaxlag._system import System


def closing(system: System, params: Any, q: Array, inputs: Mapping[str, Any]) -> Any:
    """Params, and beside them whatever traced values the declared functions close over.

    A Lagrangian written inside a function that is being differentiated may read its arguments:
    derivatives in them are those in params.
    """
    if all(function.known for function in functions_of(system)):
        return params
    try:
        consts = _consts(system, params, q, inputs)
    except Exception:  # it is said where the functions are used
        return params
    tracers = [x for x in consts if not _params.concrete(x)]
    return Closed(params, tracers, tuple(map(id, tracers))) if tracers else params


def _consts(system: System, params: Any, q: Array, inputs: Mapping[str, Any]) -> list[Any]:
    traced, static = _params.split(params)
    terms = ArrayTerms(system.lagrangian, system.forces, system.constraints)

    def everything(t: Array, q: Array, v: Array, traced: Any) -> Any:
        params = _params.join(traced, static)
        L = system.lagrangian(t, q, v, params)
        rows = terms.position(t, q, params), terms.velocity(t, q, v, params)
        values = evaluate(inputs, t, q, v, params)
        return L, rows, terms.force(t, q, v, params, values, jnp.zeros_like(rows[1]))

    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    return jax.make_jaxpr(everything)(t, q, q, traced).consts
