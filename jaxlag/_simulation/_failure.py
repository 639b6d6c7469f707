"""Failures of a trajectory: the message and the force, row or coordinate concerned."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlag._core._arrays import concrete, stop_gradient
from jaxlag._core._status import Status
from jaxlag._integration._initial_conditions import Start, residuals
from jaxlag._integration._record import Outcome, Times
from jaxlag._integration._step_arguments import Arguments
from jaxlag._integration._step_end import StepEnd
from jaxlag._integration._vector_field import VectorField
from jaxlag._linalg._kkt import FORMULATIONS, Multipliers, augmented, factor_kkt, masked
from jaxlag._linalg._mass_solve import factor_mass, first_unhealthy, solve_mass
from jaxlag._linalg._refined_qr import SINE
from jaxlag._linalg._row_residuals import row_sizes
from jaxlag._model._forces import reads_lam
from jaxlag._tracing import _params


class Ending(NamedTuple):
    """The end of a trajectory, as the solve reports it.

    Attributes:
        status: int32, see `Status`; `diagnose_failure` may refine it.
        where: index of the coordinate or constraint row concerned; -1 if none is known.
        tried: end of the last attempted step, s.
        state: (q, v, x), or (q, u, x), of the last good state.
        lost: (time, (q, v, x)) where the equations are not finite; None unless `diagnose_failure`
            has examined the ending. If they are finite everywhere, the last good time and state.
    """

    status: Int[Array, "*batch"]
    where: Int[Array, "*batch"]
    tried: Float[Array, "*batch"]
    state: Float[Array, "*batch m"]
    lost: tuple[Float[Array, "*batch"], Float[Array, "*batch k"]] | None = None


_PARTS = np.array([0.0, *[1.0] * 32, *2.0 ** np.arange(1, 7)]) / 32
"""Fractions of the failed step at which the equations are evaluated; some lie beyond its end."""

_OPEN = np.array(
    [
        *(Status.step_below_resolution, Status.nonfinite, Status.rank_change),
        *(Status.no_reaction_solution, Status.kinematics_singular, Status.projection_failed),
        Status.implicit_solve_failed,
    ],
    np.int32,
)
"""Outcomes that `diagnose_failure` may refine."""


def final_status(
    dynamics: VectorField, times: Times, y0: Array, args: Arguments, outcome: Outcome, checks: Start
) -> Ending:
    """The end of a solve without further evaluations."""
    status = jnp.where(checks.finite, outcome.status, int(Status.nonfinite))
    status = jnp.where(checks.contacts_valid, status, int(Status.no_reaction_solution))
    kind = jnp.where(
        checks.consistent.contradictory,
        int(Status.contradictory_rows),
        int(Status.inconsistent_start),
    )
    kind = jnp.where(checks.consistent.complete, kind, int(Status.kinematics_singular))
    status = jnp.where(checks.consistent.ok, status, kind)
    short = (status == int(Status.ok)) & (times.stop < times.saves[-1])
    status = jnp.where(short | ~checks.in_range, int(Status.input_range), status)
    status = jnp.where(checks.valid, status, int(Status.bad_value))

    faults, n = ~jnp.isfinite(stop_gradient(y0)), dynamics.system.size
    start = jnp.where(jnp.any(faults), jnp.argmax(faults), -1)
    # Quasi-velocities and states have no index of a coordinate.
    start = jnp.where(start < 2 * n, start, -1)
    start = jnp.where(start < n, start, start % n if dynamics.quasi is None else -1)
    start = start.astype(jnp.int32)
    where = jnp.where(status == int(Status.bad_value), start, -1)
    if dynamics.rows.size:
        fault = (status == int(Status.inconsistent_start)) | (
            status == int(Status.contradictory_rows)
        )
        where = jnp.where(fault, checks.consistent.row, where)
    tried = dynamics.clock(outcome.tried, args)
    found = status.astype(jnp.int32), where.astype(jnp.int32), tried, dynamics.idle(outcome.state)
    return stop_gradient(Ending(*found))


def is_open(ending: Ending) -> bool:
    """Whether `diagnose_failure` may refine an ending; True if it is traced."""
    if not concrete(ending.status):
        return True
    return bool(np.isin(np.asarray(ending.status), _OPEN).any())


class MotionKey(NamedTuple):
    """The key of the compiled program that diagnoses a motion."""

    system: Any
    params: _params.Static
    inputs: _params.Static
    formulation: str
    stabilization: Any
    kinematic: bool  # quasi-velocities are used; their kinematics may be singular
    implicit: bool  # steps may be far longer than decay times


def dynamics_of(
    scene: MotionKey, ts: Array, place: tuple[Any, Any, Any, Any], params: Any, inputs: Any
) -> tuple[VectorField, Arguments]:
    """The equations of a motion over ts that passes `place`, (t, q, v, x), and their arguments."""
    dynamics = VectorField(
        scene.system,
        scene.params,
        scene.inputs,
        None,
        None,
        _params.UNKNOWN,
        formulation=scene.formulation,
        stabilization=scene.stabilization,
    )
    args = dynamics.arguments(params, inputs, ts)
    given, _ = dynamics.given(args)
    dynamics = replace(dynamics, rows=dynamics.system._rows(given, place[1].dtype))
    y = dynamics.state_of(*place, given)
    return dynamics, dynamics.precompute(dynamics.tau(place[0], args), y, args)


@partial(jax.jit, static_argnums=(0, 1))
def diagnose_failure(scene: MotionKey, batch: int, given: Any) -> Ending:
    """The endings, refined by an examination of the states around them if one may be refined.

    Args:
        scene: key of the motion.
        batch: number of batch axes.
        given: (ending, last time, last state (q, v, x), ts, q0, v0, x0, traced halves of params and
            inputs).
    """

    def one(given: Any) -> Ending:
        ending, time, _, ts, q0, v0, x0, params, inputs = given
        # v0 does not exist if kinematics are singular at the start.
        v0 = jnp.where(jnp.isfinite(v0), v0, 0.0)
        dynamics, args = dynamics_of(scene, ts, (ts[0], q0, v0, x0), params, inputs)
        time, tried, start = (dynamics.tau(t, args) for t in (time, ending.tried, ts[0]))
        found = _explained(scene, dynamics, ending, time, tried, start, q0, args)
        assert found.lost is not None
        lost = [x.astype(y.dtype) for x, y in zip(found.lost, given[1:3], strict=True)]
        return found._replace(lost=tuple(lost))

    def known(given: Any) -> Ending:
        ending, *lost = given[:3]
        return ending._replace(lost=tuple(lost))

    for _ in range(batch):
        one = jax.vmap(one)
    given = stop_gradient(given)
    may_be_refined = eqxi.unvmap_any(jnp.isin(given[0].status, _OPEN))
    return jax.lax.cond(may_be_refined, one, known, given)


def _explained(
    scene: MotionKey,
    dynamics: VectorField,
    ending: Ending,
    time: Array,
    tried: Array,
    start: Array,
    q0: Array,
    args: Arguments,
) -> Ending:
    """The failure found in the state before a failed step and in one state ahead.

    The state ahead is used if the state before it is sound. It is the first one in the step with a
    nonfinite value, or else q + (t1 - t0) v.
    """
    status = ending.status
    unexplained = status == int(Status.nonfinite)
    last, (q, _) = ending.state, dynamics.parts(ending.state)
    _, _, v, _ = dynamics.state(time, last, args)
    ahead = jnp.concatenate([q + (tried - time).astype(q.dtype) * v, last[q.size :]])
    args = dynamics.within(args, time)
    found, tau, y = _lost(dynamics, time, tried, last, args, unexplained, scene.implicit)
    place = jnp.where(found, tau, time), jnp.where(found, y, last)
    t_lost, q_lost, v_lost, _ = dynamics.state(*place, args)
    tried = jnp.where(found, tau, tried)
    ahead = jnp.where(found, y, ahead)
    # Both states in one batch: the terms are traced and compiled once.
    taus, states = jnp.stack([time, tried]), jnp.stack([last, ahead])
    culprits = jax.vmap(lambda tau, y: _culprits(dynamics, tau, y, args))(taus, states)
    mass, lost = (jnp.where(x[0] >= 0, x[0], x[1]) for x in culprits[:2])
    row = jnp.full((), -1, jnp.int32)
    if dynamics.rows.size and dynamics.quasi is None:
        begin = jnp.concatenate([q0, last[q.size :]])
        at = jnp.append(taus, start), jnp.vstack([states, begin]), args
        row = _dependent(dynamics, args.active_rows, *at)
        if args.rows is not None and args.rows.multiplier_rows.active_rows is not args.active_rows:
            multiplier_row = _dependent(dynamics, args.rows.multiplier_rows.active_rows, *at)
            row = jnp.where(row >= 0, row, multiplier_row)
    worst = jnp.where(jnp.all(jnp.isfinite(ahead)), culprits[2][1], culprits[2][0])
    if dynamics.system.states is not None:
        worst = _worst_with_states(dynamics, time, last, args, worst)

    if dynamics.rows.size:
        short = status == int(Status.step_below_resolution)
        unprojected = status == int(Status.projection_failed)
        dependent = (unexplained | short | unprojected) & (row >= 0)
        status = jnp.where(dependent, int(Status.rank_change), status)
        if any(map(reads_lam, dynamics.system.forces)):
            sound = (mass < 0) & (row < 0) & jnp.all(jnp.isfinite(last))
            status = jnp.where(unexplained & sound, int(Status.no_reaction_solution), status)
    unsolved = status == int(Status.implicit_solve_failed)
    status = jnp.where((unexplained | unsolved) & (mass >= 0), int(Status.mass_singular), status)
    turned = passed = jnp.full((), -1, jnp.int32)
    if scene.kinematic:
        beyond, _ = dynamics.parts(states[1])
        turned, passed = _turned(dynamics, taus, jnp.stack([q, beyond]), start, q0, args)
        failed = unexplained | unsolved | (status == int(Status.step_below_resolution))
        turned = jnp.where(status == int(Status.kinematics_singular), passed, turned)
        status = jnp.where(failed & (turned >= 0), int(Status.kinematics_singular), status)
    concerns = {
        Status.mass_singular: mass,
        Status.nonfinite: lost,
        Status.step_below_resolution: worst,
        Status.implicit_solve_failed: worst,
        Status.kinematics_singular: turned,
    }
    if dynamics.rows.size:
        farthest = _farthest(dynamics, tried, states[1], args)
        concerns |= {
            Status.projection_failed: farthest,
            Status.rank_change: jnp.where(row >= 0, row, farthest),
            Status.no_reaction_solution: jnp.asarray(StepEnd(dynamics).contact_row),
        }
    where = ending.where
    for kind, index in concerns.items():
        where = jnp.where(status == int(kind), index.astype(jnp.int32), where)
    at = t_lost, jnp.concatenate([q_lost, v_lost, dynamics.x(place[1])])
    return ending._replace(status=status.astype(jnp.int32), where=where, lost=at)


def _turned(
    dynamics: VectorField, taus: Array, q: Array, tau0: Array, q0: Array, args: Arguments
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """(quasi-velocity that is dependent or almost so, quasi-velocity that rejected the step).

    -1 for none. For the second, the part independent of the quasi-velocities before it has changed
    most since the start.

    Args:
        dynamics: the vector field.
        taus: of the last good state and of one ahead of it.
        q: the coordinates of both.
        tau0: start of the motion.
        q0: coordinates there.
        args: arguments.
    """
    quasi, params = dynamics.system.quasi, dynamics.given(args)[0]
    assert quasi is not None
    eps = float(jnp.finfo(q.dtype).eps)

    def sines(tau: Array, q: Array) -> Array:
        return quasi.sines(dynamics.clock(tau, args), q, params, q.dtype)

    now = sines(taus[0], q[0])
    # An angle that is always small, as of v0 + 1e-5 v1 and v0, is no failure.
    found = (now < jnp.minimum(eps**0.25, 0.01 * sines(tau0, q0))) | ~(now > SINE * eps)
    found = found & jnp.all(jnp.isfinite(q[0]))
    if dynamics.quasi is None:
        known = jnp.where(jnp.any(found), jnp.argmax(found), -1).astype(jnp.int32)
        return known, known

    def parts(tau: Array, q: Array) -> Array:
        size = jnp.log(quasi.pivots(dynamics.clock(tau, args), q, params))
        return jnp.where(jnp.isnan(size), -jnp.inf, size)

    begin, *later = (parts(*at) for at in ((tau0, q0), *zip(taus, q, strict=True)))
    found = found | (later[0] - begin < 0.5 * float(np.log(eps)))
    known = jnp.where(jnp.any(found), jnp.argmax(found), -1).astype(jnp.int32)
    changed = jnp.max(jnp.abs(jnp.stack(later) - begin), axis=0)
    turned_back = taus[1] > tau0
    return known, jnp.where(turned_back, jnp.argmax(changed).astype(jnp.int32), known)


def _lost(
    dynamics: VectorField,
    time: Array,
    tried: Array,
    y: Array,
    args: Arguments,
    wanted: Array,
    implicit: bool,
) -> tuple[Bool[Array, ""], Array, Array]:
    """(whether dy/dt is not finite somewhere on a step from y, the first such time, state there).

    Euler's method from y, or along the tangent of the motion: with `implicit` steps fast modes have
    decayed at y, and the tangent follows the others. Stages may lie beyond the end of the step, and
    a step at the resolution of time does not change the state: fractions of doubling length follow.
    """
    lengths = (tried - time) * jnp.asarray(_PARTS, time.dtype)

    def cond_fun(carry: tuple) -> Array:
        k, _, y, rates = carry
        sound = jnp.all(jnp.isfinite(y)) & jnp.all(jnp.isfinite(rates))
        return wanted & sound & (k < _PARTS.size)

    def ahead(carry: tuple) -> tuple:
        k, tau, y, rates = carry
        tau, y = tau + lengths[k], y + lengths[k].astype(y.dtype) * rates
        new = dynamics(tau, y, args)
        if implicit:
            new = jnp.where((k > 0) & jnp.all(jnp.isfinite(new)), rates, new)
        return k + 1, tau, y, new

    init = jnp.zeros((), jnp.int32), time, y, jnp.zeros_like(y)
    _, tau, y, rates = jax.lax.while_loop(cond_fun, ahead, init)
    # If the state itself overflows, all that depends on it does.
    found = wanted & ~jnp.all(jnp.isfinite(rates)) & jnp.all(jnp.isfinite(y))
    return found, tau, y


def _culprits(
    dynamics: VectorField, tau: Array, y: Array, args: Arguments
) -> tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]:
    """Coordinates (without inertia, with nonfinite M or Q - h, with the largest |a|).

    -1 if there is none. If M or the constraint rows are not finite, none is without inertia.
    """
    M, effort = dynamics.mass(tau, y, args), dynamics.effort(tau, y, args)
    # A nonfinite component spreads through the solve: it is searched before.
    finite = jnp.isfinite(effort) & jnp.all(jnp.isfinite(M), axis=0)
    known = jnp.all(jnp.isfinite(M))
    if dynamics.rows.size:
        A, _ = dynamics.terms.rows(*dynamics.state(tau, y, args))
        known = known & jnp.all(jnp.isfinite(A))
        M, _ = augmented(M, masked(A, _inertial(dynamics, tau, y, args)))
    factor = factor_mass(M)
    a = solve_mass(M, effort, factor)
    lost = jnp.where(jnp.all(finite), -1, jnp.argmin(finite))
    worst = jnp.where(lost >= 0, lost, jnp.argmax(jnp.abs(a)))
    massless = jnp.where(known, first_unhealthy(M, factor), -1)
    return massless.astype(jnp.int32), lost.astype(jnp.int32), worst.astype(jnp.int32)


def _inertial(dynamics: VectorField, tau: Array, y: Array, args: Arguments) -> Array | None:
    """Active rows that may replace inertia: with a sparse M those inside of its blocks."""
    if not dynamics.program.is_sparse(args.constants):
        return args.active_rows
    inside = dynamics.program.first_rows(dynamics.state_at(tau, y, args), dynamics.sample)
    assert inside is not None
    return jnp.asarray(inside) if args.active_rows is None else args.active_rows & inside


def _worst_with_states(
    dynamics: VectorField, tau: Array, y: Array, args: Arguments, worst: Array
) -> Int[Array, ""]:
    """`worst`, or n + i if state i changes faster than all velocities, each over 1 + its size."""
    n, k = dynamics.system.size, dynamics.state_count
    size = jnp.abs(dynamics(tau, y, args)) / (1.0 + jnp.abs(y))
    w, x = size[n : n + dynamics.speeds], size[n + dynamics.speeds :][:k]
    fastest = (n + jnp.argmax(x)).astype(jnp.int32)
    return jnp.where(jnp.max(x) > jnp.max(w), fastest, worst)


def _dependent(
    dynamics: VectorField, active_rows: Array | None, taus: Array, states: Array, args: Arguments
) -> Int[Array, ""]:
    """The row that vanishes, or depends on those before it, or almost does; -1 for none.

    Args:
        dynamics: the vector field.
        active_rows: rows used in solves; None for all.
        taus: of the last good state, of one ahead of it, and of the start.
        states: these three.
        args: arguments.
    """

    def squares(tau: Array, y: Array) -> tuple[Array, Array]:
        """(squared distances of rows from those before them, whether they are independent)."""
        t, q, v, params = dynamics.state(tau, y, args)
        terms = dynamics.terms_at(q, args)
        rows = terms.rows_of(t, v, params)
        every, M = rows(q), terms.mass(t, q, v, params)
        nonzero = row_sizes(rows, q, every).nonzero
        A = masked(every, active_rows)
        factor = factor_kkt(M, A, active_rows, FORMULATIONS[0])
        assert isinstance(factor, Multipliers)
        fine = factor.healthy[1] & nonzero
        return factor.schur.pivots, fine if active_rows is None else fine | ~active_rows

    pivots, fine = jax.vmap(squares)(taus, states)
    eps = float(jnp.finfo(states.dtype).eps)
    # An angle that is always small, as between almost collinear rods, is no failure.
    near = pivots[:2] < eps**0.5 * pivots[2:]
    found = jnp.any((near | ~fine[:2]) & jnp.isfinite(pivots[:2]), axis=0)
    if active_rows is not None:
        found = found & active_rows
    return jnp.where(jnp.any(found), jnp.argmax(found), -1).astype(jnp.int32)


def _farthest(dynamics: VectorField, tau: Array, y: Array, args: Arguments) -> Int[Array, ""]:
    """The constraint row with the largest residual, in units of its norm."""
    t, q, v, params = dynamics.state(tau, y, args)
    terms = dynamics.terms_at(q, args)
    A = terms.rows_of(t, v, params)(q)
    phi, rate = residuals(terms, dynamics.rows, t, q, v, params)
    size = jnp.abs(phi) + jnp.abs(rate)
    unit = jnp.sqrt(jnp.sum(A**2, axis=1))
    return jnp.argmax(size / jnp.where(unit > 0, unit, 1.0)).astype(jnp.int32)
