"""From `method`, tolerances and dt to a diffrax solver and step-size controller."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import optimistix

from jaxlag._drive import with_stages
from jaxlag._errors import bad
from jaxlag.solvers import Dopri8

METHODS: dict[str, type[diffrax.AbstractSolver]] = {
    "euler": diffrax.Euler,
    "heun": diffrax.Heun,
    "midpoint": diffrax.Midpoint,
    "ralston": diffrax.Ralston,
    "bosh3": diffrax.Bosh3,
    "tsit5": diffrax.Tsit5,
    "dopri5": diffrax.Dopri5,
    "dopri8": Dopri8,
    "implicit_euler": diffrax.ImplicitEuler,
    "kvaerno3": diffrax.Kvaerno3,
    "kvaerno4": diffrax.Kvaerno4,
    "kvaerno5": diffrax.Kvaerno5,
}
AUTO = "dopri8"


def choose(
    method: Any, adaptive: bool, rtol: Any, atol: Any
) -> tuple[diffrax.AbstractSolver, diffrax.AbstractStepSizeController | None]:
    """Solver and controller (None for a fixed step).

    Args:
        method: "auto", a name of METHODS, a diffrax solver, or (solver, controller).
        adaptive: whether dt was left out.
        rtol: relative tolerance of the default controller, and of implicit equations.
        atol: absolute tolerance, the same.

    Raises:
        ValueError: unknown name, a solver for other kinds of equations, a controller together
            with dt, an adaptive step for a solver without error estimate.
    """
    controller = None
    if isinstance(method, tuple) and len(method) == 2:
        method, controller = method
        if not isinstance(controller, diffrax.AbstractStepSizeController):
            raise bad("method[1]", "be a diffrax step-size controller", f"it was {controller!r}")
        if not adaptive:
            raise bad("dt", "be left out when method brings its own controller", "both were given")
        if isinstance(controller, diffrax.ConstantStepSize | diffrax.StepTo):
            raise bad(
                "method[1]",
                "adapt the step",
                f"it was {type(controller).__name__}",
                "Give dt= for fixed steps.",
            )
    solver = _solver(method)
    if adaptive and not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise bad(
            "method",
            "estimate its error when dt is left out",
            f"{type(solver).__name__} has no error estimate",
            "Give dt= for fixed steps, or choose another method.",
        )
    if adaptive and controller is None:
        controller = diffrax.PIDController(rtol=rtol, atol=atol)
    return _with_tolerances(solver, controller, rtol, atol), controller


def _solver(method: Any) -> diffrax.AbstractSolver:
    if isinstance(method, str):
        name = AUTO if method == "auto" else method
        if name not in METHODS:
            raise bad(
                "method",
                f"be 'auto', one of {sorted(METHODS)}, a diffrax solver or (solver, controller)",
                f"it was {method!r}",
            )
        method = METHODS[name]()
    if not isinstance(method, diffrax.AbstractSolver):
        raise bad("method", "be a name or a diffrax solver instance", f"it was {method!r}")
    if not (
        isinstance(method.term_structure, type)
        and issubclass(diffrax.ODETerm, method.term_structure)
    ):
        raise bad(
            "method",
            "integrate an ordinary differential equation y' = f(t, y)",
            f"{type(method).__name__} wants terms {method.term_structure}",
        )
    return with_stages(method, "lax")


def _with_tolerances(
    solver: diffrax.AbstractSolver, controller: Any, rtol: Any, atol: Any
) -> diffrax.AbstractSolver:
    """Implicit solvers take the tolerances of their equations from the step-size control."""
    finder = getattr(solver, "root_finder", None)
    if finder is None:
        return solver
    source = {
        "rtol": getattr(controller, "rtol", rtol),
        "atol": getattr(controller, "atol", atol),
        "norm": getattr(controller, "norm", optimistix.max_norm),
    }
    # diffrax marks "take it from the controller" by an object that is neither number nor function.
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


def default_tolerances(dtype: Any) -> tuple[float, float]:
    """(rtol, atol): 1e-9 in float64, 1e-5 and 1e-6 in float32."""
    return (1e-9, 1e-9) if jnp.finfo(dtype).bits == 64 else (1e-5, 1e-6)
