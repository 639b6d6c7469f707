"""`simulate`: the motion of a declared system from an initial state."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxlag._core import _xla
from jaxlag._core._arguments import renamed, required
from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._core._native_call import native_call
from jaxlag._core._status import Status
from jaxlag._gradient._differentiable_solve import solve
from jaxlag._gradient._modes import capacity_for, most_steps
from jaxlag._integration._initial_conditions import rows_hold_after
from jaxlag._integration._stepper import Stepper
from jaxlag._linalg._kkt import FORMULATIONS
from jaxlag._model._constraints import Baumgarte
from jaxlag._model._inputs import all_knots, check_inputs, check_range
from jaxlag._model._states import check_no_states, named_states
from jaxlag._simulation._compile_log import timed
from jaxlag._simulation._error_estimate import LEFT, check_estimate, finer, with_error
from jaxlag._simulation._failure import final_status
from jaxlag._simulation._jump_times import Jumps, warned
from jaxlag._simulation._methods import FINER, IMPLICIT, METHODS, choose, name_of, of_structure
from jaxlag._simulation._options._option_checks import (
    check_change_points,
    check_formulation,
    check_longest,
    check_method,
    check_options,
    check_solver,
    check_start,
    check_states_start,
    check_step,
    check_times,
    check_tolerances,
    warn_of_long_step,
)
from jaxlag._simulation._problem import (
    ProgramKey,
    Values,
    build_problem,
    velocities_at,
    with_jax_arrays,
)
from jaxlag._simulation._quantities import at_saves
from jaxlag._simulation._sharding import check_placement
from jaxlag._simulation._solution import Solution
from jaxlag._simulation._step_diagnosis import is_stiff
from jaxlag._system._closure_tracers import check_params, lift_closure_tracers
from jaxlag._system._inspection import contact_rows_independent, mass_definite
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._traced_function import warn_of_changes

MAX_STEPS = 16384
_MAY_BE_SINGULAR = (
    Status.kinematics_singular,
    Status.nonfinite,
    Status.step_below_resolution,
)


@renamed(project="stabilization='projection', None or a jl.Baumgarte")
@required(v0="With u0= pass v0=None.", ts="Pass ts=jnp.linspace(0, 10, 501).")
def simulate(
    system: System,
    q0: Any,
    v0: Any,
    ts: Any,
    params: Any = None,
    *,
    u0: Any = None,
    x0: Any = None,
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

    Composes with jit, vmap, grad, jvp, jacfwd, jacrev and hessian. New values of q0, v0, ts,
    inputs, rtol, atol, dt, dt0, dt_max and of the traced params do not recompile, unless a
    tolerance changes the choice of "auto". A new number of times, method, static part or structure
    of params recompiles, and so does a new direction of time, and each transform. The logger
    "jaxlag" reports compilations of more than 5 s.

    The derivative under every transform is that of the solution at the frozen sequence of
    accepted steps. It includes the dependence on ts and on the inputs' knots (if knots of two
    tables coincide, only for moving them together). It is zero in dt, dt0, dt_max, rtol and atol.

    If L or a force compares variables (max(x, 0), where, abs), perturbations jump at the kink of
    the force. Steps along which derivatives are taken are shortened across such a kink, as far as
    `max_steps` allows. A first derivative is then about as accurate as the motion. It does not
    include the motion of the time at which a force itself jumps (sign(v), where between two
    values). A second derivative does not include the contribution of kinks. JAX's own derivatives
    of such functions have the same limits: smooth the force (tanh, softplus) if they matter. If
    params determine the time of a jump, a warning names them. Make that time a knot of an input to
    get the whole derivative.

    Args:
        system: the mechanical system.
        q0: coordinates at ts[0]: (n,) numbers or a dict by name; m or rad.
        v0: velocities at ts[0], in the same form; m/s or rad/s. Exactly one of v0, u0.
        ts: (s,) times in s, strictly monotone either way, s >= 2. ts[0] is the start; the rest
            are save times and cost no steps.
        params: pytree passed to the Lagrangian and the forces. Floats and inexact arrays are
            traced and differentiable. The rest is static, and must be of immutable types.
        u0: quasi-velocities at ts[0], for systems that declare them: (k,) numbers in the order of
            their names, or a dict by name; constrained ones are zero, and may be left out of a
            dict; m/s or rad/s.
        x0: states beside (q, v) at ts[0], if the system has some (`jl.States`): (k,) numbers, or a
            dict by name.
        inputs: dict from names to `ZeroOrderHold`, `LinearInterpolation`, `TimeFunction`,
            `Feedback` or arrays (constant), read by the forces. Steps end on the knots of tables.
        method: "auto", a name such as "tsit5", any diffrax solver, or (solver, step-size
            controller). "auto" is "dopri8"; "tsit5" if rtol is known and at least 1e-3;
            "prince9" if it is at most 1e-12; "nystrom12" if it is at most 1e-8 and accelerations
            are functions of q and params alone, without comparisons (faster, unless ts has more
            times than there are steps); with fixed steps "splitting8" for T(v) - V(t, q) without
            forces and constraints (a fifth of the time of "dopri8", and as accurate or better, but
            not at steps beyond 1 / omega); and "kvaerno5", outside of transforms, if a stiff motion
            took max_steps explicit steps. `Solution.method` is the method used. Implicit methods by
            name solve their equations to a tenth of the tolerance; diffrax instances keep their own
            settings. "kvaerno4" and "kvaerno5" read forces to a quarter step beyond the last time.
            Structure-preserving methods, for long runs with fixed steps dt: "splitting2",
            "splitting4", "splitting6", "splitting8" (`solvers.Splitting`) if M is constant and
            accelerations do not depend on v; "gauss2" to "gauss8" (`solvers.GaussLegendre`) for any
            L without constraints; "variational2" and "variational4" (`solvers.LobattoIIIAB`) for
            any L, with holonomic constraints satisfied inside the step, so that `stabilization` is
            not used.
        formulation: the state and the solve for accelerations.
            "quasi" ("auto" if quasi-velocities are declared and satisfy all rows): (q, u)
            with the quasi-velocities that are not constrained, no multipliers. Kinematics satisfy
            the rows if they have no more freedoms than there are coordinates minus rows.
            "multipliers" ("auto" otherwise; and if quasi-velocities become singular during the
            motion, outside of transforms and with L in v, which `motion.message()` reports): (q,
            v), M + A^T W A and its Schur complement, factored once each. "null_space": (q, v), M on
            the tangent space of the constraints. Both accept an M that is singular, but not on that
            space (links without mass).
            If quasi-velocities become singular, as for a steered wheel at 90 degrees, a motion in
            them ends just before that place with the status kinematics_singular; with fixed steps
            one step before it.
        rtol: relative bound on the local error; by default 1e-9 in float64, 1e-5 in float32.
        atol: absolute bound on the local error; by default 1e-9 in float64, 1e-6 in float32. A
            number, or one for every coordinate and its velocity: (n,) of them, or a dict by name.
            Those of states beside (q, v) follow, (n + k,).
        dt: fixed step in s (positive for both directions of time); the last one is shortened to
            end at ts[-1].
        dt0: first step in s of an adaptive solve, positive; by default estimated at the start.
        dt_max: bound on the steps of an adaptive solve in s, positive; None for none. A pulse (of a
            `TimeFunction` or of explicit time) that is shorter than a step may lie between two of
            its stages and be missed: set dt_max to its length, or make its begin and end knots
            (`TimeFunction(f, knots=)`).
        max_steps: bound on attempted steps. Derivatives keep a record of this many steps, 8 bytes
            each; of as many as there are in ts if dt and ts have values. In a loop over many short
            motions set it near the number of steps that one of them takes.
        save: names of quantities to compute inside the solve: "a", "u", "p", "energy", "kinetic",
            "potential", "Q", "power", "multipliers", "constraint_force", "input_values",
            "state_rates". The Solution also computes these on demand. "work", the integral of each
            term of dH/dt since ts[0], exists only here. It is integrated with the motion, and its
            local error is bounded like that of q and v.
        gradient: a hint on the cost of reverse derivatives, never on their value.
            "recorded" keeps the state at the start of every step. "checkpoints" keeps about the
            square root as many and repeats the steps between two of them: one more solve. "forward"
            keeps none: reverse derivatives are computed from forward ones, and their cost grows
            with the number of variables. "auto" keeps up to 512 states, which is "recorded" up to
            512 steps; if `gradient_memory` is less than that, it takes the fastest mode that fits.
            All keep the times of max_steps steps. `motion.gradient_mode` is the mode used. Forward
            derivatives need the times alone.
        gradient_memory: bound on the memory of reverse derivatives of one motion, bytes; None for
            none.
        stabilization: "projection": accepted steps and saved states are moved onto the
            constraints, q along M^-1 A^T, then v (with quasi-velocities only q). None: constraints
            may drift. `Baumgarte(alpha, beta)`: residuals are damped instead.
        change_points: the treatment of change points, where constraint rows that are independent
            elsewhere become dependent, as in a linkage that lies flat. There the motion may have
            more than one continuation, and reactions may be infinite. "pass": it continues along
            its tangent, as accurate as elsewhere, with its derivatives. It ends with the status
            rank_change if branches touch without crossing, if one ends in a cusp, if nothing is
            projected, or if forces read multipliers. "stop": it ends just before every change
            point, at every tolerance; with fixed steps one step before it. Variational methods
            stop; so do fixed steps of which an end or a stage is at the change point, to 1e-5 of a
            step. States may be saved there, too, and a motion may end there: by a polynomial
            through both ends of a short step, with velocities to 1e-9 at best, and to some hundred
            tolerances if these are loose. In float32 rounding is visible there: 1e-2 at worst of
            384 linkages that pass two such places, 3e-5 in the median.
        assemble: whether an inconsistent start is moved to the nearest consistent one, as by
            `jl.assemble`; otherwise it ends with the status inconsistent_start.
        estimate_error: whether to estimate the global errors of q and v at every save time, in
            `motion.error`; rtol and atol bound local errors. The solve is repeated with a tenth of
            the tolerance and, if there is one, a method of higher order, or with half the step dt.
            For the same method the estimate holds up to each save time. It is not below
            32 eps sqrt(steps) |y|, the rounding.
        throw: outside `jit` and `vmap`, raise `SimulationError` for a status other than ok. Inside
            them nothing is raised: read `motion.ok`, or call `motion.check()` outside.

    Raises:
        ValueError: an argument of wrong form or value, named.
        SimulationError: the motion did not reach ts[-1], with `throw=True` and concrete values;
            its `motion` attribute is the part that was reached.

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
    x0, q0, v0, u0 = check_states_start(system, "x0", x0, q0, v0, u0)
    inputs = check_inputs(inputs)
    check_no_states(inputs, system.states)
    signals = inputs | named_states(system.states, x0)
    check_range(inputs, ts)
    rtol, atol = check_tolerances(system, method, rtol, atol, q0.dtype)
    step, longest = check_step(dt, dt0), check_longest(dt, dt_max)
    warn_of_long_step(dt, ts)
    check_params(system, params, q0, signals)
    check_placement("simulate", (q0, v0, u0, x0, ts, params, inputs))
    asked = formulation
    formulation = check_formulation(system, formulation, stabilization, params, q0.dtype)
    if np.ndim(atol) and formulation == "quasi":
        must, was = "be one number for a state of quasi-velocities", f"its shape was {atol.shape}"
        raise invalid("atol", must, was, "Give one number, or pass formulation='multipliers'.")
    params = lift_closure_tracers(system, params, q0, signals)
    params_traced, params_static = _params.split(params)
    inputs_traced, inputs_static = _params.arrays_apart(inputs)
    if not concrete(params_traced, inputs_traced):
        jumps = Jumps(system, params, q0, inputs)
        params_traced, inputs_traced = warned(jumps, (params_traced, inputs_traced), ts)
    stepper = choose(method, dt is None, rtol, atol)
    check_solver(stepper[0], stabilization, gradient_memory)
    size = 2 * system.size + (0 if x0 is None else x0.shape[0])
    if gradient_memory is not None and "work" in save:
        size += len(system._power_terms(params, q0.dtype).names)
    knots = all_knots(inputs)
    if not concrete(q0, v0, u0, x0, params_traced, inputs_traced):  # there may be derivatives
        max_steps = most_steps(max_steps, ts, dt, knots)
    stepper_traced, stepper_static = _params.arrays_apart(stepper)
    sample, params = _params.sample(params_traced), _params.join(params_traced, params_static)
    definite = mass_definite(system, params, ts[0], q0, v0, sample)
    plan = ProgramKey(
        system=system,
        params=_params.Static(params_static),
        inputs=_params.Static(inputs_static),
        stepper=_params.Static(stepper_static),
        time_direction=time_direction,
        max_steps=max_steps,
        save=tuple(save),
        sample=sample,
        formulation=formulation,
        stabilization=stabilization,
        assemble=assemble,
        regular=definite.alone,
        blocks_definite=definite.in_blocks,
        contact_rows_independent=not assemble
        and contact_rows_independent(system, params, ts[0], q0, v0, signals),
        capacity=capacity_for(
            gradient,
            gradient_memory,
            max_steps,
            ts.shape[0],
            size,
            q0.dtype.itemsize,
            knots is not None,
        ),
        change_points=change_points,
        structured=of_structure(method, dt is None, rtol, atol) if "work" not in save else None,
    )
    start = q0, v0, u0, ts, params_traced, inputs_traced, x0
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
        # Half the step takes twice as many; a tenth of the tolerance, at order 5, 1.6 times.
        # Steps of a higher order do not have the same errors as those of the motion.
        room = plan._replace(max_steps=2 * max_steps)
        steps = finer(rtol, atol, step, dt is not None)
        better = method if dt is not None else FINER.get(name_of(stepper[0]), method)
        beside = _simulate(*_with_method(room, values, better, *steps, fixed=dt is not None))
        motion = with_error(motion, beside, 1.0 if better is method else LEFT)
    status = motion._ending.status
    if throw and concrete(status) and np.any(np.asarray(status) != int(Status.ok)):
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
    traced, static = _params.arrays_apart(stepper)
    structured = plan.structured and of_structure(method, not fixed, rtol, atol)
    plan = plan._replace(stepper=_params.Static(static), structured=structured)
    return plan, values._replace(stepper=traced, rtol=rtol, atol=atol, step=step)


def _past_singular(
    plan: ProgramKey, values: Values, motion: Solution
) -> tuple[ProgramKey, Solution]:
    """The motion by multipliers if one in quasi-velocities ends at their singularity.

    For a single motion with values, if it then gets further.
    """
    status = motion.raw_status
    single = np.ndim(status) == 0 and concrete(status, motion.q)
    if plan.formulation != "quasi" or not single or int(status) not in _MAY_BE_SINGULAR:
        return plan, motion
    if int(motion.status) != int(Status.kinematics_singular) or int(motion.where) < 0:
        return plan, motion  # too few quasi-velocities are another failure
    multipliers = plan._replace(formulation=FORMULATIONS[0])
    other = _simulate(multipliers, values)
    start = values.ts[0]
    if not abs(other.last_time - start) > abs(motion.last_time - start):
        return plan, motion
    return multipliers, replace(other, _singular=(motion.last_time, motion.where))


def _ran_out(motion: Solution) -> bool:
    """Whether a single motion with values took max_steps steps."""
    status = motion.raw_status
    single = np.ndim(status) == 0 and concrete(status, motion.q)
    return single and int(status) == int(Status.max_steps)


def _motion(plan: ProgramKey, values: Values) -> Solution:
    """The program: build the problem, solve it, compute the quantities of `save`."""
    values = with_jax_arrays(values)
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
    x = None if values.x0 is None else dynamics.x(states)
    (q, last_q), (v, last_v) = ((y[:-1], y[-1]) for y in (q, v))
    hold, row = rows_hold_after(dynamics, values.ts, q, v, params)
    broken = ~hold & (ending.status == int(Status.ok))
    ending = ending._replace(
        status=jnp.where(broken, int(Status.contradictory_rows), ending.status),
        where=jnp.where(broken, row, ending.where),
    )
    saved = {
        name: at_saves(
            name,
            plan.system,
            plan.formulation,
            params,
            inputs,
            values.ts,
            (q, v, None if x is None else x[:-1]),
        )
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
        x=None if x is None else x[:-1],
        last_time=last_time,
        last_state=(last_q, last_v),
        last_x=None if x is None else x[-1],
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


# Alone a program is called from Python, which takes longer, and should compile quickly.
_simulate = _xla.QuickJit(
    _motion, static_argnums=0, inside=lambda plan, x: native_call(partial(_motion, plan), x)
)
