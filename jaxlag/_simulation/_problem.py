"""Build the initial-value problem from simulate's arguments."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxlag._core._arrays import stop_gradient
from jaxlag._gradient._split_problem import Problem, Setup
from jaxlag._integration._change_points import lengths_of, may_cross, may_stop, scales_at
from jaxlag._integration._initial_conditions import (
    Start,
    residuals,
    start_consistent,
    start_finite,
    values_allowed,
)
from jaxlag._integration._quasi_singularities import usual
from jaxlag._integration._record import Times
from jaxlag._integration._step_arguments import Arguments
from jaxlag._integration._step_end import StepEnd
from jaxlag._integration._stepper import Stepper
from jaxlag._integration._tableaus import looks_ahead
from jaxlag._integration._term import term_of
from jaxlag._integration._vector_field import VectorField
from jaxlag._model._constraints import Baumgarte
from jaxlag._model._inputs import all_knots, common_range, knots_increase
from jaxlag._model._states import named_states
from jaxlag._simulation._methods import for_state, solver_named
from jaxlag._simulation._options._method_requirements import check_requirements, splits
from jaxlag._statics._assemble import assembled
from jaxlag._system._inspection import check_declaration
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag.solvers import AbstractExplicit, AbstractPartitioned, Nystrom12, Splitting
from jaxlag.solvers._explicit import in_loop_over_stages
from jaxlag.solvers._stage_chord import for_long_code


class ProgramKey(NamedTuple):
    """The key of the compiled program."""

    system: System
    params: _params.Static
    inputs: _params.Static
    stepper: _params.Static
    time_direction: int | None  # +1 or -1 if ts is concrete, None if it is traced
    max_steps: int
    save: tuple[str, ...]
    sample: _params.Sample
    formulation: str
    stabilization: str | Baumgarte | None
    assemble: bool
    regular: bool | None
    blocks_definite: bool | None
    contact_rows_independent: bool
    capacity: int
    change_points: str
    structured: str | None  # the method that a system of a certain structure selects


class Values(NamedTuple):
    """The traced arguments of the compiled program."""

    q0: Array
    v0: Array | None  # one of v0 and u0
    u0: Array | None
    ts: Array
    params: Any
    inputs: Any
    x0: Array | None  # of the states beside (q, v)
    stepper: Any
    rtol: Array
    atol: Array
    step: Array | None  # dt or dt0
    longest: Array | None = None  # dt_max


def with_jax_arrays(values: Values) -> Values:
    """The same with JAX's arrays: under `jax.disable_jit` start and times may be numpy's."""
    given = values.ts, values.q0, values.v0, values.u0, values.x0
    ts, q0, v0, u0, x0 = jax.tree.map(jnp.asarray, given)
    return values._replace(ts=ts, q0=q0, v0=v0, u0=u0, x0=x0)


def build_problem(plan: ProgramKey, values: Values) -> tuple[VectorField, Start, Problem]:
    """The initial-value problem that a plan and its values describe."""
    # --- the equations, and their properties that hold for all states
    dynamics, args, method = equations(plan, values)
    params, inputs = dynamics.given(args)

    # --- the initial state: given, from quasi-velocities, or assembled
    initial = _initial_state(plan, values, dynamics, args)
    y0, args = _started(dynamics, initial, values.x0, params, args)
    consistent = start_consistent(dynamics, *initial.at, params, args)
    if dynamics.rows.size:
        y0, args = stop_gradient_unless(consistent.ok, (y0, args))

    # --- on the constraints
    start, once = jnp.zeros_like(args.origin), replace(dynamics, seldom=True)
    args = _with_scales(once, start, y0, args)
    if dynamics.projects:
        moved, _ = StepEnd(once).project(start, y0, args, differentiable=True)
        y0 = jnp.where(consistent.ok & jnp.all(jnp.isfinite(moved)), moved, y0)

    # --- the steps
    if isinstance(method[0], AbstractPartitioned):  # from here on the steps hold the constraints
        dynamics = replace(dynamics, stabilization=None, crossing=False)
        args = args._replace(lengths=None, units=None, slopes=None)
    stepper = stepper_of(dynamics, method, y0, args, values.longest)
    stepper_traced, stepper_static = eqx.partition(stepper, eqx.is_array)

    # --- the times, and whether the motion may start
    times, in_range = _times(dynamics, args, inputs, values.ts)
    valid = _valid(dynamics, values, inputs, args)
    finite = start_finite(dynamics, start, y0, args)
    if args.lengths is not None:  # rows dependent at the start may be so nearby
        finite = finite & jnp.all(args.lengths > 0)
    contacts = StepEnd(once).contacts_valid(start, y0, args)
    checks = Start(valid, in_range, finite, consistent, contacts)
    setup = Setup(values.step, checks.allowed, stepper_traced)
    problem = Problem(y0, args, times, setup, stepper_static, plan.max_steps, plan.capacity)
    return dynamics, checks, problem


def fallback(plan: ProgramKey, values: Values) -> str | None:
    """Why accelerations are computed on arrays.

    None on scalars, if arrays are declared, and for methods that do not use accelerations.
    """
    found: list[str | None] = []

    def look(values: Values) -> Array:
        dynamics, args, (solver, _) = equations(plan, values)
        size = dynamics.system.size + dynamics.speeds + dynamics.state_count
        y = jnp.zeros(size, values.q0.dtype)
        reason = dynamics.why_on_arrays(jnp.zeros_like(args.origin), y, args)
        found.append(None if isinstance(solver, AbstractPartitioned) else reason)
        return y

    jax.eval_shape(look, with_jax_arrays(values))
    return found[0]


class _Initial(NamedTuple):
    """The initial state; w0 are its velocities or free quasi-velocities."""

    t0: Array
    q0: Array
    v0: Array
    w0: Array

    @property
    def at(self) -> tuple[Array, Array, Array]:
        """(t0, q0, v0)."""
        return self[:3]


def equations(plan: ProgramKey, values: Values) -> tuple[VectorField, Arguments, tuple[Any, Any]]:
    """The vector field, its arguments, and (solver, controller)."""
    power = None
    if "work" in plan.save:
        params = _params.join(values.params, plan.params.tree)
        power = plan.system._power_terms(params, values.q0.dtype)
    dynamics = VectorField(
        plan.system,
        plan.params,
        plan.inputs,
        plan.time_direction,
        power,
        plan.sample,
        formulation=plan.formulation,
        stabilization=plan.stabilization,
        regular=plan.regular,
        blocks_definite=plan.blocks_definite,
        contact_rows_independent=plan.contact_rows_independent,
    )
    args = dynamics.arguments(values.params, values.inputs, values.ts)
    params, inputs = dynamics.given(args)
    dynamics = replace(dynamics, rows=plan.system._rows(params, values.q0.dtype))
    solver, controller = eqx.combine(values.stepper, plan.stepper.tree)
    if plan.structured is not None and _has_structure(plan, values, dynamics, args):
        solver = solver_named(plan.structured)
    elif not (isinstance(solver, Nystrom12) and "v" not in _variables(values, dynamics, args)):
        given = plan.formulation, params, inputs, values.q0.dtype
        check_requirements(plan.system, solver, *given)
    crossing = plan.change_points == "pass" and may_cross(dynamics)
    dynamics = replace(dynamics, crossing=crossing, extrapolates=looks_ahead(solver))
    return dynamics, args, (solver, controller)


def _has_structure(
    plan: ProgramKey, values: Values, dynamics: VectorField, args: Arguments
) -> bool:
    """Whether the system has the structure that the method `plan.structured` requires."""
    if isinstance(solver_named(plan.structured), Splitting):
        params, _ = dynamics.given(args)
        return splits(plan.system, plan.formulation, params, values.q0.dtype)
    return _variables(values, dynamics, args) <= {"q"} and dynamics.is_analytic(
        *_at_zero(values, dynamics, args)
    )


def _variables(values: Values, dynamics: VectorField, args: Arguments) -> frozenset[str]:
    """Those of (t, q, v) that accelerations read; all of them if that is not known."""
    found = dynamics.variables(*_at_zero(values, dynamics, args))
    return frozenset({"t", "q", "v"}) if found is None else found


def _at_zero(values: Values, dynamics: VectorField, args: Arguments) -> tuple[Any, ...]:
    """(tau, y, args) of the types of the motion."""
    size = dynamics.system.size + dynamics.speeds + dynamics.state_count
    return jnp.zeros_like(args.origin), jnp.zeros(size, values.q0.dtype), args


def _initial_state(
    plan: ProgramKey, values: Values, dynamics: VectorField, args: Arguments
) -> _Initial:
    """The initial state as given, with velocities from quasi-velocities, or assembled."""
    params, inputs = dynamics.given(args)
    t0, q0, v0, u0 = values.ts[0], values.q0, values.v0, values.u0
    if v0 is None:
        v0 = plan.system.velocities(q0, u0, params, t=t0)
    signals = inputs | named_states(plan.system.states, values.x0)
    check_declaration(plan.system, params, signals, t0, q0, v0)
    if plan.assemble and dynamics.rows.size:
        found = assembled(plan.system, dynamics.terms_at(q0, args), q0, v0, params, t0)
        q0, v0, u0 = found.q, found.v, None
    w0 = v0
    if dynamics.quasi is not None:
        u0 = dynamics.quasi.of(t0, q0, v0, params) if u0 is None else u0
        w0 = u0[dynamics.quasi.free]
    return _Initial(t0, q0, v0, w0)


def _started(
    dynamics: VectorField, initial: _Initial, x0: Array | None, params: Any, args: Arguments
) -> tuple[Array, Arguments]:
    """y at the start, and the arguments with the values computed once per solve.

    A lane without a consistent start, or with singular kinematics there, has no derivatives, so
    that those of the others stay finite.
    """
    t0, q0, v0, w0 = initial
    if dynamics.quasi is not None or dynamics.rows.size:
        known = (q0, dynamics.velocities(t0, q0, w0, params))
        terms = dynamics.terms_at(q0, args)
        known = (*known, *residuals(terms, dynamics.rows, t0, q0, v0, params))
        sound = jnp.all(jnp.isfinite(jnp.concatenate(known)))
        q0, w0, traced = stop_gradient_unless(sound, (q0, w0, args.params))
        args = args._replace(params=traced)
    y0 = dynamics.start(q0, w0, x0)
    start = jnp.zeros_like(args.origin)
    args = dynamics.precompute(start, y0, args)
    if dynamics.quasi is not None:
        args = args._replace(usual=usual(dynamics, *stop_gradient((start, q0, args))))
    return y0, args


def _with_scales(dynamics: VectorField, start: Array, y0: Array, args: Arguments) -> Arguments:
    """The arguments with the scales for the detection of change points."""
    if not dynamics.crossing:
        return args
    surface = dynamics.projector(*stop_gradient((start, y0, args)))
    assert surface.masses is not None
    lengths = lengths_of(surface.masses, args.active_rows)
    if surface.sparse:
        assert surface.units is not None
        return args._replace(lengths=lengths, units=surface.units())
    units, slopes = scales_at(dynamics, *stop_gradient((start, y0, args)))
    return args._replace(lengths=lengths, units=units, slopes=slopes)


def stepper_of(
    dynamics: VectorField, method: tuple[Any, Any], y0: Array, args: Arguments, longest: Any
) -> Stepper:
    """The stepper: solver, controller, vector field and post-processing."""
    solver, controller = for_state(*method, dynamics.system.size, dynamics.state_count, y0.shape[0])
    step_end = StepEnd(dynamics)
    term = term_of(dynamics, jnp.zeros_like(args.origin), y0, args)
    if isinstance(solver, AbstractExplicit) and solver.looped is None:
        solver = replace(solver, looped=in_loop_over_stages(term.lines, solver.stages))
    if hasattr(solver, "root_finder"):
        lines = dynamics.acceleration_lines(jnp.zeros_like(args.origin), y0, args)
        solver, term = for_long_code(solver, lines), term.with_jacobians
    after = step_end if step_end.settles else None
    how = (dynamics.windows, after, dynamics.projects, longest)
    passes = args.usual is not None
    stops = not dynamics.crossing and may_stop(dynamics)
    return Stepper(solver, controller, term, *how, passes=passes, stops=stops)


def _valid(dynamics: VectorField, values: Values, inputs: Any, args: Arguments) -> Array:
    """Whether start, times, tolerances and steps are within their bounds."""
    speeds = values.u0 if values.v0 is None else values.v0
    assert speeds is not None
    x0 = [] if values.x0 is None else [values.x0]
    given, saves = jnp.concatenate([values.q0, speeds, *x0]), dynamics.signed(values.ts, args)
    steps = values.step, values.longest
    valid = values_allowed(given, saves, values.rtol, values.atol, *steps)
    return valid & knots_increase(inputs)


def stop_gradient_unless(moves: Array, tree: Any) -> Any:
    """The same values, without derivatives if `moves` is False."""

    def unless(x: Any) -> Any:
        inexact = eqx.is_inexact_array(x)
        return jnp.where(moves, x, jax.lax.stop_gradient(x)) if inexact else x

    return jax.tree.map(unless, tree)


def velocities_at(
    dynamics: VectorField, ts: Array, y: Array, args: Arguments, moved: Array
) -> tuple[Array, Array]:
    """(q, v) at every save time of one motion; NaN at times that were not reached.

    A motion without steps has no derivatives, as its kinematics may be singular at the start.
    """
    q, w = dynamics.parts(y)
    if dynamics.quasi is None:
        return q, w
    reached = jnp.isfinite(q[:, :1])
    # States not reached are NaN: use the start instead, so that derivatives stay finite.
    safe = [jnp.where(reached, x, x[:1]) for x in (q, w)]
    ts, safe, args = stop_gradient_unless(moved, (ts, safe, args))
    v = jax.vmap(lambda t, q, w: dynamics.velocities_of(t, q, w, args))(ts, *safe)
    return q, jnp.where(reached, v, q[:, :1])  # NaN there, also in its derivatives


def _times(
    dynamics: VectorField, args: Arguments, inputs: Mapping[str, Any], ts: Array
) -> tuple[Times, Array]:
    """Anchors of the grid in tau, and whether the inputs are defined at the start."""

    def tau(time: Array) -> Array:
        return dynamics.tau(time.astype(ts.dtype), args)

    saves, knots, span = tau(ts), all_knots(inputs), common_range(inputs)
    knots = None if knots is None else jnp.sort(tau(knots))
    if span is None:
        return Times(saves[-1], knots, saves), jnp.array(True)
    ends = jnp.stack([tau(time) for time in span])
    first, last = jnp.min(ends), jnp.max(ends)
    stop = jnp.where(saves[-1] <= last, saves[-1], last)
    return Times(stop, knots, saves), (first <= 0) & (last >= 0)
