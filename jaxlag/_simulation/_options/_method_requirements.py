"""Requirements of methods on a system."""

from collections.abc import Mapping
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from jaxlag._core._errors import invalid
from jaxlag._model._forces import components, reads_lam
from jaxlag._model._inputs import evaluate
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._dependence import outputs_depend_on
from jaxlag.solvers import AbstractPartitioned, GaussLegendre, Nystrom12, Splitting


def check_requirements(
    system: System,
    solver: diffrax.AbstractSolver,
    formulation: str,
    params: Any,
    inputs: Mapping[str, Any],
    dtype: Any,
) -> None:
    """Raise if a method does not apply to this system.

    Args:
        system: the mechanical system.
        solver: any solver; those without requirements pass.
        formulation: kind of the state.
        params: as the Lagrangian takes them.
        inputs: the inputs.
        dtype: of the state.

    Raises:
        ValueError: with the requirement of the method, and the property of the system.
    """
    if not isinstance(solver, Nystrom12 | Splitting | AbstractPartitioned):
        return
    name = f"method {type(solver).__name__}"
    if system.states is not None:
        must, was = "be used without states=", f"there were the states {list(system.states.names)}"
        fix = "Choose another method: this one is made for second-order equations alone."
        raise invalid(name, must, was, fix)
    if formulation != "multipliers":
        was = f"formulation was {formulation!r}"
        fix = "Pass formulation='multipliers', or another method."
        raise invalid(name, "have a state (q, v) and multipliers", was, fix)
    if isinstance(solver, Splitting | Nystrom12):
        _separable(system, name, params, inputs, dtype, isinstance(solver, Splitting))
        return
    for force in filter(reads_lam, system.forces):
        must = "be used without forces that depend on multipliers"
        raise invalid(name, must, f"{force.name!r} does", "Choose another method.")
    rows = system._rows(params, dtype)
    if rows.size and isinstance(solver, GaussLegendre):
        must, fix = "be used without constraints", "Choose 'variational2' or 'variational4'."
        raise invalid(name, must, f"there were the rows {list(rows.labels)}", fix)
    if not all(rows.holonomic):
        label = rows.labels[rows.holonomic.index(False)]
        must = "be used with holonomic constraints only"
        raise invalid(name, must, f"{label!r} is not holonomic", "Choose another method.")


def splits(system: System, formulation: str, params: Any, dtype: Any) -> bool:
    """Whether L is T(v) - V(t, q), without forces, constraints and states of its own."""
    if formulation != "multipliers" or system.constraints or system.forces or system.states:
        return False
    structure = system._structure(params, dtype)
    return not (structure.mass & {"t", "q", "v"} or "v" in structure.bias)


def _separable(
    system: System, name: str, params: Any, inputs: Mapping[str, Any], dtype: Any, splits: bool
) -> None:
    """Raise unless M is constant and accelerations do not depend on v."""
    verb = "split" if splits else "be used for"
    fix = "Choose 'dopri8', which takes any Lagrangian."
    if splits:
        fix = "Choose 'variational2', 'variational4' or 'gauss4', which take any Lagrangian."
    if system.constraints:
        was = f"it has constraints ({', '.join(map(repr, system._rows(params, dtype).labels))})"
        if splits:
            fix = "Choose 'variational2' or 'variational4', which satisfy holonomic constraints."
        raise invalid(name, f"{verb} a system without constraints", was, fix)
    traced, static = _params.split(params)
    structure = system._structure(params, dtype)
    must = f"{verb} a Lagrangian T(v) - V(t, q) with constant mass matrix"
    for what, found in (("mass matrix", structure.mass), ("bias", structure.bias)):
        depends = sorted(found & ({"t", "q", "v"} if what == "mass matrix" else {"v"}))
        if depends:
            raise invalid(name, must, f"its {what} contains {', '.join(depends)}", fix)
    q = jax.ShapeDtypeStruct((system.size,), dtype)
    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    for force in system.forces:

        def applied(t: Any, q: Any, v: Any, traced: Any, force: Any = force) -> Any:
            params = _params.join(traced, static)
            return components(force, t, q, v, params, evaluate(inputs, t, q, v, params))

        program = jax.make_jaxpr(applied)(t, q, q, traced).jaxpr
        given = [frozenset({"t"}), frozenset({"q"}), frozenset({"v"})]
        given += [frozenset()] * (len(program.invars) - 3)
        if "v" in frozenset().union(*outputs_depend_on(program, given)):
            was = f"the force {force.name!r} depends on v"
            must = f"{verb} a system whose forces do not depend on velocities"
            raise invalid(name, must, was, fix)
