"""simulate: from a declared system and a start to a Solution."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag import _params, _xla
from jaxlag._arguments import (
    check_declaration,
    check_options,
    check_range,
    check_start,
    check_step,
    check_times,
    check_tolerances,
)
from jaxlag._drive import Scheme, Times
from jaxlag._errors import SimulationError
from jaxlag._inputs import all_knots, check_inputs, common_range, evaluate, locate
from jaxlag._linalg import factor_mass, first_unhealthy
from jaxlag._methods import choose
from jaxlag._replay import Setup, solve
from jaxlag._solution import Solution, over_rows
from jaxlag._status import Status
from jaxlag._system import System

MAX_STEPS = 16384


class _Plan(NamedTuple):
    """What the compiled program is keyed by."""

    system: System
    scheme: _params.Static
    params: _params.Static
    inputs: _params.Static
    adaptive: bool
    direction: int | None  # +1 or -1 where ts is concrete, None where it is traced
    max_steps: int
    save: tuple[str, ...]


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


class _Motion(diffrax.ODETerm):
    """The vector field; increments keep the state's dtype where time has another."""

    dtype: Any = eqx.field(static=True)

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        return (t1 - t0).astype(self.dtype)


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
    params, inputs, rtol, atol, dt and dt0 never recompile; another number of times, method or
    structure of params does, and so does turning the direction of time round.

    The derivative under every transform is that of the solution at the frozen sequence of
    accepted steps, the dependence on ts and on the inputs' knots kept.

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
            "potential", "Q". Without it the Solution computes them on demand.
        gradient: a hint on the cost of derivatives, never on their value: "auto" or "recorded"
            (steps taken again on the recorded grid).
        project: whether constraints are projected; without constraints there is nothing to do.
        assemble: whether an inconsistent start is moved onto the constraints; the same.
        throw: raise `SimulationError` where a concrete result has a status other than ok.

    Raises:
        ValueError: an argument of wrong form or value, named.
        SimulationError: the motion did not reach ts[-1], with `throw=True` and concrete values;
            its `motion` attribute holds the part that was reached.

    Source: Pila, Introduction to Lagrangian Dynamics, ch. 3; Hairer, Norsett, Wanner, Solving
    Ordinary Differential Equations I, ch. II.
    """
    check_options(system, formulation, gradient, project, assemble, save, max_steps)
    q0, v0 = check_start(system, q0, v0, u0)
    ts, direction = check_times(ts)
    inputs = check_inputs(inputs)
    check_range(inputs, ts)
    rtol, atol = check_tolerances(rtol, atol, dt, q0.dtype)
    step = check_step(dt, dt0)
    params_traced, params_static = _params.split(params)
    solver, controller = choose(method, dt is None, rtol, atol)
    scheme_arrays, scheme_static = eqx.partition((solver, controller), eqx.is_array)
    inputs_arrays, inputs_static = eqx.partition(inputs, eqx.is_array)
    plan = _Plan(
        system,
        _params.Static(scheme_static),
        _params.Static(params_static),
        _params.Static(inputs_static),
        dt is None,
        direction,
        max_steps,
        tuple(save),
    )
    _xla.warn_if_late()
    values = _Values(q0, v0, ts, params_traced, inputs_arrays, scheme_arrays, rtol, atol, step)
    motion = _simulate(plan, values)
    if throw and not isinstance(motion.status, jax.core.Tracer):
        _raise_unless_ok(motion)
    return motion


@partial(jax.jit, static_argnums=0)
def _simulate(plan: _Plan, values: _Values) -> Solution:
    """The compiled program."""
    system, n, terms = plan.system, plan.system.size, plan.system.terms
    inputs = eqx.combine(values.inputs, plan.inputs.tree)
    ts = values.ts
    sigma = jnp.where(ts[-1] >= ts[0], 1.0, -1.0).astype(ts.dtype)
    direction = sigma if plan.direction is None else plan.direction
    params = _params.join(values.params, plan.params.tree)
    check_declaration(system, params, inputs, ts[0], values.q0, values.v0)

    def split(args: Any) -> tuple[Any, Any]:
        params = _params.join(args[0], plan.params.tree)
        return params, eqx.combine(args[1], plan.inputs.tree)

    def field(tau: Array, y: Array, args: Any) -> Array:
        """d(q, v)/dtau = sigma (v, a)."""
        params, inputs = split(args)
        t, q, v = tau * direction, y[:n], y[n:]
        values = evaluate(inputs, t, q, v, params, args[2])
        a = terms.acceleration(t, q, v, params, values)
        rate = jnp.concatenate([v, a])
        return rate if plan.direction == 1 else rate * jnp.asarray(direction, rate.dtype)

    def intervals(args: Any, tau: Array) -> Any:
        _, inputs = split(args)
        return (args[0], args[1], locate(inputs, tau * direction))

    y0 = jnp.concatenate([values.q0, values.v0])
    solver, controller = eqx.combine(values.scheme, plan.scheme.tree)
    scheme = Scheme(solver, controller, _Motion(field, y0.dtype), intervals)
    scheme_arrays, scheme_static = eqx.partition(scheme, eqx.is_array)
    args = (values.params, values.inputs, None)
    times, in_range = _times(inputs, ts * direction, direction)

    # Status at the start; nothing is integrated unless it is ok.
    start_args = intervals(args, times.start)
    rate = field(times.start, y0, start_args)
    valid = _valid(values, ts * direction)
    L = system.lagrangian(times.start * direction, values.q0, values.v0, params)
    started = valid & in_range & jnp.all(jnp.isfinite(rate)) & jnp.isfinite(L)
    setup = Setup(values.step, started, scheme_arrays)
    rows, outcome = solve(y0, args, times, setup, scheme_static, plan.max_steps)

    # What failed, and where: looked up at the last good state and at the end of the last try.
    tried = outcome.state + (outcome.tried - outcome.time).astype(y0.dtype) * field(
        outcome.time, outcome.state, intervals(args, outcome.time)
    )
    status = jnp.where(started, outcome.status, int(Status.nonfinite))
    short = (status == int(Status.ok)) & (times.stop < ts[-1] * direction)
    status = jnp.where(short | ~in_range, int(Status.input_range), status)
    status = jnp.where(valid, status, int(Status.bad_value)).astype(jnp.int32)
    mass, worst = _culprits(plan, values, field, intervals, outcome, tried, args)
    status = jnp.where(
        (status == int(Status.nonfinite)) & (mass >= 0), int(Status.mass_singular), status
    )
    where = _where(status, mass, worst, y0, n)

    q, v = rows.saved[:, :n], rows.saved[:, n:]
    saved = {
        name: over_rows(name, system, ts, q, v, *split(args)) for name in plan.save
    }
    return Solution(
        system=system,
        ts=ts,
        q=q,
        v=v,
        status=status,
        last_time=rows.time * direction,
        last_state=(rows.state[:n], rows.state[n:]),
        where=where,
        stats={
            "accepted": outcome.accepted,
            "rejected": outcome.attempted - outcome.accepted,
        },
        saved=saved,
        _inputs=inputs,
        _params=values.params,
        _static=plan.params,
    )


def _times(inputs: Any, saves: Array, direction: Any) -> tuple[Times, Array]:
    """Anchors of the grid in tau, and whether the inputs are defined at the start."""
    knots = all_knots(inputs)
    knots = None if knots is None else jnp.sort(knots.astype(saves.dtype) * direction)
    span = common_range(inputs)
    if span is None:
        return Times(saves[0], saves[-1], knots, saves), jnp.array(True)
    ends = jnp.stack([x.astype(saves.dtype) * direction for x in span])
    first, last = jnp.min(ends), jnp.max(ends)
    stop = jnp.where(saves[-1] <= last, saves[-1], last)
    return Times(saves[0], stop, knots, saves), (first <= saves[0]) & (saves[0] <= last)


def _valid(values: _Values, saves: Array) -> Array:
    """Value checks of everything that may be traced; concrete values have raised already."""
    eps = jnp.finfo(values.q0.dtype).eps
    rtol, atol = values.rtol, values.atol
    checks = [
        jnp.all(jnp.isfinite(values.q0)) & jnp.all(jnp.isfinite(values.v0)),
        jnp.all(jnp.isfinite(saves)) & jnp.all(saves[1:] > saves[:-1]),
        (rtol >= 0) & (atol >= 0) & (rtol + atol > 0) & ((rtol == 0) | (rtol >= 10 * eps)),
    ]
    if values.step is not None:
        checks.append(jnp.isfinite(values.step) & (values.step > 0))
    return jnp.all(jnp.stack(checks))


def _culprits(
    plan: _Plan, values: _Values, field: Any, intervals: Any, outcome: Any, tried: Array, args: Any
) -> tuple[Array, Array]:
    """(coordinate without inertia, coordinate with non-finite or largest acceleration), or -1."""
    n = plan.system.size
    params = _params.join(values.params, plan.params.tree)

    def at(tau: Array, y: Array) -> tuple[Array, Array]:
        t = tau if plan.direction == 1 else tau * jnp.sign(values.ts[-1] - values.ts[0])
        M = plan.system.terms.mass(t, y[:n], y[n:], params)
        a = jnp.abs(field(tau, y, intervals(args, tau))[n:])
        worst = jnp.where(
            jnp.all(jnp.isfinite(a)), jnp.argmax(a), jnp.argmin(jnp.isfinite(a))
        )
        return first_unhealthy(factor_mass(M)), worst.astype(jnp.int32)

    last_mass, last_worst = at(outcome.time, outcome.state)
    tried_mass, tried_worst = at(outcome.tried, tried)
    usable = jnp.all(jnp.isfinite(tried))
    mass = jnp.where(last_mass >= 0, last_mass, jnp.where(usable, tried_mass, -1))
    return mass, jnp.where(usable & (last_mass < 0), tried_worst, last_worst)


def _where(status: Array, mass: Array, worst: Array, y0: Array, n: int) -> Array:
    """Index of the coordinate that the status concerns, -1 if it concerns none."""
    bad_start = ~jnp.isfinite(y0)
    start = jnp.where(jnp.any(bad_start), jnp.argmax(bad_start) % n, -1)
    where = jnp.full((), -1, jnp.int32)
    for kind, index in (
        (Status.bad_value, start),
        (Status.mass_singular, mass),
        (Status.nonfinite, worst),
        (Status.step_below_resolution, worst),
        (Status.implicit_solve_failed, worst),
    ):
        where = jnp.where(status == int(kind), index, where)
    return where.astype(jnp.int32)


def _raise_unless_ok(motion: Solution) -> None:
    statuses = np.asarray(motion.status)
    if statuses.ndim == 0 and statuses != int(Status.ok):
        raise SimulationError(f"Simulation ended with status {motion.message()}", motion)
