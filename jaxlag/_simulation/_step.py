"""`step`: fixed steps from a state, as a plain function for loops of control and learning."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._core._arguments import positive_integer
from jaxlag._core._arrays import concrete, number, of_state, stop_gradient
from jaxlag._core._errors import invalid
from jaxlag._integration._quasi_singularities import usual
from jaxlag._integration._stepper import Stepper, all_finite
from jaxlag._integration._tableaus import remembers
from jaxlag._model._coordinates import vector_argument
from jaxlag._model._inputs import check_inputs, check_range, common_range, knots_increase
from jaxlag._model._states import check_no_states, named_states
from jaxlag._simulation._jump_times import Jumps, warned
from jaxlag._simulation._methods import choose
from jaxlag._simulation._options._option_checks import (
    check_formulation,
    check_options,
    check_states_start,
    check_step,
    check_tolerances,
)
from jaxlag._simulation._problem import (
    ProgramKey,
    Values,
    equations,
    stepper_of,
    with_jax_arrays,
)
from jaxlag._system._closure_tracers import check_params, lift_closure_tracers
from jaxlag._system._inspection import (
    check_declaration,
    contact_rows_independent,
    mass_definite,
)
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._traced_function import warn_of_changes
from jaxlag.solvers import AbstractExplicit, AbstractPartitioned

UNROLLED = 200
"""Lines of dy/dt times stages up to which a step is unrolled. The reverse derivative of 50 carts
with poles over 100 steps takes 1.0 ms unrolled and 2.1 ms in a loop over stages, but compiles in
5.6 s and 1.8 s."""


def step(
    system: System,
    q: Any,
    v: Any,
    dt: Any,
    params: Any = None,
    *,
    x: Any = None,
    t: Any = 0.0,
    inputs: Mapping[str, Any] | None = None,
    method: Any = "tsit5",
    steps: int = 1,
    formulation: str = "auto",
    stabilization: str | None = "projection",
) -> tuple[Float[Array, "..."], ...]:
    """The state (q, v) of M a + h = Q + A^T lam after a time dt, by `steps` steps of fixed length.

    For loops of one's own, such as `jax.lax.scan` over control intervals: it costs the
    accelerations of its stages, and keeps no record, save times or status. It composes with jit,
    vmap and all derivatives, which are those of the steps. `simulate` with `dt=` gives the same
    states.

    Args:
        system: the mechanical system.
        q: coordinates at t: (n,) numbers or a dict by name; m or rad. They and v must satisfy the
            constraints: `step` returns such states, and `jl.assemble` makes one.
        v: velocities at t, in the same form; m/s or rad/s.
        dt: the control interval, s, positive.
        params: pytree passed to the Lagrangian and the forces.
        x: states beside (q, v) at t, (k,) numbers or a dict by name, if the system has some.
        t: s.
        inputs: as for `simulate`. Arrays are constant over dt, as the actions of a policy. Each
            step reads a table in the interval in which the step begins: let knots fall on the ends
            of steps.
        method: as for `simulate` with fixed steps, one-step methods only. "tsit5" takes 6
            evaluations of the accelerations, "midpoint" 2, "dopri8" 13.
        steps: number of equal steps in dt.
        formulation: as for `simulate`.
        stabilization: "projection", onto the constraints after each step, or None.

    Returns:
        (q, v) at t + dt, each (n,); (q, v, x) for a system with states. NaN where a step fails:
        values that are not finite, equations that are not solved, a contact that lifts off, a
        change point, singular quasi-velocities, inputs that are not defined from t to t + dt.

    Raises:
        ValueError: an argument of wrong form or value, named.

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. II.1.

    Example:
        A swing pumped by a torque of the sign of its speed, ten control intervals of 0.1 s:

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> def torque(t, q, v, params, inputs):
        ...     return inputs["torque"][None]
        >>> swing = jl.System(
        ...     lambda t, q, v, p: 0.5 * v[0] ** 2 + 9.81 * jnp.cos(q[0]),
        ...     ("angle",),
        ...     forces=(jl.GeneralizedForce(torque, "motor"),),
        ... )
        >>> def interval(state, _):
        ...     q, v = state
        ...     q, v = jl.step(swing, q, v, 0.1, inputs={"torque": 0.5 * jnp.sign(v[0])})
        ...     return (q, v), swing.energy(q, v)
        >>> start = jnp.array([0.1]), jnp.array([0.0])
        >>> energies = jax.lax.scan(interval, start, None, length=10)[1]
        >>> print(f"{energies[0] + 9.81:.2f} J {energies[-1] + 9.81:.2f} J")
        0.05 J 0.20 J
    """
    if not isinstance(system, System):
        raise invalid("step: system", "be a jl.System", f"it was {system!r}")
    if v is None:
        raise invalid("step: v", "be given", "it was None", "For u: system.velocities(q, u).")
    own = system.coordinates
    q, v = of_state("q and v", vector_argument(own, "q", q), vector_argument(own, "v", v))
    t = number("step: t", "be a number", t, jnp.result_type(float))
    dt = check_step(dt, None)
    if dt is None:
        raise invalid("step: dt", "be given", "it was None", "Write dt=0.05.")
    steps = positive_integer("step: steps", steps)
    check_options(system, "auto", None, stabilization, False, (), steps)
    rtol, atol = check_tolerances(system, method, None, None, q.dtype)
    solver, _ = choose(method, False, rtol, atol)
    if remembers(solver):
        was = f"{type(solver).__name__} remembers earlier steps"
        raise invalid("step: method", "be a one-step method", was, "Use jl.simulate.")
    x, q, v = check_states_start(system, "step: x", x, q, v)
    inputs = check_inputs(inputs)
    check_no_states(inputs, system.states)
    signals = inputs | named_states(system.states, x)
    known = concrete(t, dt)
    if known:
        slack = _slack(t, dt)
        check_range(inputs, np.array([t + slack, t + dt - slack]), "t and t + dt")
    check_params(system, params, q, signals)
    formulation = check_formulation(system, formulation, stabilization, params, q.dtype)
    params = lift_closure_tracers(system, params, q, signals)
    params_traced, params_static = _params.split(params)
    inputs_traced, inputs_static = _params.arrays_apart(inputs)
    ts: Any = np.array([t, t + dt], dt.dtype) if known else jnp.stack([t, t + dt])
    if not concrete(params_traced, inputs_traced):
        jumps = Jumps(system, params, q, inputs)
        params_traced, inputs_traced = warned(jumps, (params_traced, inputs_traced), ts)
    stepper_traced, stepper_static = _params.arrays_apart((solver, None))
    sample = _params.sample(params_traced)
    definite = mass_definite(system, params, t, q, v, sample)
    plan = ProgramKey(
        system=system,
        params=_params.Static(params_static),
        inputs=_params.Static(inputs_static),
        stepper=_params.Static(stepper_static),
        time_direction=1,
        max_steps=steps,
        save=(),
        sample=sample,
        formulation=formulation,
        stabilization=stabilization,
        assemble=False,
        regular=definite.alone,
        blocks_definite=definite.in_blocks,
        contact_rows_independent=contact_rows_independent(system, params, t, q, v, signals),
        capacity=0,
        change_points="stop",
        structured=None,
    )
    warn_of_changes(system, inputs)
    start = q, v, None, ts, params_traced, inputs_traced, x
    return _steps(plan, Values(*start, stepper_traced, rtol, atol, dt))


@partial(jax.jit, static_argnums=0)
def _steps(plan: ProgramKey, values: Values) -> tuple[Array, ...]:
    """The compiled program."""
    values = with_jax_arrays(values)
    dynamics, args, method = equations(plan, values)
    params, inputs = dynamics.given(args)
    assert values.v0 is not None
    assert values.step is not None
    ts = values.ts
    t, q, v, count = ts[0], values.q0, values.v0, plan.max_steps
    signals = inputs | named_states(plan.system.states, values.x0)
    check_declaration(plan.system, params, signals, t, q, v)
    zero = jnp.zeros_like(args.origin)
    y = dynamics.state_of(t, q, v, values.x0, params)
    args = dynamics.precompute(zero, y, args)
    if dynamics.quasi is not None:
        args = args._replace(usual=usual(dynamics, *stop_gradient((zero, q, args))))
    if isinstance(method[0], AbstractPartitioned):  # its steps hold the constraints
        dynamics = replace(dynamics, stabilization=None)
    stepper = _briefly(stepper_of(dynamics, method, y, args, None))
    h = (values.step / count).astype(zero.dtype)

    def one(y: Array, k: Array) -> tuple[Array, None]:
        y1, good = _checked(stepper, k * h, (k + 1) * h, y, args)
        return jnp.where(good & (h > 0), y1, jnp.nan), None

    indices = jnp.arange(count).astype(zero.dtype)
    y = one(y, indices[0])[0] if count == 1 else jax.lax.scan(one, y, indices)[0]
    span = common_range(inputs)
    if span is not None:
        first, last = (time.astype(t.dtype) for time in span)
        slack = _slack(t, values.step)
        defined = (first <= t + slack) & (ts[1] - slack <= last) & knots_increase(inputs)
        y = jnp.where(defined, y, jnp.nan)
    q, w = dynamics.parts(y)
    v = dynamics.velocities_of(ts[1], q, w, args)
    return (q, v) if values.x0 is None else (q, v, dynamics.x(y))


def _slack(t: Any, dt: Any) -> Any:
    """By what a sum of steps may be off from the ends of a table, s."""
    return jnp.maximum(1e-6 * dt, 64 * float(jnp.finfo(dt.dtype).eps) * (abs(t) + dt))


def _briefly(stepper: Stepper) -> Stepper:
    """The stepper with a loop over stages, unless the unrolled step is short."""
    solver, lines = stepper.solver, getattr(stepper.term, "lines", None)
    if not isinstance(solver, AbstractExplicit):
        return stepper
    return replace(
        stepper,
        solver=replace(solver, looped=lines is None or lines * solver.stages > UNROLLED),
    )


def _checked(
    stepper: Stepper, t: Array, end: Array, y: Array, args: Any
) -> tuple[Array, Bool[Array, ""]]:
    """The state after one step, and whether all its checks hold."""
    inside = stepper.within(args, t + 0.5 * (end - t))  # off the knots at its ends
    memory, jump = stepper.afresh(t, end, y, args)
    y1, estimate, _, solved = stepper.step(t, end, y, inside, memory, jump)
    finite = all_finite(y1)
    settled, checks = stepper.settled(end, y1, inside, differentiable=True)
    along = t, end, y, settled, inside, estimate.slope_drop
    passage = stepper.passage(*along, stepper.determinants(t, y, args))
    regular = jnp.array(True) if passage is None else passage[0]
    good = finite & solved & regular & stepper.same_sense(*along) & checks.good
    return settled, stop_gradient(good)
