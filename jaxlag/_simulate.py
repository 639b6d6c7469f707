"""simulate: from a declared system and a start to a Solution."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag import _params, _xla
from jaxlag._arguments import (
    check_declaration,
    check_method,
    check_options,
    check_start,
    check_step,
    check_times,
    check_tolerances,
)
from jaxlag._diagnosis import Start, diagnose, start_finite, values_allowed
from jaxlag._drive import Scheme, Times
from jaxlag._dynamics import Arguments, Dynamics
from jaxlag._errors import SimulationError
from jaxlag._inputs import all_knots, check_inputs, check_range, common_range
from jaxlag._methods import choose
from jaxlag._replay import Problem, Setup, solve
from jaxlag._solution import Solution, over_rows
from jaxlag._status import Status
from jaxlag._system import System

MAX_STEPS = 16384


class _Plan(NamedTuple):
    """What the compiled program is keyed by."""

    system: System
    params: _params.Static
    inputs: _params.Static
    scheme: _params.Static
    direction: int | None  # +1 or -1 where ts is concrete, None where it is traced
    max_steps: int
    save: tuple[str, ...]
    sample: _params.Sample


class _Values(NamedTuple):
    """What the compiled program takes."""

    q0: Array
    v0: Array
    ts: Array
    params: Any
    inputs: Any
    scheme: Any
    rtol: Array
    atol: Array
    step: Array | None  # dt or dt0


def simulate(
    system: System,
    q0: Any,
    v0: Any = None,
    ts: Any = None,
    params: Any = None,
    *,
    u0: Any = None,
    inputs: Mapping[str, Any] | None = None,
    method: Any = "auto",
    formulation: str = "auto",
    rtol: Any = None,
    atol: Any = None,
    dt: Any = None,
    dt0: Any = None,
    max_steps: int = MAX_STEPS,
    save: tuple[str, ...] = (),
    gradient: str = "auto",
    project: bool = True,
    assemble: bool = False,
    throw: bool = True,
) -> Solution:
    """Integrate M a + h = Q from (q0, v0) at ts[0], and return the motion at ts.

    Composes with jit, vmap, grad, jvp, jacfwd, jacrev and hessian. Other values of q0, v0, ts,
    inputs, rtol, atol, dt, dt0 and of the traced params never recompile; another number of times,
    method, static or structure of params does, and so does turning the direction of time round.

    The derivative under every transform is that of the solution at the frozen sequence of
    accepted steps, the dependence on ts and on the inputs' knots kept (where knots of two tables
    coincide, only for moving them together). It is zero in dt, dt0, rtol and atol.

    Args:
        system: what moves.
        q0: coordinates at ts[0]: (n,) numbers or a dict by name; m or rad.
        v0: velocities at ts[0], in the same form; m/s or rad/s. Exactly one of v0, u0.
        ts: (s,) times in s, strictly monotone either way, s >= 2. ts[0] is the start; the rest
            are save times and cost no steps.
        params: pytree handed to the Lagrangian and the forces. Floats and inexact arrays are
            traced and differentiable, the rest is static.
        u0: quasi-velocities at ts[0], for systems that declare them.
        inputs: dict from names to `ZeroOrderHold`, `Linear`, `Function`, `Feedback` or arrays
            (constant), read by the forces. Steps end on the knots of tables.
        method: "auto" (order 8), a name such as "tsit5", any diffrax solver, or a pair
            (solver, step-size controller).
        formulation: "auto": the state is (q, v).
        rtol: relative bound on the local error; by default 1e-9 in float64, 1e-5 in float32.
        atol: absolute bound on the local error; by default 1e-9 in float64, 1e-6 in float32.
        dt: fixed step in s (positive, whichever way time runs); the last one is shortened to
            land on ts[-1].
        dt0: first step in s of an adaptive solve, positive; by default chosen from the start.
        max_steps: bound on attempted steps. Derivatives keep a record of this many steps.
        save: names of quantities to compute inside the solve: "a", "p", "energy", "kinetic",
            "potential", "Q", "power", which the Solution computes on demand without it; and
            "work", the integral of each term of dH/dt since ts[0], which exists only here. It is
            integrated along with the motion, its local error bounded like that of q and v.
        gradient: a hint on the cost of derivatives, never on their value. "auto" and "recorded"
            are the same so far: steps are taken again on the recorded grid.
        project: whether constraints are projected; without constraints there is nothing to do.
        assemble: whether an inconsistent start is moved onto the constraints; the same.
        throw: raise `SimulationError` where a concrete result has a status other than ok.

    Raises:
        ValueError: an argument of wrong form or value, named.
        SimulationError: the motion did not reach ts[-1], with `throw=True` and concrete values;
            its `motion` attribute holds the part that was reached.

    Source: Pila, Introduction to Lagrangian Dynamics, ch. 3; Hairer, Norsett, Wanner, Solving
    Ordinary Differential Equations I, ch. II.

    Example:
        A mass on a spring, x'' = -k x / m, after a quarter of its period:

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     return 0.5 * params["m"] * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2
        >>> spring = jl.System(lagrangian, coordinates=("x",))
        >>> ts = jnp.array([0.0, jnp.pi / 2])
        >>> motion = jl.simulate(spring, [0.3], [0.0], ts, {"m": 2.0, "k": 2.0})
        >>> print(f"{motion.rate('x')[-1]:.6f} {motion.energy[-1]:.6f} {motion.message()}")
        -0.300000 0.090000 ok at t = 1.5707963267948966
    """
    check_options(system, formulation, gradient, project, assemble, save, max_steps)
    check_method(method, rtol, atol, dt)
    q0, v0 = check_start(system, q0, v0, u0)
    ts, direction = check_times(ts)
    inputs = check_inputs(inputs)
    check_range(inputs, ts)
    rtol, atol = check_tolerances(method, rtol, atol, q0.dtype)
    step = check_step(dt, dt0)
    params_traced, params_static = _params.split(params)
    inputs_traced, inputs_static = eqx.partition(inputs, _params.is_array)
    scheme = choose(method, dt is None, rtol, atol)
    scheme_traced, scheme_static = eqx.partition(scheme, _params.is_array)
    plan = _Plan(
        system=system,
        params=_params.Static(params_static),
        inputs=_params.Static(inputs_static),
        scheme=_params.Static(scheme_static),
        direction=direction,
        max_steps=max_steps,
        save=tuple(save),
        sample=_params.sample(params_traced),
    )
    values = _Values(q0, v0, ts, params_traced, inputs_traced, scheme_traced, rtol, atol, step)
    _xla.warn_if_late()
    motion = _simulate(plan, values)
    if throw and _params.concrete(motion.status):
        _raise_unless_ok(motion)
    return motion


def pose(plan: _Plan, values: _Values) -> tuple[Dynamics, Start, Problem]:
    """The problem that a plan and its values describe."""
    power = None
    if "work" in plan.save:
        params = _params.join(values.params, plan.params.tree)
        power = plan.system.power_terms(params, values.q0.dtype)
    dynamics = Dynamics(plan.system, plan.params, plan.inputs, plan.direction, power, plan.sample)
    args = dynamics.arguments(values.params, values.inputs, values.ts)
    params, inputs = dynamics.given(args)
    check_declaration(plan.system, params, inputs, values.ts[0], values.q0, values.v0)

    y0 = dynamics.start(values.q0, values.v0)
    start = dynamics.mirror(values.ts[0], args)
    args = dynamics.prepare(start, y0, args)
    solver, controller = eqx.combine(values.scheme, plan.scheme.tree)
    scheme = Scheme(solver, controller, dynamics.term(start, y0, args), dynamics.within)
    scheme_traced, scheme_static = eqx.partition(scheme, eqx.is_array)
    times, in_range = _times(dynamics, args, inputs, values.ts)
    valid = values_allowed(y0, times.saves, values.rtol, values.atol, values.step)
    finite = start_finite(dynamics, times.start, y0, args)
    setup = Setup(values.step, valid & in_range & finite, scheme_traced)
    problem = Problem(y0, args, times, setup, scheme_static, plan.max_steps)
    return dynamics, Start(valid, in_range, finite), problem


@partial(jax.jit, static_argnums=0)
def _simulate(plan: _Plan, values: _Values) -> Solution:
    """The compiled program: pose, solve, diagnose, derive what `save` names."""
    dynamics, start, problem = pose(plan, values)
    rows, outcome = solve(problem)
    status, where = diagnose(dynamics, problem, outcome, start)
    q, v = dynamics.parts(rows.saved)
    params, inputs = dynamics.given(problem.args)
    saved = {
        name: over_rows(name, plan.system, values.ts, q, v, params, inputs)
        for name in plan.save
        if name != "work"
    }
    if "work" in plan.save:
        saved["work"] = dynamics.work(rows.saved)
    return Solution(
        system=plan.system,
        ts=values.ts,
        q=q,
        v=v,
        status=status,
        last_time=dynamics.mirror(rows.time, problem.args),
        last_state=dynamics.parts(rows.state),
        where=where,
        stats={
            "accepted": outcome.accepted,
            "rejected": outcome.attempted - outcome.accepted,
        },
        saved=saved,
        _params_traced=values.params,
        _inputs_traced=values.inputs,
        _params_static=plan.params,
        _inputs_static=plan.inputs,
    )


def _times(
    dynamics: Dynamics, args: Arguments, inputs: Mapping[str, Any], ts: Array
) -> tuple[Times, Array]:
    """Anchors of the grid in tau, and whether the inputs are defined at the start."""

    def mirror(time: Array) -> Array:
        return dynamics.mirror(time.astype(ts.dtype), args)

    saves, knots, span = mirror(ts), all_knots(inputs), common_range(inputs)
    knots = None if knots is None else jnp.sort(mirror(knots))
    if span is None:
        return Times(saves[0], saves[-1], knots, saves), jnp.array(True)
    ends = jnp.stack([mirror(time) for time in span])
    first, last = jnp.min(ends), jnp.max(ends)
    stop = jnp.where(saves[-1] <= last, saves[-1], last)
    return Times(saves[0], stop, knots, saves), (first <= saves[0]) & (saves[0] <= last)


def _raise_unless_ok(motion: Solution) -> None:
    if np.ndim(motion.status) == 0 and int(motion.status) != int(Status.ok):
        raise SimulationError(f"Simulation ended with status {motion.message()}", motion)
