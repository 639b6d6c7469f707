"""simulate: from a declared system and a start to a Solution."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlag._core import _xla
from jaxlag._core._arguments import renamed, required
from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._core._status import Status
from jaxlag._gradient._modes import capacity_for
from jaxlag._gradient._solve import solve
from jaxlag._integration._initial_conditions import rows_hold_after
from jaxlag._integration._stepper import Stepper
from jaxlag._integration._tableaus import remembers
from jaxlag._linalg._kkt import FORMULATIONS
from jaxlag._model._constraints import Baumgarte
from jaxlag._model._inputs import all_knots, check_inputs, check_range
from jaxlag._simulation._arguments import (
    check_change_points,
    check_formulation,
    check_longest,
    check_method,
    check_options,
    check_start,
    check_step,
    check_times,
    check_tolerances,
)
from jaxlag._simulation._compile_log import timed
from jaxlag._simulation._error_estimate import LEFT, check_estimate, finer, with_error
from jaxlag._simulation._failure import final_status
from jaxlag._simulation._jump_times import Jumps, warned
from jaxlag._simulation._methods import FINER, IMPLICIT, METHODS, choose, name_of
from jaxlag._simulation._problem import ProgramKey, Values, build_problem, velocities_at
from jaxlag._simulation._quantities import at_saves
from jaxlag._simulation._sharding import check_placement
from jaxlag._simulation._solution import Solution
from jaxlag._simulation._step_diagnosis import is_stiff
from jaxlag._system._closure_tracers import check_params, lift_closure_tracers
from jaxlag._system._inspection import contact_rows_independent, mass_definite
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._traced_function import warn_of_changes
from jaxlag.solvers import AbstractPartitioned

MAX_STEPS = 16384
_MAY_BE_SINGULAR = (
    Status.kinematics_singular,
    Status.nonfinite,
    Status.step_below_resolution,
)


@renamed(project="stabilization='projection', None or a jl.Baumgarte")
@required(v0="Pass v0=None beside u0=.", ts="Pass ts=jnp.linspace(0, 10, 501).")
def simulate(
    system: System,
    q0: Any,
    v0: Any,
    ts: Any,
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
    dt_max: Any = None,
    max_steps: int = MAX_STEPS,
    save: tuple[str, ...] = (),
    gradient: str = "auto",
    gradient_memory: int | float | None = None,
    stabilization: str | Baumgarte | None = "projection",
    change_points: str = "pass",
    assemble: bool = False,
    estimate_error: bool = False,
    throw: bool = True,
) -> Solution:
    """Integrate M a + h = Q + A^T lam, A v + b = 0 from (q0, v0) at ts[0]; return it at ts.

    Composes with jit, vmap, grad, jvp, jacfwd, jacrev and hessian. Other values of q0, v0, ts,
    inputs, rtol, atol, dt, dt0, dt_max and of the traced params never recompile, unless a tolerance
    makes "auto" another method; another number of times, method, static or structure of params
    does, and so does turning the direction of time round, and each transform. What takes more than
    5 s is said on the log "jaxlag".

    The derivative under every transform is that of the solution at the frozen sequence of
    accepted steps, the dependence on ts and on the inputs' knots kept (where knots of two tables
    coincide, only for moving them together). It is zero in dt, dt0, dt_max, rtol and atol.

    Where L or a force compares what moves (max(x, 0), where, abs), perturbations jump as the force
    bends: steps along which derivatives are taken are shortened where a comparison comes out
    otherwise, as far as `max_steps` lets them. A first derivative is then about as good as the
    motion. It leaves out how the time moves at which a force itself jumps (sign(v), where between
    two values), and a second one what every bend adds, as JAX's own derivatives of such functions
    do: smooth the force (tanh, softplus) where that matters. Where the time of a jump is told by
    params, a warning names these; knots of inputs that depend on them give the whole derivative.

    Args:
        system: what moves.
        q0: coordinates at ts[0]: (n,) numbers or a dict by name; m or rad.
        v0: velocities at ts[0], in the same form; m/s or rad/s. Exactly one of v0, u0.
        ts: (s,) times in s, strictly monotone either way, s >= 2. ts[0] is the start; the rest
            are save times and cost no steps.
        params: pytree handed to the Lagrangian and the forces. Floats and inexact arrays are
            traced and differentiable, the rest is static, and must be of types that cannot change.
        u0: quasi-velocities at ts[0], for systems that declare them: (k,) numbers in the order of
            their names, or a dict by name; constrained ones are zero, and may be left out of a
            dict; m/s or rad/s.
        inputs: dict from names to `ZeroOrderHold`, `LinearInterpolation`, `TimeFunction`,
            `Feedback` or arrays (constant), read by the forces. Steps end on the knots of tables.
        method: "auto", a name such as "tsit5", any diffrax solver, or a pair (solver, step-size
            controller). "auto" is "dopri8"; "tsit5" where rtol is known and at least 1e-3;
            "prince9" where it is at most 1e-12; with fixed steps "splitting8" for T(v) - V(t, q)
            without forces and constraints (a fifth of the time of "dopri8", and as accurate or
            better in orbits and pendulums, but not at steps beyond 1 / omega); and "kvaerno5",
            outside of transforms, where a stiff motion took max_steps explicit steps.
            `Solution.method` names it. Implicit methods by name solve their equations to a tenth of
            the tolerance; instances of diffrax's classes do as they were made to. "kvaerno4" and
            "kvaerno5" read forces up to a quarter of a step beyond the last time.
            Methods that keep the structure of the equations, for
            long runs with fixed steps dt: "splitting2", "splitting4", "splitting6", "splitting8"
            (`solvers.Splitting`) where M is constant and nothing that accelerates depends on v;
            "gauss2" to "gauss8" (`solvers.GaussLegendre`) for any L without constraints;
            "variational2" and "variational4" (`solvers.LobattoIIIAB`) for any L, with holonomic
            constraints held inside the step, so that `stabilization` has nothing to do.
        formulation: what the state is and how accelerations are found.
            "quasi" ("auto" where quasi-velocities are declared and take care of all rows): (q, u)
            with the quasi-velocities that are not constrained, no multipliers. Kinematics do so
            where they leave no more freedoms than there are coordinates less rows.
            "multipliers" ("auto" else; and where quasi-velocities become singular on the way,
            outside of transforms and with L in v, which `motion.message()` says then): (q, v),
            M + A^T W A and its Schur complement, factored once each. "null_space": (q, v), M on the
            tangent space of the constraints. Both take an M that is singular, but not on that space
            (links without mass).
            A motion in quasi-velocities that comes to a place where these are singular, as a
            steered wheel at 90 degrees, ends just before it in the status kinematics_singular;
            with fixed steps one step before it.
        rtol: relative bound on the local error; by default 1e-9 in float64, 1e-5 in float32.
        atol: absolute bound on the local error; by default 1e-9 in float64, 1e-6 in float32. A
            number, or one for every coordinate and its velocity: (n,) of them, or a dict by name.
        dt: fixed step in s (positive, whichever way time runs); the last one is shortened to
            land on ts[-1].
        dt0: first step in s of an adaptive solve, positive; by default chosen from the start.
        dt_max: bound on the steps of an adaptive solve in s, positive; None for none. A pulse, of a
            `TimeFunction` or of explicit time, that is shorter than a step and between two of its
            stages is not seen: bound the steps by its length, or say where it begins and ends
            (`TimeFunction(f, knots=)`).
        max_steps: bound on attempted steps. Derivatives keep a record of this many steps.
        save: names of quantities to compute inside the solve: "a", "u", "p", "energy", "kinetic",
            "potential", "Q", "power", "multipliers", "constraint_force", which the Solution
            computes on demand without it; and "work", the integral of each term of dH/dt since
            ts[0], which exists only here. It is integrated along with the motion, its local error
            bounded like that of q and v.
        gradient: a hint on the cost of reverse derivatives, never on their value.
            "recorded" keeps the state at the start of every step. "checkpoints" keeps about the
            square root as many and takes the steps between two again, one more solve. "forward"
            keeps none: reverse derivatives are put together from forward ones, the dearer the
            more numbers move. "auto" keeps up to 512 states, which is "recorded" up to 512 steps,
            and where `gradient_memory` is less than that the fastest mode that fits. All keep the
            times of max_steps steps. What was done is in `motion.gradient_mode`. Forward
            derivatives need the times alone.
        gradient_memory: bound on what reverse derivatives of one motion keep, bytes; None for
            none.
        stabilization: "projection": accepted steps and saved states are moved onto the
            constraints, q along M^-1 A^T, then v (with quasi-velocities there is nothing to move
            but q). None: they are left to drift. `Baumgarte(alpha, beta)`: residuals are damped
            instead.
        change_points: what becomes of a motion where constraint rows that are independent elsewhere
            depend on one another, as in a linkage that lies flat: there it may go on in more than
            one way, and reactions may be infinite. "pass": it goes on along the tangent that it
            came on, as accurate as elsewhere, with its derivatives. Where ways touch that do not
            cross, one ends in a cusp, nothing is projected, or forces read multipliers, it ends
            there, in the status rank_change. "stop": it ends just before every such place, at every
            tolerance; with fixed steps one step before it. Variational methods stop, and so do
            equal steps of which one meets the place with an end or a stage, to 1e-5 of a step.
            States are saved there, too, and a motion may end there: by a polynomial through both
            ends of a short step, with velocities to 1e-9 at best, at loose tolerances to some
            hundred of them. In float32 rounding shows there: 1e-2 at worst of 384 linkages that
            pass two such places, 3e-5 in the median.
        assemble: whether an inconsistent start is moved to the nearest consistent one, as by
            `jl.assemble`; else it ends in the status inconsistent_start.
        estimate_error: whether to solve once more with a tenth of the tolerance and, where there
            is one, a method of higher order, or else with half the step dt, and give in
            `motion.error` what follows for the errors of q and v at every save time (of the same
            method, up to every save time; not below 32 eps sqrt(steps) |y|, what rounding leaves):
            global ones, where rtol and atol bound those of a step.
        throw: outside `jit` and `vmap`, raise `SimulationError` for a status other than ok. Inside
            them nothing is raised: read `motion.ok`, or call `motion.check()` outside.

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
    check_options(system, gradient, gradient_memory, stabilization, assemble, save, max_steps)
    check_change_points(change_points)
    check_method(method, rtol, atol, dt)
    check_estimate(estimate_error, method)
    q0, v0, u0 = check_start(system, q0, v0, u0)
    ts, time_direction = check_times(ts)
    inputs = check_inputs(inputs)
    check_range(inputs, ts)
    rtol, atol = check_tolerances(system, method, rtol, atol, q0.dtype)
    step, longest = check_step(dt, dt0), check_longest(dt, dt_max)
    check_params(system, params, q0, inputs)
    check_placement("simulate", (q0, v0, u0, ts, params, inputs))
    asked = formulation
    formulation = check_formulation(system, formulation, stabilization, params, q0.dtype)
    if np.ndim(atol) and formulation == "quasi":
        must, was = "be one number for a state of quasi-velocities", f"its shape was {atol.shape}"
        raise invalid("atol", must, was, "Or pass formulation='multipliers'.")
    params = lift_closure_tracers(system, params, q0, inputs)
    params_traced, params_static = _params.split(params)
    inputs_traced, inputs_static = eqx.partition(inputs, _params.is_array)
    if not concrete(params_traced, inputs_traced):
        jumps = Jumps(system, params, q0, inputs)
        params_traced, inputs_traced = warned(jumps, (params_traced, inputs_traced), ts)
    stepper = choose(method, dt is None, rtol, atol)
    if isinstance(stepper[0], AbstractPartitioned) and isinstance(stabilization, Baumgarte):
        must = f"be left out for {type(stepper[0]).__name__}, whose steps hold the constraints"
        raise invalid("stabilization", must, f"it was {stabilization!r}")
    if gradient_memory is not None and remembers(stepper[0]):
        must = (
            f"be left out for {type(stepper[0]).__name__}, which keeps every step for derivatives"
        )
        raise invalid(
            "gradient_memory", must, f"it was {gradient_memory}", "Take a one-step method."
        )
    size = 2 * system.size
    if gradient_memory is not None and "work" in save:
        size += len(system._power_terms(params, q0.dtype).names)
    stepper_traced, stepper_static = eqx.partition(stepper, _params.is_array)
    plan = ProgramKey(
        system=system,
        params=_params.Static(params_static),
        inputs=_params.Static(inputs_static),
        stepper=_params.Static(stepper_static),
        time_direction=time_direction,
        max_steps=max_steps,
        save=tuple(save),
        sample=_params.sample(params_traced),
        formulation=formulation,
        stabilization=stabilization,
        assemble=assemble,
        regular=mass_definite(system, params, ts[0], q0, v0),
        apart=not assemble and contact_rows_independent(system, params, ts[0], q0, v0, inputs),
        capacity=capacity_for(
            gradient,
            gradient_memory,
            max_steps,
            ts.shape[0],
            size,
            q0.dtype.itemsize,
            all_knots(inputs) is not None,
        ),
        change_points=change_points,
        auto=method == "auto" and "work" not in save,
    )
    start = q0, v0, u0, ts, params_traced, inputs_traced
    values = Values(*start, stepper_traced, rtol, atol, step, longest)
    _xla.warn_if_late()
    warn_of_changes(system, inputs)
    motion = timed(_simulate, system, plan, values)
    either = asked == "auto" and system._in_u is None
    if either:
        plan, motion = _past_singular(plan, values, motion)
    if method == "auto" and dt is None and _ran_out(motion) and is_stiff(motion):
        implicit, given = _with_method(plan, values, IMPLICIT, rtol, atol, step)
        other = _simulate(implicit, given)
        if either:
            implicit, other = _past_singular(implicit, given, other)
            plan = plan._replace(formulation=implicit.formulation)
        if abs(other.last_time - ts[0]) > abs(motion.last_time - ts[0]):
            motion, method = other, IMPLICIT
            stepper = choose(IMPLICIT, True, rtol, atol)
    if estimate_error:
        # Half the step takes twice as many; of a tenth of the tolerance, at order 5, 1.6 times.
        # Steps of a higher order share no errors with those of the motion.
        room = plan._replace(max_steps=2 * max_steps)
        steps = finer(rtol, atol, step, dt is not None)
        better = method if dt is not None else FINER.get(name_of(stepper[0]), method)
        beside = _simulate(*_with_method(room, values, better, *steps, fixed=dt is not None))
        motion = with_error(motion, beside, 1.0 if better is method else LEFT)
    if throw and concrete(motion.raw_status):
        motion.check()
    return motion


def _with_method(
    plan: ProgramKey,
    values: Values,
    method: Any,
    rtol: Any,
    atol: Any,
    step: Any,
    fixed: bool = False,
) -> tuple[ProgramKey, Values]:
    """The same motion by another method, or with other tolerances or steps."""
    stepper = choose(method, not fixed, rtol, atol)
    traced, static = eqx.partition(stepper, _params.is_array)
    plan = plan._replace(stepper=_params.Static(static))
    return plan, values._replace(stepper=traced, rtol=rtol, atol=atol, step=step)


def _past_singular(
    plan: ProgramKey, values: Values, motion: Solution
) -> tuple[ProgramKey, Solution]:
    """The motion by multipliers where one in quasi-velocities ends as these are singular.

    One motion, with values, and where it gets further so.
    """
    status = motion.raw_status
    single = np.ndim(status) == 0 and concrete(status, motion.q)
    if plan.formulation != "quasi" or not single or int(status) not in _MAY_BE_SINGULAR:
        return plan, motion
    if int(motion.status) != int(Status.kinematics_singular) or int(motion.where) < 0:
        return plan, motion  # quasi-velocities that are too few are another fault
    multipliers = plan._replace(formulation=FORMULATIONS[0])
    other = _simulate(multipliers, values)
    start = values.ts[0]
    if not abs(other.last_time - start) > abs(motion.last_time - start):
        return plan, motion
    return multipliers, replace(other, _singular=(motion.last_time, motion.where))


def _ran_out(motion: Solution) -> bool:
    """Whether one motion, with values, took more steps than it may."""
    status = motion.raw_status
    single = np.ndim(status) == 0 and concrete(status, motion.q)
    return single and int(status) == int(Status.max_steps)


@partial(jax.jit, static_argnums=0)
def _simulate(plan: ProgramKey, values: Values) -> Solution:
    """The compiled program: pose, solve, derive what `save` names."""
    values = values._replace(ts=jnp.asarray(values.ts))  # under jax.disable_jit it is numpy's
    dynamics, start, problem = build_problem(plan, values)
    stepper: Stepper = eqx.combine(problem.setup.stepper, problem.stepper)
    name = name_of(stepper.solver)
    known = name in METHODS
    solved, outcome = solve(problem)
    ending = final_status(dynamics, problem.times, problem.y0, problem.args, outcome, start)
    params = _params.join(values.params, plan.params.tree)
    inputs = eqx.combine(values.inputs, plan.inputs.tree)
    moved = outcome.accepted > 0
    arrived = solved.time >= problem.times.saves[-1]
    last_time = jnp.where(arrived, values.ts[-1], dynamics.clock(solved.time, problem.args))
    at = jnp.concatenate([values.ts, last_time[None].astype(values.ts.dtype)])
    states = jnp.concatenate([solved.saved, solved.state[None]])
    q, v = velocities_at(dynamics, at, states, problem.args, moved)
    (q, last_q), (v, last_v) = ((x[:-1], x[-1]) for x in (q, v))
    hold, row = rows_hold_after(dynamics, values.ts, q, v, params)
    broken = ~hold & (ending.status == int(Status.ok))
    ending = ending._replace(
        status=jnp.where(broken, int(Status.contradictory_rows), ending.status),
        where=jnp.where(broken, row, ending.where),
    )
    saved = {
        name: at_saves(name, plan.system, plan.formulation, params, inputs, values.ts, q, v)
        for name in plan.save
        if name != "work"
    }
    if "work" in plan.save:
        saved["work"] = dynamics.work(solved.saved)
    return Solution(
        system=plan.system,
        ts=values.ts,
        q=q,
        v=v,
        last_time=last_time,
        last_state=(last_q, last_v),
        stats={
            "accepted": outcome.accepted,
            "rejected": outcome.attempted - outcome.accepted,
        },
        gradient_mode=outcome.gradient,
        saved=saved,
        _params_traced=values.params,
        _inputs_traced=values.inputs,
        _params_static=plan.params,
        _inputs_static=plan.inputs,
        formulation=plan.formulation,
        _method=jnp.asarray(list(METHODS).index(name) if known else -1, jnp.int32),
        _solver="" if known else name,
        _ending=ending,
        _kinematic=dynamics.quasi is not None or plan.system._in_u is not None or values.v0 is None,
        _implicit=stepper.implicit,
        _solve=simulate,
        stabilization=dynamics.stabilization if dynamics.rows.size else None,
        change_points=plan.change_points,
        tolerances=None if stepper.controller is None else (values.rtol, values.atol),
        dt_max=values.longest,
    )
