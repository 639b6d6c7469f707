"""Checks of the arguments of `simulate`, before compilation."""

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag._core._arguments import name_sequence, positive_integer
from jaxlag._core._arrays import common, concrete, of_state
from jaxlag._core._batching import at_most
from jaxlag._core._errors import invalid
from jaxlag._gradient._modes import MODES
from jaxlag._integration._change_points import CHANGE_POINTS
from jaxlag._integration._tableaus import remembers
from jaxlag._linalg._kkt import FORMULATIONS
from jaxlag._model._constraints import Baumgarte
from jaxlag._model._coordinates import vector_argument
from jaxlag._model._forces import reads_lam
from jaxlag._simulation._methods import default_tolerances
from jaxlag._simulation._quantities import QUANTITIES
from jaxlag._system._system import System
from jaxlag.solvers import AbstractPartitioned


def check_options(
    system: Any,
    gradient: Any,
    gradient_memory: Any,
    stabilization: Any,
    assemble: Any,
    save: Any,
    max_steps: Any,
) -> None:
    """Raise on options that are invalid for all values of the traced arguments."""
    if not isinstance(system, System):
        raise invalid("system", "be a jl.System", f"it was {system!r}")
    if gradient not in MODES:
        raise invalid(
            "gradient", f"be one of {', '.join(map(repr, MODES))}", f"it was {gradient!r}"
        )
    number = isinstance(gradient_memory, int | float | np.integer | np.floating)
    if gradient_memory is not None and (not number or not gradient_memory > 0):
        was = f"it was {gradient_memory!r}"
        raise invalid("gradient_memory", "be a positive number of bytes or None", was)
    if not isinstance(assemble, bool):
        raise invalid("assemble", "be True or False", f"it was {assemble!r}")
    baumgarte = isinstance(stabilization, Baumgarte)
    known = stabilization is None or (
        isinstance(stabilization, str) and stabilization == "projection"
    )
    if not baumgarte and not known:
        must = "be 'projection', None or a jl.Baumgarte(alpha, beta)"
        raise invalid("stabilization", must, f"it was {stabilization!r}")
    if baumgarte and not system.constraints:
        must = "be left out for a system without constraints"
        raise invalid("stabilization", must, f"it was {stabilization!r}")
    check_quantities(system, "save", save)
    positive_integer("max_steps", max_steps)


def check_quantities(system: System, argument: str, names: Any) -> None:
    """Raise on names that are no quantities of the system."""
    for name in name_sequence(argument, names):
        if not isinstance(name, str) or name not in (*QUANTITIES, "work"):
            known = [*QUANTITIES, "work"]
            fix = "Write 'multipliers'." if name == "lam" else ""
            raise invalid(argument, f"name quantities among {known}", f"one was {name!r}", fix)
        if name == "u" and system.quasi is None:
            must, was = "name quantities of the system", "one was 'u' without quasi-velocities"
            raise invalid(argument, must, was, "Declare the system with quasi=.")
        if name == "state_rates" and system.states is None:
            must, was = "name quantities of the system", "one was 'state_rates' without states"
            raise invalid(argument, must, was, "Declare the system with states=.")
        if name in ("kinetic", "potential") and getattr(system, f"_{name}") is None:
            raise invalid(
                argument,
                "name energies that the system declares",
                f"one was {name!r}",
                "Declare the system with kinetic= and potential=.",
            )


def check_solver(solver: Any, stabilization: Any, gradient_memory: Any) -> None:
    """Raise on options that do not apply to this solver."""
    name = type(solver).__name__
    if isinstance(solver, AbstractPartitioned) and isinstance(stabilization, Baumgarte):
        must = f"be left out for {name}, whose steps satisfy the constraints"
        raise invalid("stabilization", must, f"it was {stabilization!r}")
    if gradient_memory is not None and remembers(solver):
        must = f"be left out for {name}, which stores every step for derivatives"
        fix = "Take a one-step method."
        raise invalid("gradient_memory", must, f"it was {gradient_memory}", fix)


def check_change_points(change_points: Any) -> None:
    """Raise unless it is a known option."""
    if change_points not in CHANGE_POINTS:
        must = f"be one of {', '.join(map(repr, CHANGE_POINTS))}"
        raise invalid("change_points", must, f"it was {change_points!r}")


def check_formulation(
    system: System, formulation: Any, stabilization: Any, params: Any, dtype: Any
) -> str:
    """The formulation to be used; raises if the system does not have it."""
    known = ["auto", *FORMULATIONS] if system.constraints or system.quasi is not None else ["auto"]
    quasi = system.quasi
    why = "" if len(known) > 1 else "This system has no constraints: its state is (q, v)."
    left: list[str] = []
    if quasi is not None:
        rows = system._rows(params, dtype)
        if quasi.kinematics is None:
            left = [label for label in rows.labels if label not in quasi.constrained]
        if any(map(reads_lam, system.forces)):
            why = "Forces that depend on multipliers need formulation='multipliers'."
        elif left:
            why = (
                f"Quasi-velocities do not satisfy the rows {left}: pass the names of those that "
                "are zero as constrained=, or use formulation='multipliers'."
            )
        elif isinstance(stabilization, Baumgarte):
            why = "Baumgarte's terms need formulation='multipliers'."
        else:
            known.append("quasi")
    if formulation not in known:
        must = f"be among {tuple(known)}" if len(known) > 1 else "be 'auto'"
        raise invalid("formulation", must, f"it was {formulation!r}", why)
    if formulation != "auto":
        return formulation
    if quasi is None or "quasi" not in known:
        return FORMULATIONS[0]
    # Kinematics with more freedoms than the rows leave do not satisfy these by themselves.
    fitting = len(quasi.free) + system._rows(params, dtype).size <= system.size
    return "quasi" if fitting or quasi.kinematics is None else FORMULATIONS[0]


def check_start(system: System, q0: Any, v0: Any, u0: Any) -> tuple[Any, Any, Any]:
    """(q0, v0, u0) as arrays of one dtype, of numpy for lists; one of v0 and u0 is None."""
    if (v0 is None) == (u0 is None):
        was = "neither was given" if v0 is None else "both were given"
        raise invalid(
            "exactly one of `v0` and `u0`", "be given", was, "Pass v0=, the velocities at ts[0]."
        )
    quasi = system.quasi
    if u0 is not None and quasi is None:
        raise invalid(
            "u0",
            "be given for a system with quasi-velocities only",
            "this system has none",
            "Pass v0= instead.",
        )
    own = system.coordinates
    q0 = vector_argument(own, "q0", q0)
    if quasi is not None and u0 is not None:
        name, x = "u0", quasi.vector("u0", u0)
    else:
        name, x = "v0", vector_argument(own, "v0", v0)
    for argument, values in (("q0", q0), (name, x)):
        if concrete(values) and not np.isfinite(values).all():
            i = int(np.argmin(np.isfinite(values)))
            label = quasi.names[i] if quasi is not None and argument == "u0" else own.label(i)
            raise invalid(argument, "be finite", f"{argument}[{i}] ({label!r}) was {values[i]}")
    q0, x = of_state(f"q0 and {name}", q0, x)
    return (q0, None, x) if name == "u0" else (q0, x, None)


def _number(argument: str, must: str, x: Any, dtype: Any) -> Any:
    """An array of this dtype; a numpy one where x is concrete, which costs no dispatch."""
    try:
        given = np.asarray(x) if concrete(x) else jnp.asarray(x)
        kinds = (jnp.floating, jnp.integer)
        if any(jnp.issubdtype(given.dtype, kind) for kind in kinds):
            return given.astype(dtype)
    except (TypeError, ValueError) as error:
        raise invalid(argument, must, f"it was {x!r}") from error
    raise invalid(argument, must, f"it was {x!r}", "Give real numbers.")


class DirectedTimes(NamedTuple):
    """Times that may be traced, in a direction that is known.

    Attributes:
        ts: checked times, (s,).
        time_direction: 1 or -1; None if it is not known.
    """

    ts: Any
    time_direction: int | None


def check_times(ts: Any) -> tuple[Any, int | None]:
    """(times, 1 or -1 for their direction, None if they are traced)."""
    if isinstance(ts, DirectedTimes):
        return check_times(ts.ts)[0], ts.time_direction
    if ts is None:
        raise invalid("ts", "be given", "it was None", "Pass ts=jnp.linspace(0, 10, 501).")
    ts = _number("ts", "be an array of times", ts, jnp.result_type(float))
    if ts.ndim != 1 or not at_most(2, ts.shape[0]):
        fix = ""
        if ts.ndim == 1 and not isinstance(ts.shape[0], int):
            fix = f'Write jax.export.symbolic_shape("k", constraints=["{ts.shape[0]} >= 2"]).'
        raise invalid("ts", "be an array of at least 2 times", f"its shape was {ts.shape}", fix)
    if not concrete(ts):
        return ts, None
    if not np.isfinite(ts).all():
        raise invalid("ts", "be finite", f"ts[{int(np.argmin(np.isfinite(ts)))}] was not")
    steps = ts[1:] - ts[:-1]
    time_direction = 1 if ts[-1] >= ts[0] else -1
    if not (steps * time_direction > 0).all():
        i = int(np.argmin(steps * time_direction > 0))
        raise invalid(
            "ts",
            "be strictly monotone",
            f"ts[{i}] = {ts[i]}, ts[{i + 1}] = {ts[i + 1]}",
            "Sort the times and drop repeated ones.",
        )
    return ts, time_direction


def check_method(method: Any, rtol: Any, atol: Any, dt: Any) -> None:
    """Raise if two arguments set the same quantity."""
    tolerances = rtol is not None or atol is not None
    if dt is not None and tolerances:
        raise invalid("rtol and atol", "be left out with fixed steps", "dt was given too")
    if not isinstance(method, tuple):
        return
    if tolerances:
        raise invalid(
            "rtol and atol", "be left out when method has a controller", "both were given"
        )
    for name in ("step_ts", "jump_ts"):
        if getattr(method[-1], name, None) is not None:
            raise invalid(
                "method[1]",
                "have no times",
                f"it had {name}",
                "Make them knots of ZeroOrderHold or LinearInterpolation inputs: steps end there.",
            )


def check_tolerances(
    system: System, method: Any, rtol: Any, atol: Any, dtype: Any
) -> tuple[Any, Any]:
    """(rtol, atol) of the default controller, or of the one that `method` brings."""
    if rtol is None and atol is None and not isinstance(method, tuple):
        rtol, atol = (np.asarray(x, dtype) for x in default_tolerances(dtype))
        return rtol, atol
    if isinstance(method, tuple):
        rtol, atol = (getattr(method[-1], name, None) for name in ("rtol", "atol"))
        if np.ndim(atol):  # for every component of the state
            atol = jnp.max(jnp.asarray(atol))
    elif isinstance(atol, Mapping):
        atol = _by_name(system, atol)
    defaults = default_tolerances(dtype)
    rtol = _number("rtol", "be a number", defaults[0] if rtol is None else rtol, dtype)
    atol = _number("atol", "be a number", defaults[1] if atol is None else atol, dtype)
    states = 0 if system.states is None else system.states.size
    for name, x in (("rtol", rtol), ("atol", atol)):
        if x.ndim != 0 and (name == "rtol" or x.shape != (system.size + states,)):
            or_each = f", or one for each of {system.size} coordinates" * (name == "atol")
            beside = f" and {states} states" * (name == "atol" and states > 0)
            must = f"be a number{or_each}{beside}"
            raise invalid(name, must, f"its shape was {x.shape}")
        if concrete(x) and not np.all(np.isfinite(x) & (x >= 0)):
            raise invalid(name, "be finite and not negative", f"it was {x}")
    if concrete(rtol, atol):
        if rtol == 0 and np.any(atol == 0):
            raise invalid("rtol and atol", "not both be zero", "both were")
        least = 10 * jnp.finfo(dtype).eps
        if 0 < rtol < least:
            raise invalid(
                "rtol",
                f"be 0 or at least {least:.1e}, ten roundings of {jnp.dtype(dtype).name}",
                f"it was {rtol:g}",
                "Loosen it"
                + (
                    "."
                    if dtype == jnp.float64
                    else ', or compute in float64: jax.config.update("jax_enable_x64", True) and '
                    "q0, v0 in float64."
                ),
            )
    return rtol, atol


def _by_name(system: System, atol: Mapping[str, Any]) -> Array:
    """atol as an array, from a dict by the names of coordinates and states."""
    own, states = system.coordinates, system.states
    if states is None:
        return own.flatten(atol, "atol")
    if set(atol) != {*own.names, *states.names}:
        must = f"name exactly {[*own.names, *states.names]}"
        raise invalid("atol", must, f"it named {list(atol)}")
    parts = [
        layout.flatten({name: atol[name] for name in layout.names}, "atol")
        for layout in (own, states.layout)
    ]
    return jnp.concatenate(common(*parts))


def check_states_start(system: System, argument: str, x0: Any, *start: Any) -> tuple[Any, ...]:
    """(x0, *start) as arrays of one dtype; x0 is None for a system without states."""
    states = system.states
    if states is None:
        if x0 is not None:
            fix = "Declare them: System(..., states=jl.States(rate, names))."
            raise invalid(argument, "be left out for a system without states", "it was given", fix)
        return None, *start
    if x0 is None:
        fix = f"Give {list(states.layout.labels)}."
        raise invalid(argument, "be given for a system with states", "it was left out", fix)
    given = [states.vector(argument, x0), *(x for x in start if x is not None)]
    x0, *found = of_state(f"{argument} and start", *given)
    return x0, *(None if x is None else found.pop(0) for x in start)


def check_longest(dt: Any, dt_max: Any) -> Any:
    """The bound on adaptive steps; None for none."""
    if dt is not None and dt_max is not None:
        raise invalid("dt_max", "be left out with fixed steps", "dt was given too")
    return None if dt_max is None else _positive("dt_max", dt_max)


def check_step(dt: Any, dt0: Any) -> Any:
    """The fixed step, or the first one; None if neither is given."""
    if dt is not None and dt0 is not None:
        raise invalid("dt and dt0", "not both be given", "both were given")
    name, step = ("dt", dt) if dt is not None else ("dt0", dt0)
    return None if step is None else _positive(name, step)


def warn_of_long_step(dt: Any, ts: Any) -> None:
    """Warn if a fixed step is longer than the motion."""
    if dt is None or not concrete(dt, ts):
        return
    dt, span = float(dt), abs(float(ts[-1]) - float(ts[0]))
    rounding = 8 * float(np.finfo(ts.dtype).eps) * float(np.max(np.abs(ts)))
    if dt > span * (1 + 1e-6) + rounding:
        text = f"`dt` = {dt:g} s is longer than ts, {span:g} s: the motion is one shorter step."
        warnings.warn(text, UserWarning, stacklevel=5)  # below simulate and its two decorators


def _positive(name: str, step: Any) -> Any:
    step = _number(name, "be a number", step, jnp.result_type(float))
    if step.ndim != 0:
        raise invalid(name, "be a number", f"its shape was {step.shape}")
    if concrete(step) and not (np.isfinite(step) and step > 0):
        raise invalid(name, "be positive, even if ts decreases", f"it was {step}")
    return step
