"""The status of a trajectory and the coordinate it concerns, inside the compiled program."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlag._drive import Outcome
from jaxlag._dynamics import Arguments, Dynamics
from jaxlag._linalg import factor_mass, first_unhealthy, solve_mass
from jaxlag._replay import Problem
from jaxlag._status import Status


class Start(NamedTuple):
    """Whether a trajectory may start, and if not, why."""

    valid: Array  # all values are allowed
    in_range: Array  # the inputs are defined there
    finite: Array  # L and the accelerations are finite there


def _frozen(tree: Any) -> Any:
    """Without derivative: a status has none, and differentiating its making would cost."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def values_allowed(y0: Array, saves: Array, rtol: Any, atol: Any, step: Any) -> Bool[Array, ""]:
    """What concrete values have raised about already, for values that are traced."""
    floor = 10 * jnp.finfo(y0.dtype).eps
    checks = [
        jnp.all(jnp.isfinite(y0)),
        jnp.all(jnp.isfinite(saves)) & jnp.all(saves[1:] > saves[:-1]),
        jnp.isfinite(rtol) & jnp.isfinite(atol),
        (rtol >= 0) & (atol >= 0) & (rtol + atol > 0) & ((rtol == 0) | (rtol >= floor)),
    ]
    if step is not None:
        checks.append(jnp.isfinite(step) & (step > 0))
    return jnp.all(jnp.stack([jnp.asarray(check) for check in checks]))


def start_finite(
    dynamics: Dynamics, tau: Float[Array, ""], y0: Array, args: Arguments
) -> Bool[Array, ""]:
    """Whether L and the accelerations are finite at the start."""
    tau, y0, args = _frozen((tau, y0, args))
    (q, v), (params, _) = dynamics.parts(y0), dynamics.given(args)
    L = dynamics.system.lagrangian(dynamics.mirror(tau, args), q, v, params)
    a = dynamics.acceleration(tau, y0, dynamics.within(args, tau))
    return jnp.isfinite(L) & jnp.all(jnp.isfinite(a))


def diagnose(
    dynamics: Dynamics, problem: Problem, outcome: Outcome, begun: Start
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """(status, index of the coordinate it concerns or -1).

    A failed step is explained by the state it started from and, if that is sound, by the state
    it was heading for, q + (t1 - t0) v.
    """
    problem, outcome = _frozen((problem, outcome))
    y0, times = problem.y0, problem.times
    status = jnp.where(begun.finite, outcome.status, int(Status.nonfinite))
    short = (status == int(Status.ok)) & (times.stop < times.saves[-1])
    status = jnp.where(short | ~begun.in_range, int(Status.input_range), status)
    status = jnp.where(begun.valid, status, int(Status.bad_value))

    # Both states in one batch: the terms are traced and compiled once.
    q, v = dynamics.parts(outcome.state)
    tried = jnp.concatenate([q + (outcome.tried - outcome.time).astype(q.dtype) * v, v])
    last = outcome.state[: tried.shape[0]]
    taus, states = jnp.stack([outcome.time, outcome.tried]), jnp.stack([last, tried])
    args = dynamics.within(problem.args, outcome.time)
    masses, worsts = jax.vmap(lambda tau, y: _culprits(dynamics, tau, y, args))(taus, states)
    mass = jnp.where(masses[0] >= 0, masses[0], masses[1])
    worst = jnp.where(jnp.all(jnp.isfinite(tried)), worsts[1], worsts[0])

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
    M, effort = dynamics.mass(tau, y, args), dynamics.effort(tau, y, args)
    # A non-finite component spreads through the solve: look at the right-hand side first.
    factor = factor_mass(M)
    a = solve_mass(M, effort, factor)
    suspect = jnp.where(jnp.all(jnp.isfinite(effort)), a, effort)
    finite = jnp.isfinite(suspect)
    worst = jnp.where(jnp.all(finite), jnp.argmax(jnp.abs(a)), jnp.argmin(finite))
    return first_unhealthy(M, factor), worst.astype(jnp.int32)
