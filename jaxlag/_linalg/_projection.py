"""Projection of a state onto its constraints, in the metric of M with one factorization."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlag._linalg._kkt import solve_general

MAX_ITERATIONS = 12
SWEEPS = 3
TARGET = 8.0  # roundings of the state: smaller corrections are not iterated
ACCEPTED = 0.6  # a state counts as consistent if its correction is below eps^this


class ConstraintProjector(NamedTuple):
    """The constraints near a predicted state, as functions of vectors.

    Attributes:
        position: q -> phi(t, q), None if no row has one.
        velocity: (q, v) -> A v + b; None if velocities satisfy all rows by definition.
        shift: c -> M^-1 A^T (A M^-1 A^T)^-1 c over the rows of `position`, at the predicted state.
        kick: the same over all rows; None as `velocity`.
        columns: function that returns the columns of its matrix, 0 for rows that are left out;
            None as `velocity`.
        masses: diagonal of (A M^-1 A^T)^-1, 0 for dependent rows; None if not needed.
        keeps_sense: (t, q, v) -> whether pivots of A M^-1 A0^T, or of A K, are positive as at the
            predicted state, whose rows are A0; None if the columns are to be used.
        reach: x -> |A| x at the predicted state; None of a scalar program.
        units: function that returns the units of the coordinates in which their inertias are 1;
            None likewise.
        sparse: whether A is sparse, so that the columns take many solves.
    """

    position: Callable | None
    velocity: Callable | None
    shift: Callable
    kick: Callable | None
    columns: Callable[[], Float[Array, "m n"]] | None = None
    masses: Float[Array, " m"] | None = None
    keeps_sense: Callable | None = None
    reach: Callable | None = None
    units: Callable | None = None
    sparse: bool = False


def keeps_sense(
    columns: Float[Array, "m n"], A: Float[Array, "m n"], active_rows: Bool[Array, " m"] | None
) -> Bool[Array, ""]:
    """Whether the pivots of A K are positive, see `ConstraintProjector`.

    Args:
        columns: those of K, at the predicted state.
        A: rows at another state.
        active_rows: rows to solve with; None for all.
    """
    turned = A @ columns.T
    if active_rows is not None:
        both = active_rows[:, None] & active_rows[None]
        turned = jnp.where(both, turned, jnp.eye(*turned.shape, dtype=A.dtype))
    return solve_general(turned, jnp.zeros(turned.shape[:1], A.dtype), 0.0)[1]


def project(
    surface: ConstraintProjector, q: Array, v: Array, frozen: ConstraintProjector | None = None
) -> tuple[Array, Array, Bool[Array, ""]]:
    """The consistent (q, v) nearest to a predicted one, and whether the iteration converged.

    First q* = q - M^-1 A^T mu with phi(t, q*) = 0, then v* = v - M^-1 A^T nu with
    A(t, q*) v* + b(t, q*) = 0; M and A at the predicted state, factored once. The order of the
    solver is kept, since both corrections are as large as its local error.

    Args:
        surface: the constraints.
        q: predicted coordinates.
        v: predicted velocities.
        frozen: the same surface without derivatives, if derivatives will be taken.
            They are those of the equations and do not depend on the number of iterations.

    Source: Hairer, Wanner, Solving Ordinary Differential Equations II, sec. VII.2 (projection).
    """
    converged = jnp.array(True)
    if surface.position is not None:
        frozen_equation = None if frozen is None else _Equation(frozen.position, frozen.shift)
        q, converged = _solved(_Equation(surface.position, surface.shift), q, frozen_equation)
    if surface.velocity is None:
        return q, v, converged
    at_q, frozen_equation = _rates_at(surface, q), None
    if frozen is not None:
        frozen_equation = _rates_at(frozen, jax.lax.stop_gradient(q))
    v, v_converged = _solved(at_q, v, frozen_equation)
    return q, v, converged & v_converged


def tangential(
    surface: ConstraintProjector, q: Array, v: Array, dq: Array, dv: Array
) -> tuple[Array, Array]:
    """The error (dq, dv) after the projection: the difference of the projected states.

    It is along the constraints, up to second order, by one Newton iteration
    from (q + dq, v + dv).

    Args:
        surface: the constraints.
        q: coordinates, which satisfy them.
        v: velocities, which satisfy them.
        dq: error of the coordinates before the projection.
        dv: error of the velocities.

    Source: Eich, SIAM J. Numer. Anal. 30 (1993) 1467 (projected error estimates).
    """
    if surface.position is not None:
        dq = dq - surface.shift(surface.position(q + dq))
    if surface.velocity is None or surface.kick is None:
        return dq, dv
    return dq, dv - surface.kick(surface.velocity(q + dq, v + dv))


def iterations_needed(surface: ConstraintProjector, q: Array, v: Array) -> Int[Array, ""]:
    """The larger of the numbers of iterations of `project` for q and for v."""
    count = jnp.zeros((), jnp.int32)
    if surface.position is not None:
        equation = _Equation(surface.position, surface.shift)
        mu, _, count = _iterate(equation, q)
        q = equation.at(q, mu)
    if surface.velocity is None:
        return count
    return jnp.maximum(count, _iterate(_rates_at(surface, q), v)[2])


def _rates_at(surface: ConstraintProjector, q: Array) -> "_Equation":
    velocity, kick = surface.velocity, surface.kick
    assert velocity is not None
    assert kick is not None
    return _Equation(lambda v: velocity(q, v), kick)


class _Equation(NamedTuple):
    """residual(x) = 0 for x = start - correct(mu)."""

    residual: Any
    correct: Callable

    def at(self, start: Array, mu: Array) -> Array:
        return start - self.correct(mu)

    def left(self, start: Array, mu: Array) -> Array:
        return self.residual(self.at(start, mu))


def _solved(
    equation: _Equation, start: Array, frozen: _Equation | None
) -> tuple[Array, Bool[Array, ""]]:
    """(x, whether it converged), by the simplified Newton method: mu grows by the residual.

    The residual shrinks per iteration by a factor proportional to the distance from the predicted
    state. At the solution further iterations are the identity with the derivative of the implicit
    function, up to that factor to the power of their number.
    """
    if frozen is None:
        mu, size, _ = _iterate(equation, start)
    else:
        mu, size, _ = jax.lax.stop_gradient(_iterate(frozen, jax.lax.stop_gradient(start)))
        for _ in range(SWEEPS):
            mu = mu + equation.left(start, mu)
    return equation.at(start, mu), size <= _eps(start) ** ACCEPTED


def _iterate(equation: _Equation, start: Array) -> tuple[Array, Array, Array]:
    """(mu for which the residual is rounding, or after MAX_ITERATIONS; the residual; iterations).

    One iteration is sufficient after most steps. The loop contains the residual once, which may be
    long code: at mu = 0, then after every iteration.
    """
    target = TARGET * _eps(start)

    def cond_fun(state: Any) -> Array:
        _, _, size, count = state
        return (count < 1) | ((size > target) & (count < MAX_ITERATIONS))

    def body_fun(state: Any) -> Any:
        mu, left, _, count = state
        mu = mu + left
        left = equation.left(start, mu)
        return mu, left, _size(equation.correct(left), start), count + 1

    none = jnp.zeros_like(jax.eval_shape(equation.residual, start))
    init = none, none, jnp.full((), jnp.inf, start.dtype), jnp.full((), -1, jnp.int32)
    mu, _, size, count = jax.lax.while_loop(cond_fun, body_fun, init)
    return mu, size, count


def _eps(x: Array) -> float:
    return float(jnp.finfo(x.dtype).eps)


def _size(change: Array, x: Array) -> Array:
    """Largest |change_j| / (1 + |x_j|)."""
    return jnp.max(jnp.abs(change) / (1.0 + jnp.abs(x)))
