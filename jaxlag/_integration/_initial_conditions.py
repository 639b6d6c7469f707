"""Checks of the initial conditions, inside the compiled program."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxlag._core._arrays import stop_gradient
from jaxlag._integration._step_arguments import Arguments
from jaxlag._integration._vector_field import VectorField
from jaxlag._linalg._independent_rows import independent_rows
from jaxlag._linalg._mass_solve import closed_to, dependence_floor
from jaxlag._linalg._rounding_bounds import with_rounding
from jaxlag._linalg._row_residuals import (
    ROUNDINGS,
    relative_residual,
    row_sizes,
    without_rounding,
)
from jaxlag._lowering import AbstractTerms, State
from jaxlag._model._constraints import ConstraintRows


class Start(NamedTuple):
    """Whether a trajectory may start, and the reasons if it may not."""

    valid: Array  # all values are allowed
    in_range: Array  # the inputs are defined there
    finite: Array  # L and the residuals are finite there
    consistent: "Consistency"
    contacts_valid: Array  # contacts press, and slide in the direction that their friction assumes

    @property
    def allowed(self) -> Bool[Array, ""]:
        """Whether all conditions hold."""
        return self.valid & self.in_range & self.finite & self.consistent.ok & self.contacts_valid


class Consistency(NamedTuple):
    """Whether a start satisfies its constraints.

    Attributes:
        ok: all residuals are small, and no row contradicts the others.
        contradictory: no motion nearby satisfies all rows.
        row: index of the row concerned.
        complete: the quasi-velocities of the state represent all motions that the rows allow.
    """

    ok: Bool[Array, ""]
    contradictory: Bool[Array, ""]
    row: Int[Array, ""]
    complete: Bool[Array, ""]


def values_allowed(
    y0: Array, saves: Array, rtol: Any, atol: Any, step: Any, longest: Any
) -> Bool[Array, ""]:
    """The checks of concrete values, repeated for traced values."""
    floor = 10 * jnp.finfo(y0.dtype).eps
    checks = [
        jnp.all(jnp.isfinite(y0)),
        jnp.all(jnp.isfinite(saves)) & jnp.all(saves[1:] > saves[:-1]),
        jnp.isfinite(rtol) & jnp.isfinite(atol),
        (rtol >= 0) & (atol >= 0) & (rtol + atol > 0) & ((rtol == 0) | (rtol >= floor)),
    ]
    checks += [jnp.isfinite(x) & (x > 0) for x in (step, longest) if x is not None]
    return jnp.all(jnp.stack([jnp.all(jnp.asarray(check)) for check in checks]))


def start_finite(dynamics: VectorField, tau: Array, y0: Array, args: Arguments) -> Bool[Array, ""]:
    """Whether L and the residuals are finite as they are written, not as they are simplified.

    The first step checks the accelerations.
    """
    at = dynamics.state(*stop_gradient((tau, y0, args)))
    finite = jnp.isfinite(dynamics.system.lagrangian(*at))
    for residual in residuals(dynamics.terms, dynamics.rows, *at):
        finite = finite & jnp.all(jnp.isfinite(residual))
    return finite


def residuals(
    terms: AbstractTerms, rows: ConstraintRows, t: Array, q: Array, v: Array, params: Any
) -> tuple[Array, ...]:
    """(phi for every row, A v + b); empty without constraints."""
    if not rows.size:
        return ()
    return rows.of_all(terms.position(t, q, params)), terms.velocity(t, q, v, params)


def start_consistent(
    dynamics: VectorField, t: Array, q: Array, v: Array, params: Any, args: Arguments
) -> Consistency:
    """Whether a state satisfies the constraints and its quasi-velocities are regular."""
    found = _rows_consistent(dynamics, t, q, v, params, args)
    if dynamics.quasi is None:
        return found
    regular = dynamics.quasi.regular(*stop_gradient((t, q, params)))
    return found._replace(ok=found.ok & regular, complete=found.complete & regular)


def _rows_consistent(
    dynamics: VectorField, t: Array, q: Array, v: Array, params: Any, args: Arguments
) -> Consistency:
    """Whether residuals are below sqrt(eps) of the state, and no row contradicts the others.

    A row is contradictory if the solution of the independent rows does not satisfy it: phi, A v + b
    or A a + gamma. With quasi-velocities it is so if their kinematics do not satisfy it.
    """
    if not dynamics.rows.size:
        true = jnp.array(True)
        return Consistency(true, ~true, jnp.full((), -1, jnp.int32), true)
    t, q, v, params, args = stop_gradient((t, q, v, params, args))
    terms = dynamics.terms_at(q, args)
    gamma_of = terms.gamma_of(params)
    entries = terms.rows_of(t, v, params)
    if dynamics.program.is_sparse(args.constants):
        entries = dynamics.program.row_entries(terms, State(t, q, v, params, {}), args.constants)
    sure = all(dynamics.rows.sure)
    if args.rows is not None:
        void, unit = args.rows.void, args.rows.size
    elif sure:
        unit = jnp.sqrt(jnp.sum(entries(q) ** 2, axis=1))
        void, unit = unit < 0, jnp.where(unit > 0, unit, 1.0)
    else:
        _, void, unit = row_sizes(entries, q, entries(q))
    floor = dependence_floor(q.dtype)

    def everything(q: Array, v: Array) -> tuple[Array, ...]:
        return *residuals(terms, dynamics.rows, t, q, v, params), gamma_of(t, q, v)

    if sure:
        phi, rate, gamma = everything(q, v)
    else:
        phi, rate, gamma = without_rounding(everything, void, unit, q, v)
    if dynamics.quasi is not None:
        off = jnp.zeros_like(unit)
        for c, x in ((phi, q), (rate, v)):
            off = jnp.maximum(off, relative_residual(c, unit, x) / floor)
        near = jnp.all(off <= 1.0)
        A = terms.rows_of(t, v, params)(q)
        bad, complete = _fitting(dynamics, t, q, v, params, A, void, unit)
        bad = jnp.where(near, bad / floor, 0.0)
        found = _consistency(off, bad, near, phi, rate)
        return found._replace(complete=complete | ~found.ok, ok=found.ok & (complete | ~found.ok))
    corrected, times, spread = _correction(dynamics, t, q, v, params, args)

    def left(c: Array) -> Array:
        return jnp.abs(c - times(corrected(c))) / unit

    off, bad = jnp.zeros_like(unit), jnp.zeros_like(unit)
    for c, x in ((phi, q), (rate, v)):
        size = relative_residual(c, unit, x)
        off = jnp.maximum(off, size / floor)
        # A residual of the linearized rows alone is no contradiction.
        ajar = left(c) > 0.1 * jnp.max(jnp.abs(c) / unit)
        bad = jnp.maximum(bad, jnp.where(ajar, size / closed_to(q.dtype), 0.0))
    near = jnp.all(off <= 1.0)
    scale = jnp.abs(gamma) / unit + jnp.max(jnp.abs(corrected(gamma)))
    gamma_left = left(gamma)
    if dynamics.rows.size > 1:  # terms of gamma that cancel leave rounding, no contradiction
        _, rounding = with_rounding(gamma_of, t, q, v)
        rounding = ROUNDINGS * jnp.nan_to_num(rounding)
        gamma_left = jnp.maximum(gamma_left - (rounding + spread(rounding)) / unit, 0.0)
    gamma_left = gamma_left / (floor * jnp.where(scale > 0, scale, 1.0))
    bad = jnp.where(near, jnp.maximum(gamma_left, bad), bad)
    return _consistency(off, bad, near, phi, rate)


def _correction(
    dynamics: VectorField, t: Array, q: Array, v: Array, params: Any, args: Arguments
) -> tuple[Callable, Callable, Callable]:
    """(c -> K c, x -> A x, r -> |A K| r) with K = M^-1 A^T (A M^-1 A^T)^-1."""
    if not dynamics.program.is_sparse(args.constants):
        terms = dynamics.terms_at(q, args)
        K = terms.correction(t, q, v, params, args.constants, args.active_rows)
        A = terms.rows_of(t, v, params)(q)
        return lambda c: K @ c, lambda x: A @ x, lambda r: jnp.abs(A @ K) @ r
    state = State(t, q, v, params, {})
    surface = dynamics.program.projector(state, args.constants, dynamics.rows, args.active_rows)
    kick, columns, velocity = surface.kick, surface.columns, surface.velocity
    assert kick is not None
    assert columns is not None
    assert velocity is not None

    def times(x: Array) -> Array:
        return jax.jvp(lambda v: velocity(q, v), (v,), (x,))[1]

    def spread(r: Array) -> Array:
        """K is the inverse of A if no row is left out."""
        every = args.active_rows is None or jnp.all(args.active_rows)
        turned = lambda: jnp.abs(jax.vmap(times)(columns()).T) @ r  # noqa: E731
        return jax.lax.cond(every, lambda: r, turned)

    return kick, times, spread


def _fitting(
    dynamics: VectorField,
    t: Array,
    q: Array,
    v: Array,
    params: Any,
    A: Array,
    void: Bool[Array, " m"],
    unit: Array,
) -> tuple[Array, Bool[Array, ""]]:
    """(error of A B = 0 in every row, as a sine; whether A and B together have full rank)."""
    quasi = dynamics.quasi
    assert quasi is not None
    u = quasi.of(t, q, v, params)
    B = jax.jacfwd(lambda w: dynamics.velocities(t, q, w, params))(u[quasi.free])
    size = jnp.sqrt(jnp.sum(B**2, axis=0))
    B = B / jnp.where(size > 0, size, 1.0)[None]
    sines = jnp.abs(A @ B) / unit[:, None]
    rows = jnp.concatenate([jnp.where(void[:, None], 0.0, A) / unit[:, None], B.T])
    # Singular kinematics, as at gimbal lock, are a separate failure.
    sound = jnp.all(jnp.isfinite(rows))
    rows = jnp.where(sound, rows, jnp.eye(*rows.shape, dtype=q.dtype))
    rank = jnp.sum(independent_rows(jnp.eye(q.shape[0], dtype=q.dtype), rows))
    return jnp.max(jnp.where(jnp.isfinite(sines), sines, 0.0), axis=1), rank == q.shape[0]


def rows_hold_after(
    dynamics: VectorField, ts: Array, q: Array, v: Array, params: Any
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """(whether the kinematics satisfy the rows at all saved times, index of a row that fails).

    With U the rows are satisfied by definition. Without quasi-velocities the projection satisfies
    them.
    """
    quasi = dynamics.quasi
    if quasi is None or quasi.U is not None or not dynamics.rows.size:
        return jnp.array(True), jnp.full((), -1, jnp.int32)
    ts, q, v, params = stop_gradient((ts, q, v, params))
    rates = jax.vmap(lambda t, q, v: dynamics.terms.velocity(t, q, v, params))(ts, q, v)
    A = jax.vmap(lambda t, q, v: dynamics.terms.rows(t, q, v, params)[0])(ts, q, v)
    first = row_sizes(dynamics.terms.rows_of(ts[0], v[0], params), q[0], A[0]).size
    unit = jnp.maximum(jnp.sqrt(jnp.sum(A**2, axis=2)), jnp.finfo(q.dtype).eps * first)
    off = jax.vmap(relative_residual)(rates, unit, v) / dependence_floor(q.dtype)
    off = jnp.max(jnp.where(jnp.isfinite(off), off, 0.0), axis=0)
    return jnp.all(off <= 1.0), jnp.argmax(off).astype(jnp.int32)


def _consistency(off: Array, bad: Array, near: Array, phi: Array, rate: Array) -> Consistency:
    contradictory = jnp.any(bad > 1.0)
    row = jnp.where(contradictory, jnp.argmax(bad), jnp.argmax(off))
    # Nonfinite residuals are a separate failure.
    ok = (near & ~contradictory) | ~jnp.all(jnp.isfinite(phi) & jnp.isfinite(rate))
    row = jnp.where(ok, -1, row).astype(jnp.int32)
    return Consistency(ok, contradictory, row, jnp.array(True))
