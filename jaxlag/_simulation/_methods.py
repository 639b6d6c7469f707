"""The diffrax solver and step-size controller from `method`, tolerances and dt."""

from collections.abc import Callable
from difflib import get_close_matches
from functools import lru_cache, partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._integration._tableaus import with_stages
from jaxlag.solvers import (
    AbstractFixedStep,
    Dopri5,
    Dopri8,
    GaussLegendre,
    LobattoIIIAB,
    Nystrom12,
    Prince9,
    Splitting,
    Tsit5,
)
from jaxlag.solvers._stage_chord import StageChord

METHODS: dict[str, Callable[[], diffrax.AbstractSolver]] = {
    "euler": diffrax.Euler,
    "heun": diffrax.Heun,
    "midpoint": diffrax.Midpoint,
    "ralston": diffrax.Ralston,
    "bosh3": diffrax.Bosh3,
    "tsit5": Tsit5,
    "dopri5": Dopri5,
    "dopri8": Dopri8,
    "prince9": Prince9,
    "nystrom12": Nystrom12,
    "implicit_euler": diffrax.ImplicitEuler,
    "kvaerno3": diffrax.Kvaerno3,
    "kvaerno4": diffrax.Kvaerno4,
    "kvaerno5": diffrax.Kvaerno5,
    "splitting2": partial(Splitting, 2),
    "splitting4": partial(Splitting, 4),
    "splitting6": partial(Splitting, 6),
    "splitting8": partial(Splitting, 8),
    "gauss2": partial(GaussLegendre, 1),
    "gauss4": partial(GaussLegendre, 2),
    "gauss6": partial(GaussLegendre, 3),
    "gauss8": partial(GaussLegendre, 4),
    "variational2": partial(LobattoIIIAB, 2),
    "variational4": partial(LobattoIIIAB, 3),
}
HABITS = {
    **dict.fromkeys(("rk4", "runge-kutta", "rk"), "'dopri5' with dt=, of order 5"),
    **dict.fromkeys(("rk45", "ode45", "dopri", "lsoda"), "'tsit5' or 'dopri5'"),
    **dict.fromkeys(("rk23", "ode23"), "'bosh3'"),
    **dict.fromkeys(("dop853", "dopri853", "rk8"), "'dopri8'"),
    **dict.fromkeys(("radau", "bdf", "ode15s", "stiff", "implicit"), "'kvaerno5'"),
    **dict.fromkeys(
        ("symplectic", "hamiltonian", "geometric"),
        "'splitting4' where L = T(v) - V(q), 'gauss4' for any L, 'variational4' under "
        "constraints, each with dt=",
    ),
    **dict.fromkeys(
        ("verlet", "leapfrog", "stormer", "semi_implicit_euler", "symplectic_euler"),
        "'splitting2' with dt=",
    ),
    **dict.fromkeys(("yoshida", "forest-ruth"), "'splitting4' with dt="),
    **dict.fromkeys(("midpoint_implicit", "implicit_midpoint"), "'gauss2' with dt="),
}
"""Names of methods in other libraries, and the nearest method here."""
LOOSE, TIGHT = 1e-3, 1e-12  # rtol: order 5 from the first upwards, order 9 up to the second
SMOOTH = 1e-8  # rtol: up to here order 12 where accelerations do not depend on v
IMPLICIT = "kvaerno5"  # if explicit steps run out
FINER = {
    "bosh3": "tsit5",
    "tsit5": "dopri8",
    "dopri5": "dopri8",
    "dopri8": "prince9",
    "nystrom12": "prince9",
}
# For steps of order 8 to 12, whose errors grow by 1.1^9 to 1.1^13 if a step is 10 % too long.
SAFETY = {Dopri8: 0.8, Prince9: 0.8, Nystrom12: 0.8}


def choose(
    method: Any, adaptive: bool, rtol: Any, atol: Any
) -> tuple[diffrax.AbstractSolver, diffrax.AbstractStepSizeController | None]:
    """Solver and controller (None for a fixed step).

    Args:
        method: "auto", a name of METHODS, a diffrax solver, or (solver, controller).
        adaptive: whether dt was left out.
        rtol: relative tolerance of the default controller, and of implicit equations.
        atol: absolute tolerance, the same; for every component of the state if it is an array.

    Raises:
        ValueError: unknown name, a solver for other kinds of equations, a controller together
            with dt, an adaptive step for a solver without error estimate.
    """
    controller = None
    if isinstance(method, tuple) and len(method) == 2:
        method, controller = method
        if not isinstance(controller, diffrax.AbstractStepSizeController):
            raise invalid(
                "method[1]", "be a diffrax step-size controller", f"it was {controller!r}"
            )
        if not adaptive:
            raise invalid("dt", "be left out when method has a controller", "both were given")
        if isinstance(controller, diffrax.ConstantStepSize | diffrax.StepTo):
            raise invalid(
                "method[1]",
                "adapt the step",
                f"it was {type(controller).__name__}",
                "Give dt= for fixed steps.",
            )
    solver = _solver(method, _tolerance(rtol, atol) if adaptive else None)
    if adaptive and isinstance(solver, AbstractFixedStep):
        raise invalid(
            "dt",
            f"be given for {type(solver).__name__}",
            "a step-size controller was given instead" if controller else "it was left out",
            "Its map from step to step keeps the structure of the equations only as long as all "
            "steps are equal: pass dt=0.01.",
        )
    if adaptive and not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise invalid(
            "method",
            "estimate its error when dt is left out",
            f"{type(solver).__name__} has no error estimate",
            "Give dt= for fixed steps, or choose another method.",
        )
    if adaptive and controller is None:
        safety = SAFETY.get(type(solver), 0.9)
        controller = diffrax.PIDController(rtol=rtol, atol=atol, safety=safety, norm=_rms)
    if isinstance(method, str) and hasattr(solver, "root_finder"):
        return _with_chord(solver, rtol, atol), controller
    return _with_tolerances(solver, controller, rtol, atol), controller


def _rms(x: Array) -> Array:
    """Root mean square. A product of x with itself would prevent a loop of plain operations."""
    return jnp.sqrt(jnp.mean(x**2))


def automatic(tolerance: Any) -> str:
    """The explicit method that is cheapest for a tolerance; order 8 if the tolerance is unknown.

    At equal errors of the motion, on a double pendulum, a Kepler orbit of e = 0.6 and the system of
    Henon and Heiles: order 5 takes as long as order 8 at 1e-4 and compiles in half the time. But at
    1e-4 its errors were more than ten times the tolerance times the condition number in 4 of 126
    motions of the catalog, those of order 8 in none of them. Order 9 takes 1.1 of order 8 at 1e-6,
    0.95 at 1e-9 and 0.8 at 1e-12. At equal tolerance order 9 takes 1.3 to 1.8 times the evaluations
    of order 8, and is a hundred times as accurate.
    """
    if tolerance is None:
        return "dopri8"
    if tolerance >= LOOSE:
        return "tsit5"
    return "prince9" if tolerance <= TIGHT else "dopri8"


def of_structure(method: Any, adaptive: bool, rtol: Any, atol: Any) -> str | None:
    """The method that "auto" is for systems of a certain structure; None if it is the same for all.

    With fixed steps that is splitting for L = T(v) - V(t, q). With adaptive ones it is Nystrom's
    method of order 12 for accelerations a(q): to errors of 1e-9 it takes 0.6 of order 8 on Kepler
    orbits of e = 0.6 and 0.9, on a spring pendulum and on three oscillators, 0.8 on the system of
    Henon and Heiles, 0.45 on four bodies; at equal tolerances as long, and its errors are a
    hundredth. At 1e-6 they are alike. Not for a(t, q): its longer steps pass a pulse in t more
    easily.
    """
    if method != "auto":
        return None
    if not adaptive:
        return "splitting8"
    tolerance = _tolerance(rtol, atol)
    return "nystrom12" if tolerance is not None and tolerance <= SMOOTH else None


def _tolerance(rtol: Any, atol: Any) -> Any:
    """The tolerance; None while tracing. rtol has no unit; atol has those of the coordinates."""
    if not concrete((rtol, atol)):
        return None
    return rtol if rtol > 0 else np.min(atol)


def name_of(solver: diffrax.AbstractSolver) -> str:
    """The name of a solver in METHODS, or else that of its class."""
    default = type(solver).__name__
    for name, make in METHODS.items():
        known = make()
        if isinstance(known, AbstractFixedStep):
            if jax.tree.structure(known) == jax.tree.structure(solver):
                return name
        elif type(solver) in (type(known), type(getattr(known, "stock", known))):
            finder = getattr(solver, "root_finder", None)
            ours = finder is None or type(finder) is StageChord
            return name if ours else default
    return default


def _nearest(name: str) -> str:
    """The nearest method for a name of another library, or for a misspelled name."""
    plain = name.lower().replace("-", "_")
    found = HABITS.get(plain) or HABITS.get(plain.replace("_", "-"))
    if found is None:
        close = get_close_matches(plain, METHODS, 1)
        found = repr(close[0]) if close else None
    return "" if found is None else f"The nearest is {found}."


@lru_cache
def solver_named(name: str) -> diffrax.AbstractSolver:
    """The solver of this name."""
    return with_stages(METHODS[name](), "lax")


def _solver(method: Any, tolerance: Any) -> diffrax.AbstractSolver:
    if isinstance(method, str):
        name = automatic(tolerance) if method == "auto" else method
        if name not in METHODS:
            raise invalid(
                "method",
                f"be 'auto', one of {sorted(METHODS)}, a diffrax solver or (solver, controller)",
                f"it was {method!r}",
                _nearest(method),
            )
        return solver_named(name)
    if not isinstance(method, diffrax.AbstractSolver):
        raise invalid("method", "be a name or a diffrax solver instance", f"it was {method!r}")
    if not (
        isinstance(method.term_structure, type)
        and issubclass(diffrax.ODETerm, method.term_structure)
    ):
        raise invalid(
            "method",
            "integrate an ordinary differential equation y' = f(t, y)",
            f"{type(method).__name__} requires terms {method.term_structure}",
        )
    return with_stages(method, "lax")


def _with_chord(solver: Any, rtol: Any, atol: Any) -> diffrax.AbstractSolver:
    """Solve the equations of an implicit step to a tenth of the tolerance.

    The solver's own root finder gives up if its first iterations converge slowly, and steps shrink
    until they converge: 5 times as many steps on a double pendulum, 20 times on an elastic pendulum
    of stiffness 1e6, half of them rejected, with errors far below the tolerance. At equal errors it
    takes 2 to 3 times as long.
    """
    dtype = jnp.result_type(rtol)
    least = 10 * float(jnp.finfo(dtype).eps)
    known = concrete((rtol, atol))  # numpy: no dispatch
    larger = (lambda x: np.asarray(np.maximum(x, least), dtype)) if known else None
    bounds: Any = [
        larger(0.1 * x) if larger else jnp.maximum(0.1 * x, least).astype(dtype)
        for x in (rtol, atol)
    ]
    finder = StageChord(*bounds)
    return eqx.tree_at(lambda s: s.root_finder, solver, finder)


def _with_tolerances(
    solver: diffrax.AbstractSolver, controller: Any, rtol: Any, atol: Any
) -> diffrax.AbstractSolver:
    """Implicit solvers use the tolerances of the step-size control for their equations."""
    finder = getattr(solver, "root_finder", None)
    if finder is None:
        return solver
    source = {
        "rtol": getattr(controller, "rtol", rtol),
        "atol": getattr(controller, "atol", atol),
        "norm": getattr(controller, "norm", optimistix.max_norm),
    }
    # diffrax marks "use the controller's value" by an object that is neither number nor function.
    unset = [
        name
        for name in source
        if hasattr(finder, name)
        and not (eqx.is_array_like(getattr(finder, name)) or callable(getattr(finder, name)))
    ]
    if not unset:
        return solver
    return eqx.tree_at(
        lambda s: [getattr(s.root_finder, name) for name in unset],
        solver,
        [source[name] for name in unset],
    )


def of_components(atol: Any, n: int) -> Array:
    """atol of every component of (q, v, x), from those of n coordinates and of x.

    That of a coordinate is also used for its velocity.
    """
    return jnp.concatenate([atol[:n], atol])


def for_state(solver: Any, controller: Any, n: int, k: int, size: int) -> tuple[Any, Any]:
    """Solver and controller with one atol for every component of the state.

    Args:
        solver: of `choose`.
        controller: the same.
        n: number of coordinates.
        k: number of states beside them.
        size: of the state (q, v, x), with the integrals that follow it.
    """

    def of(owner: Any) -> Any:
        atol: Any = getattr(owner, "atol", None)
        if not eqx.is_array(atol) or atol.shape != (n + k,):
            return owner
        rest = jnp.full((size - 2 * n - k,), jnp.max(atol))
        each = jnp.concatenate([of_components(atol, n), rest])
        return eqx.tree_at(lambda x: x.atol, owner, each)

    finder = getattr(solver, "root_finder", None)
    if finder is not None:
        solver = eqx.tree_at(lambda s: s.root_finder, solver, of(finder))
    return solver, of(controller)


def default_tolerances(dtype: Any) -> tuple[float, float]:
    """(rtol, atol): 1e-9 in float64, 1e-5 and 1e-6 in float32, 20 roundings in less than that."""
    if jnp.finfo(dtype).bits >= 32:
        return (1e-9, 1e-9) if jnp.finfo(dtype).bits == 64 else (1e-5, 1e-6)
    least = 20.0 * float(jnp.finfo(dtype).eps)
    return least, least
