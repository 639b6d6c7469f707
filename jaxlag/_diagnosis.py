"""The status of a trajectory and the coordinate it concerns, inside the compiled program."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlag._drive import Outcome
from jaxlag._dynamics import Dynamics
from jaxlag._forces import reads_lam
from jaxlag._kkt import (
    FORMULATIONS,
    augmented,
    dependence_floor,
    factor_kkt,
    independent_rows,
    masked,
)
from jaxlag._linalg import factor_mass, first_unhealthy, solve_mass
from jaxlag._quasi import SINE
from jaxlag._replay import Problem
from jaxlag._status import Status
from jaxlag._step import Arguments


class Start(NamedTuple):
    """Whether a trajectory may start, and if not, why."""

    valid: Array  # all values are allowed
    in_range: Array  # the inputs are defined there
    finite: Array  # L and the accelerations are finite there
    consistent: "Consistency"
    pressed: Array  # contacts press and slide as their friction takes them to
    kinematic: bool = False  # quasi-velocities enter, whose kinematics may be singular

    @property
    def allowed(self) -> Bool[Array, ""]:
        """Whether all is well."""
        return self.valid & self.in_range & self.finite & self.consistent.ok & self.pressed


class Consistency(NamedTuple):
    """Whether a start satisfies its constraints.

    Attributes:
        ok: all residuals are small, and the rows do not contradict one another.
        contradictory: no motion near satisfies all rows.
        row: the row concerned.
        complete: the state's quasi-velocities stand for all motions that the rows leave.
    """

    ok: Bool[Array, ""]
    contradictory: Bool[Array, ""]
    row: Int[Array, ""]
    complete: Bool[Array, ""]


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
    """Whether L, the accelerations and the residuals are finite at the start."""
    tau, y0, args = _frozen((tau, y0, args))
    L = dynamics.system.lagrangian(*dynamics.state(tau, y0, args))
    a = dynamics.acceleration(tau, y0, dynamics.within(args, tau))
    finite = jnp.isfinite(L) & jnp.all(jnp.isfinite(a))
    for residual in _residuals(dynamics, *dynamics.state(tau, y0, args)):
        finite = finite & jnp.all(jnp.isfinite(residual))
    return finite


def _residuals(dynamics: Dynamics, t: Array, q: Array, v: Array, params: Any) -> tuple[Array, ...]:
    """(phi for every row, A v + b), none without constraints."""
    if not dynamics.rows.size:
        return ()
    phi = dynamics.rows.of_all(dynamics.terms.position(t, q, params))
    return phi, dynamics.terms.velocity(t, q, v, params)


def start_consistent(
    dynamics: Dynamics, t: Array, q: Array, v: Array, params: Any, args: Arguments
) -> Consistency:
    """Whether residuals are below sqrt(eps) of the state, and no row contradicts the others.

    A row contradicts where it is left open by solving for the independent ones: phi, A v + b, or
    A a + gamma; with quasi-velocities where these do not satisfy it by themselves.
    """
    if not dynamics.rows.size:
        true = jnp.array(True)
        return Consistency(true, ~true, jnp.full((), -1, jnp.int32), true)
    t, q, v, params, args = _frozen((t, q, v, params, args))
    terms = dynamics.terms
    A, _ = terms.rows(t, q, v, params)
    unit = jnp.sqrt(jnp.sum(A**2, axis=1))
    unit = jnp.where(unit > 0, unit, 1.0) if args.rows is None else args.rows.size
    floor = dependence_floor(q.dtype)
    phi, rate = _residuals(dynamics, t, q, v, params)
    if dynamics.quasi is not None:
        off = jnp.zeros_like(unit)
        for c, x in ((phi, q), (rate, v)):
            off = jnp.maximum(off, jnp.abs(c) / unit / (floor * (1.0 + jnp.max(jnp.abs(x)))))
        near = jnp.all(off <= 1.0)
        bad, complete = _fitting(dynamics, t, q, v, params, A, unit)
        bad = jnp.where(near, bad / floor, 0.0)
        found = _consistency(off, bad, near, phi, rate)
        return found._replace(complete=complete | ~found.ok, ok=found.ok & (complete | ~found.ok))
    K = terms.correction(t, q, v, params, args.prepared, args.kept)

    def left(c: Array) -> Array:
        return jnp.abs(c - A @ (K @ c)) / unit

    off, bad = jnp.zeros_like(unit), jnp.zeros_like(unit)
    for c, x in ((phi, q), (rate, v)):
        size = jnp.abs(c) / unit / (floor * (1.0 + jnp.max(jnp.abs(x))))
        off = jnp.maximum(off, size)
        # A contradiction is not just what the linearised rows leave open.
        bad = jnp.maximum(bad, jnp.where(left(c) > 0.1 * jnp.max(jnp.abs(c) / unit), size, 0.0))
    near = jnp.all(off <= 1.0)
    gamma = terms.gamma(t, q, v, params)
    turn = jnp.abs(gamma) / unit + jnp.max(jnp.abs(K @ gamma))
    bent = left(gamma) / (floor * jnp.where(turn > 0, turn, 1.0))
    return _consistency(off, jnp.where(near, bent, bad), near, phi, rate)


def _fitting(
    dynamics: Dynamics, t: Array, q: Array, v: Array, params: Any, A: Array, unit: Array
) -> tuple[Array, Bool[Array, ""]]:
    """How far off A B = 0 every row is, as a sine; whether B and A leave no velocity out."""
    quasi = dynamics.quasi
    assert quasi is not None
    u = quasi.of(t, q, v, params)
    B = jax.jacfwd(lambda w: dynamics.velocities(t, q, w, params))(u[quasi.free])
    size = jnp.sqrt(jnp.sum(B**2, axis=0))
    B = B / jnp.where(size > 0, size, 1.0)
    sines = jnp.abs(A @ B) / unit[:, None]
    rows = jnp.concatenate([A / unit[:, None], B.T])
    # Singular kinematics, as at gimbal lock, are a fault of their own.
    sound = jnp.all(jnp.isfinite(rows))
    rows = jnp.where(sound, rows, jnp.eye(*rows.shape, dtype=q.dtype))
    rank = jnp.sum(independent_rows(jnp.eye(q.shape[0], dtype=q.dtype), rows))
    return jnp.max(jnp.where(jnp.isfinite(sines), sines, 0.0), axis=1), rank == q.shape[0]


def rows_hold(
    dynamics: Dynamics, ts: Array, q: Array, v: Array, params: Any
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Whether velocities that kinematics give satisfy the rows at all saved times; else which not.

    With U the rows are satisfied by themselves, and projection sees to them without
    quasi-velocities.
    """
    quasi = dynamics.quasi
    if quasi is None or quasi.U is not None or not dynamics.rows.size:
        return jnp.array(True), jnp.full((), -1, jnp.int32)
    ts, q, v, params = _frozen((ts, q, v, params))
    rates = jax.vmap(lambda t, q, v: dynamics.terms.velocity(t, q, v, params))(ts, q, v)
    A = jax.vmap(lambda t, q, v: dynamics.terms.rows(t, q, v, params)[0])(ts, q, v)
    unit = jnp.sqrt(jnp.sum(A**2, axis=2))
    speed = 1.0 + jnp.max(jnp.abs(v), axis=1)[:, None]
    off = jnp.abs(rates) / jnp.where(unit > 0, unit, 1.0) / speed / dependence_floor(q.dtype)
    off = jnp.max(jnp.where(jnp.isfinite(off), off, 0.0), axis=0)
    return jnp.all(off <= 1.0), jnp.argmax(off).astype(jnp.int32)


def _consistency(off: Array, bad: Array, near: Array, phi: Array, rate: Array) -> Consistency:
    contradictory = jnp.any(bad > 1.0)
    row = jnp.where(contradictory, jnp.argmax(bad), jnp.argmax(off))
    # Residuals that are not finite are another fault.
    ok = (near & ~contradictory) | ~jnp.all(jnp.isfinite(phi) & jnp.isfinite(rate))
    row = jnp.where(ok, -1, row).astype(jnp.int32)
    return Consistency(ok, contradictory, row, jnp.array(True))


def diagnose(
    dynamics: Dynamics, problem: Problem, outcome: Outcome, begun: Start
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """(status, index of the coordinate or constraint row that it concerns, or -1).

    A failed step is explained by the state it started from and, if that is sound, by the state
    it was heading for, q + (t1 - t0) v.
    """
    problem, outcome = _frozen((problem, outcome))
    y0, times = problem.y0, problem.times
    status = jnp.where(begun.finite, outcome.status, int(Status.nonfinite))
    status = jnp.where(begun.pressed, status, int(Status.no_reaction_solution))
    kind = jnp.where(
        begun.consistent.contradictory,
        int(Status.contradictory_rows),
        int(Status.inconsistent_start),
    )
    kind = jnp.where(begun.consistent.complete, kind, int(Status.kinematics_singular))
    status = jnp.where(begun.consistent.ok, status, kind)
    short = (status == int(Status.ok)) & (times.stop < times.saves[-1])
    status = jnp.where(short | ~begun.in_range, int(Status.input_range), status)
    status = jnp.where(begun.valid, status, int(Status.bad_value))

    # Both states in one batch: the terms are traced and compiled once.
    q, w = dynamics.parts(outcome.state)
    _, _, v, _ = dynamics.state(outcome.time, outcome.state, problem.args)
    tried = jnp.concatenate([q + (outcome.tried - outcome.time).astype(q.dtype) * v, w])
    last = outcome.state[: tried.shape[0]]
    taus, states = jnp.stack([outcome.time, outcome.tried]), jnp.stack([last, tried])
    args = dynamics.within(problem.args, outcome.time)
    masses, worsts, rows = jax.vmap(lambda tau, y: _culprits(dynamics, tau, y, args))(taus, states)
    mass = jnp.where(masses[0] >= 0, masses[0], masses[1])
    row = jnp.where(rows[0] >= 0, rows[0], rows[1])
    worst = jnp.where(jnp.all(jnp.isfinite(tried)), worsts[1], worsts[0])

    unexplained = status == int(Status.nonfinite)
    if dynamics.rows.size:
        dependent = (unexplained | (status == int(Status.step_below_resolution))) & (row >= 0)
        status = jnp.where(dependent, int(Status.rank_change), status)
        if any(map(reads_lam, dynamics.system.forces)):
            sound = (mass < 0) & (row < 0) & jnp.all(jnp.isfinite(last))
            status = jnp.where(unexplained & sound, int(Status.no_reaction_solution), status)
    status = jnp.where(unexplained & (mass >= 0), int(Status.mass_singular), status)
    turned = jnp.full((), -1, jnp.int32)
    if begun.kinematic:
        turned = _turned(dynamics, outcome.time, last, times.start, y0, args)
        failed = unexplained | (status == int(Status.step_below_resolution))
        status = jnp.where(failed & (turned >= 0), int(Status.kinematics_singular), status)
    start_faults, n = ~jnp.isfinite(y0), dynamics.system.size
    start = jnp.where(jnp.any(start_faults), jnp.argmax(start_faults), -1)
    # Of quasi-velocities it would be no coordinate.
    start = jnp.where(start < n, start, start % n if dynamics.quasi is None else -1)
    concerns = {
        Status.bad_value: start,
        Status.mass_singular: mass,
        Status.nonfinite: worst,
        Status.step_below_resolution: worst,
        Status.implicit_solve_failed: worst,
        Status.kinematics_singular: turned,
    }
    if dynamics.rows.size:
        farthest = _farthest(dynamics, outcome.tried, states[1], args)
        concerns |= {
            Status.inconsistent_start: begun.consistent.row,
            Status.contradictory_rows: begun.consistent.row,
            Status.projection_failed: farthest,
            Status.rank_change: jnp.where(row >= 0, row, farthest),
            Status.no_reaction_solution: jnp.asarray(dynamics.contact_row),
        }
    where = jnp.full((), -1, jnp.int32)
    for kind, index in concerns.items():
        where = jnp.where(status == int(kind), index.astype(jnp.int32), where)
    return status.astype(jnp.int32), where


def _turned(
    dynamics: Dynamics, tau: Array, y: Array, tau0: Array, y0: Array, args: Arguments
) -> Int[Array, ""]:
    """The quasi-velocity that follows from those before it, or came close to it; -1 for none."""
    quasi, params = dynamics.system.quasi, dynamics.given(args)[0]
    assert quasi is not None
    eps = float(jnp.finfo(y.dtype).eps)

    def sines(tau: Array, y: Array) -> Array:
        q, _ = dynamics.parts(y)
        return quasi.sines(dynamics.mirror(tau, args), q, params, q.dtype)

    now = sines(tau, y)
    # A small angle of its own, as of v0 + 1e-5 v1 and v0, is no fault.
    found = (now < jnp.minimum(eps**0.25, 0.01 * sines(tau0, y0))) | ~(now > SINE * eps)
    found = found & jnp.all(jnp.isfinite(dynamics.parts(y)[0]))
    return jnp.where(jnp.any(found), jnp.argmax(found), -1).astype(jnp.int32)


def _culprits(
    dynamics: Dynamics, tau: Array, y: Array, args: Arguments
) -> tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]:
    """(coordinate without inertia, one of non-finite Q - h or else largest |a|, dependent row).

    -1 where there is none.
    """
    M, effort = dynamics.mass(tau, y, args), dynamics.effort(tau, y, args)
    row = jnp.full((), -1, jnp.int32)
    # A non-finite component spreads through the solve: look at the right-hand side first.
    if dynamics.rows.size:
        A, _ = dynamics.terms.rows(*dynamics.state(tau, y, args))
        if dynamics.quasi is None:
            _, independent = factor_kkt(M, A, args.kept, FORMULATIONS[0]).healthy
            row = jnp.where(jnp.all(independent), -1, jnp.argmin(independent)).astype(jnp.int32)
        M, _ = augmented(M, masked(A, args.kept))
    factor = factor_mass(M)
    a = solve_mass(M, effort, factor)
    suspect = jnp.where(jnp.all(jnp.isfinite(effort)), a, effort)
    finite = jnp.isfinite(suspect)
    worst = jnp.where(jnp.all(finite), jnp.argmax(jnp.abs(a)), jnp.argmin(finite))
    return first_unhealthy(M, factor), worst.astype(jnp.int32), row


def _farthest(dynamics: Dynamics, tau: Array, y: Array, args: Arguments) -> Int[Array, ""]:
    """The constraint row with the largest residual, in units of its norm."""
    at = dynamics.state(tau, y, args)
    A, _ = dynamics.terms.rows(*at)
    phi, rate = _residuals(dynamics, *at)
    size = jnp.abs(phi) + jnp.abs(rate)
    unit = jnp.sqrt(jnp.sum(A**2, axis=1))
    return jnp.argmax(size / jnp.where(unit > 0, unit, 1.0)).astype(jnp.int32)
