"""The status of a trajectory and the coordinate it concerns, inside the compiled program."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlag._drive import Outcome
from jaxlag._dynamics import Arguments, Dynamics
from jaxlag._linalg import factor_mass, first_unhealthy
from jaxlag._replay import Problem
from jaxlag._status import Status


class Start(NamedTuple):
    """Whether a trajectory may start, and if not, why."""

    valid: Array  # all values are allowed
    in_range: Array  # the inputs are defined there
    finite: Array  # L and the accelerations are finite there


def values_allowed(y0: Array, saves: Array, rtol: Any, atol: Any, step: Any) -> Bool[Array, ""]:
    """What concrete values have raised about already, for values that are traced."""
    floor = 10 * jnp.finfo(y0.dtype).eps
    checks = [
        jnp.all(jnp.isfinite(y0)),
        jnp.all(jnp.isfinite(saves)) & jnp.all(saves[1:] > saves[:-1]),
        (rtol >= 0) & (atol >= 0) & (rtol + atol > 0) & ((rtol == 0) | (rtol >= floor)),
    ]
    if step is not None:
        checks.append(jnp.isfinite(step) & (step > 0))
    return jnp.all(jnp.stack([jnp.asarray(check) for check in checks]))


def start_finite(
    dynamics: Dynamics, tau: Float[Array, ""], y0: Array, args: Arguments
) -> Bool[Array, ""]:
    """Whether L and the accelerations are finite at the start."""
    (q, v), (params, _) = dynamics.parts(y0), dynamics.given(args)
    L = dynamics.system.lagrangian(dynamics.mirror(tau, args), q, v, params)
    a = dynamics.acceleration(tau, y0, dynamics.within(args, tau))
    return jnp.isfinite(L) & jnp.all(jnp.isfinite(a))


def diagnose(
    dynamics: Dynamics, problem: Problem, outcome: Outcome, begun: Start
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """(status, index of the coordinate it concerns or -1).

    A failed step is explained by the state it started from and, if that is sound, by an Euler
    step to where it was to end.
    """
    y0, times = problem.y0, problem.times
    status = jnp.where(begun.finite, outcome.status, int(Status.nonfinite))
    short = (status == int(Status.ok)) & (times.stop < times.saves[-1])
    status = jnp.where(short | ~begun.in_range, int(Status.input_range), status)
    status = jnp.where(begun.valid, status, int(Status.bad_value))

    args = dynamics.within(problem.args, outcome.time)
    step = (outcome.tried - outcome.time).astype(y0.dtype)
    tried = outcome.state + step * dynamics(outcome.time, outcome.state, args)
    sound = jnp.all(jnp.isfinite(tried))
    mass, worst = _culprits(dynamics, outcome.time, outcome.state, args)
    tried_mass, tried_worst = _culprits(dynamics, outcome.tried, tried, args)
    mass = jnp.where(sound & (mass < 0), tried_mass, mass)
    worst = jnp.where(sound, tried_worst, worst)

    singular = (status == int(Status.nonfinite)) & (mass >= 0)
    status = jnp.where(singular, int(Status.mass_singular), status)
    start_faults = ~jnp.isfinite(y0)
    start = jnp.where(jnp.any(start_faults), jnp.argmax(start_faults) % dynamics.system.size, -1)
    concerns = {
        Status.bad_value: start,
        Status.mass_singular: mass,
        Status.nonfinite: worst,
        Status.step_below_resolution: worst,
        Status.implicit_solve_failed: worst,
    }
    where = jnp.full((), -1, jnp.int32)
    for kind, index in concerns.items():
        where = jnp.where(status == int(kind), index.astype(jnp.int32), where)
    return status.astype(jnp.int32), where


def _culprits(
    dynamics: Dynamics, tau: Array, y: Array, args: Arguments
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """(coordinate without inertia or -1, coordinate of non-finite Q - h, else of largest |a|)."""
    a, effort = dynamics.acceleration(tau, y, args), dynamics.effort(tau, y, args)
    # A non-finite component spreads through the solve: look at the right-hand side first.
    suspect = jnp.where(jnp.all(jnp.isfinite(effort)), a, effort)
    finite = jnp.isfinite(suspect)
    worst = jnp.where(jnp.all(finite), jnp.argmax(jnp.abs(a)), jnp.argmin(finite))
    without_inertia = first_unhealthy(factor_mass(dynamics.mass(tau, y, args)))
    return without_inertia, worst.astype(jnp.int32)
