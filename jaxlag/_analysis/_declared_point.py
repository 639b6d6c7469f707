"""The point about which equations are linearized, checked as the user gave it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._arguments import name_sequence
from jaxlag._core._arrays import concrete, number
from jaxlag._core._errors import invalid
from jaxlag._model._coordinates import state_vectors
from jaxlag._model._inputs import check_inputs, check_range
from jaxlag._model._quasi_velocities import QuasiVelocities, least_sine
from jaxlag._model._states import state_names
from jaxlag._system._closure_tracers import check_params, lift_closure_tracers
from jaxlag._system._inspection import check_declaration
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._compiled import Compiled
from jaxlag._tracing._traced_function import warn_of_changes


class DeclaredPoint(NamedTuple):
    """A system at a state.

    Attributes:
        system: the mechanical system.
        sample: params for checks of the code.
        params: as the Lagrangian takes them, with traced values of closures.
        signals: inputs by name, with values of the states of the system.
        t: time.
        q: coordinates.
        v: velocities.
        known: whether t, q and params have values.
    """

    system: System
    sample: _params.Sample
    params: Any
    signals: dict[str, Any]
    t: Float[Array, ""]
    q: Float[Array, " n"]
    v: Float[Array, " n"]
    known: bool


def declared_point(
    function: str, system: Any, q: Any, v: Any, params: Any, t: Any, inputs: Any
) -> DeclaredPoint:
    """The point, with the arguments of this public function.

    Raises:
        ValueError: an argument that is not what it must be; a declaration that does not fit; a
            place where quasi-velocities do not determine the velocities.
    """
    if not isinstance(system, System):
        raise invalid(f"{function}: system", "be a jl.System", f"it was {system!r}")
    with jax.ensure_compile_time_eval():  # under `jax.jit`, too, what is known stays known
        q, v = state_vectors(system.coordinates, q, v)
        t = number(f"{function}: t", "be a number", t, jnp.result_type(float))
    for name, x in (("q", q), ("v", v)):
        if concrete(x) and not np.all(np.isfinite(x)):
            raise invalid(f"{function}: {name}", "be finite", f"it was {x}")
    signals = _signals(function, inputs)
    missing = [name for name in state_names(system.states) if name not in signals]
    if missing:
        must = f"have values of the states, {list(state_names(system.states))}"
        raise invalid(f"{function}: inputs", must, f"{missing[0]!r} was missing")
    check_params(system, params, q, signals)
    warn_of_changes(system)
    check_range(signals, t, "t")
    try:
        check_declaration(system, params, signals, t, q, v)
    except ValueError as error:
        if signals and not isinstance(inputs, Mapping):
            error.add_note(
                "Inputs given by names are numbers. Give arrays as a dict: {name: array}."
            )
        raise
    known = concrete(t, q, params)
    params = lift_closure_tracers(system, params, q, signals)
    known = known and concrete(params)
    if known and system.quasi is not None:
        _check_regular(function, system, system.quasi, t, q, params)
    sample = _params.sample(_params.split(params)[0])
    return DeclaredPoint(system, sample, params, signals, t, q, v, known)


def _signals(function: str, inputs: Mapping[str, Any] | Sequence[str] | None) -> dict[str, Any]:
    """Inputs by name; those of a sequence of names are numbers, 0."""
    if inputs is None:
        return {}
    if not isinstance(inputs, Mapping):
        names = name_sequence(f"{function}: inputs", inputs)
        inputs = dict.fromkeys(names, jnp.zeros((), jnp.result_type(float)))
    return check_inputs(inputs)


def _check_regular(
    function: str, system: System, quasi: QuasiVelocities, t: Array, q: Array, params: Any
) -> None:
    """Refuse a place where the quasi-velocities do not determine the velocities."""
    with jax.ensure_compile_time_eval():
        sines = np.asarray(_sines((system,), params, None, t, q))
    bad = [name for name, x in zip(quasi.names, sines, strict=True) if x <= least_sine(q.dtype)]
    if bad:
        must = "be a place where the quasi-velocities determine the velocities"
        was = f"{bad[0]!r} depended on the others"
        fix = "Choose other quasi-velocities, or another place."
        raise invalid(f"{function}: q", must, was, fix)


@Compiled
def _sines(system: System, params: Any, _: None, t: Array, q: Array) -> Float[Array, " k"]:
    assert system.quasi is not None
    return system.quasi.sines(t, q, params, q.dtype)
