"""Captured values of a declaration: traced values in its closures, and params."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._model._forces import sliding
from jaxlag._model._inputs import evaluate
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._closure_params import ParamsWithClosure
from jaxlag._tracing._dependence import outputs_depend_on
from jaxlag._tracing._signature import real_scalar
from jaxlag._tracing._traced_function import functions_of


def lift_closure_tracers(
    system: System, params: Any, q: Any, inputs: Mapping[str, Any] | None
) -> Any:
    """Params, with the traced values in closures of the declared functions, if any.

    A Lagrangian defined inside a differentiated function may read the arguments of that function:
    their derivatives are computed like those of params. Without inputs the forces are left out.
    """
    declared = (system.lagrangian, system.constraints, system.quasi, system.states)
    if all(f.known for f in functions_of(declared if inputs is None else (system, inputs))):
        return params
    tracers = [x for x in _consts(system, params, q, inputs) if not concrete(x)]
    return ParamsWithClosure(params, tracers, tuple(map(id, tracers))) if tracers else params


def declared(
    system: System, t: Array, q: Array, v: Array, params: Any, values: Any, lam: Array | None
) -> Any:
    """All declared terms at one state; without values of the inputs, no forces.

    Args:
        system: its functions are called.
        t: time.
        q: coordinates.
        v: velocities.
        params: as the Lagrangian takes them.
        values: of the inputs, by name; None without.
        lam: multipliers that forces read; None for zeros.
    """
    terms = system._terms
    L = real_scalar("lagrangian", system.lagrangian)(t, q, v, params)
    u = None if system.quasi is None else system.quasi.of(t, q, v, params)
    rows = jnp.zeros(0), jnp.zeros(0)
    if system.constraints:
        rows = terms.position(t, q, params), terms.velocity(t, q, v, params)
    if values is None:
        return L, u, rows
    slides = [slide(t, q, v, params) for slide in sliding(system.forces)]
    rates = None if system.states is None else system.states.rates(t, q, v, params, values)
    lam = jnp.zeros_like(rows[1]) if lam is None else lam
    return L, u, rows, slides, rates, terms.force(t, q, v, params, values, lam)


def check_params(
    system: System,
    params: Any,
    q: Any,
    inputs: Mapping[str, Any] | None,
    argument: str = "params",
) -> None:
    """Raise on nonfinite numbers that a declared function reads.

    Also on objects that cannot be part of a program's key. Without inputs the forces are ignored.

    Raises:
        ValueError: with the path of the leaf.
    """
    _params.check_keys(params)
    faults = _params.not_finite(params)
    if not faults:
        return
    program, nothing = _program(system, params, q, inputs), frozenset()
    given = [nothing] * 3 + [frozenset({path}) for path in _params.paths(params)]
    given += [nothing] * (len(program.jaxpr.invars) - len(given))
    read = nothing.union(*outputs_depend_on(program.jaxpr, given))
    for path, name, was in faults:
        if path in read:
            raise invalid(argument + name.removeprefix("params"), "be finite", f"it was {was}")


def _consts(system: System, params: Any, q: Any, inputs: Mapping[str, Any] | None) -> list[Any]:
    """Values in the closures of the declared functions."""
    return _program(system, params, q, inputs).consts


def _program(system: System, params: Any, q: Any, inputs: Mapping[str, Any] | None) -> ClosedJaxpr:
    """All declared terms as a program of (t, q, v, params, inputs)."""
    traced, static = _params.halves((params, inputs))

    def everything(t: Array, q: Array, v: Array, traced: Any) -> Any:
        params, inputs = _params.join(traced, static)
        values = None if inputs is None else evaluate(inputs, t, q, v, params)
        return declared(system, t, q, v, params, values, None)

    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    return jax.make_jaxpr(everything)(t, q, q, traced)
