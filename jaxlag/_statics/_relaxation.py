"""Relaxation: damped motion on the constraints to a state of rest."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlag._statics._root_search import units

CLOSING_STEPS = 48
EASE, TIGHTEN = 1 / 8, 4.0  # factors of the damping after a good step and after a rejected one
WORK, GOOD_WORK = 0.1, 0.75  # least work of an accepted step, over the expected work
MISS, GOOD_MISS = 1.0, 0.25  # largest error of the predicted forces, over the forces at its start


class RowsAt(NamedTuple):
    """Constraint rows in units of the coordinates, each of length 1, by singular values.

    Rows that depend on others are left out. Off the constraints such rows may be independent, in
    proportion to the deviation: `floor` is the relative singular value up to which they count as
    dependent.
    """

    norms: Float[Array, " m"]
    left: Float[Array, "m k"]
    inverse: Float[Array, " k"]
    axes: Float[Array, "n n"]  # orthonormal, the held ones first

    @property
    def held(self) -> Bool[Array, " n"]:
        """The axes that the rows hold."""
        free = jnp.zeros((self.axes.shape[0] - self.inverse.shape[0],), bool)
        return jnp.concatenate([self.inverse > 0, free])

    def shortest(self, y: Float[Array, " m"]) -> Float[Array, " n"]:
        """The shortest displacement d with A d = y."""
        part = self.inverse * ((y / self.norms) @ self.left)
        return part @ self.axes[: len(part)]

    def multipliers(self, F: Float[Array, " n"]) -> Float[Array, " m"]:
        """The lam that minimizes |F + A^T lam|."""
        part = self.inverse * (self.axes[: len(self.inverse)] @ F)
        return -(self.left @ part) / self.norms


def _rows(A: Float[Array, "m n"], norms: Float[Array, " m"], floor: Array | float) -> RowsAt:
    (m, n), dtype = A.shape, A.dtype
    if m == 0:
        none = jnp.zeros((0,), dtype)
        return RowsAt(none, jnp.zeros((0, 0), dtype), none, jnp.eye(n, dtype=dtype))
    left, sizes, axes = jnp.linalg.svd(A / norms[:, None], full_matrices=True)
    regular = sizes > floor * sizes[0]
    inverse = jnp.where(regular, 1 / jnp.where(regular, sizes, 1), 0)
    return RowsAt(norms, left[:, : len(sizes)], inverse, axes)


def _lengths(A: Float[Array, "m n"]) -> Float[Array, " m"]:
    norms = jnp.linalg.norm(A, axis=1)
    return jnp.where(norms > 0, norms, 1)


class Point(NamedTuple):
    """Forces F and rows A at q, and their derivatives."""

    q: Float[Array, " n"]
    F: Float[Array, " n"]
    A: Float[Array, "m n"]
    dF: Float[Array, "n n"]
    dA: Float[Array, "m n n"]

    def balance(self, lam: Float[Array, " m"]) -> Float[Array, " n"]:
        """F + A^T lam."""
        return self.F + lam @ self.A

    def stiffness(self, lam: Float[Array, " m"]) -> Float[Array, "n n"]:
        """-d(F + A^T lam)/dq at fixed lam."""
        return -(self.dF + jnp.tensordot(lam, self.dA, 1))


class _Step(NamedTuple):
    """A step p that solves (K + mu) p = F + A^T lam on the tangent space, in units c."""

    p: Float[Array, " n"]
    lam: Float[Array, " m"]
    c: Float[Array, " n"]
    expected: Float[Array, ""]  # work of all forces along it, to second order


class _State(NamedTuple):
    base: Point
    step: _Step
    trial: Float[Array, " n"]
    closed: Bool[Array, ""]
    damping: Float[Array, ""]
    ended: Bool[Array, ""]
    count: Int[Array, ""]


def relax(
    forces: Callable, phi: Callable, q0: Float[Array, " n"], max_steps: Int[Array, ""]
) -> tuple[Float[Array, " n"], Int[Array, ""]]:
    """(state at the end of the relaxation, number of steps).

    Implicit Euler steps of the damped motion (q' = F + A^T lam, phi(q) = 0) in units in which K is
    about 1: (K + mu) p = F + A^T lam on the tangent space, then a projection onto the constraints.
    mu is at least such that K + mu is positive definite. If forces have a potential, every step
    then reduces it: this is Newton's method with a trust region on the constraint
    manifold. A step is accepted if the work of the forces and their change are as
    expected. A potential is not required, and M is not used.

    Args:
        forces: q -> (F, A), forces and constraint rows.
        phi: q -> residuals of the constraints.
        q0: start; the first step projects it onto the constraints.
        max_steps: bound on the steps; if it is 0 nothing is computed.

    Source: Absil, Mahony, Sepulchre, Optimization Algorithms on Matrix Manifolds, ch. 7 (trust
    regions on manifolds); Kelley, Keyes, SIAM J. Numer. Anal. 35 (1998) 508 (implicit Euler steps
    to a steady state).
    """
    eps = float(jnp.finfo(q0.dtype).eps)

    def body(s: _State) -> _State:
        at_trial = _measured(forces, s.trial)
        done, as_expected, fair = _compared(s, at_trial)
        fine = s.closed & (done >= WORK) & (as_expected <= MISS) & fair
        good = fine & (done >= GOOD_WORK) & (as_expected <= GOOD_MISS)
        leads_on = s.count <= 1  # the start, and its projection onto the constraints
        damping = s.damping * jnp.where(good, EASE, jnp.where(fine, 1.0, TIGHTEN))
        damping = jnp.clip(jnp.where(leads_on, 1.0, damping), eps, 1 / eps)
        accepted = leads_on | fine
        base = jax.tree.map(lambda x, y: jnp.where(accepted, x, y), at_trial, s.base)

        step = _step(base, damping)
        step = step._replace(p=jnp.where(s.count == 0, 0, step.p))
        trial, closed = _closed(forces, phi, base.q + step.p, step.c, *_measures(base, step.c))
        away = jnp.linalg.norm((trial - base.q - step.p) / step.c)
        closed = closed & ((s.count == 0) | (away <= jnp.linalg.norm(step.p / step.c)))
        near = eps**0.5 * (jnp.abs(base.q) + jnp.abs(base.q - q0))
        rests = accepted & ~leads_on & jnp.all(jnp.abs(step.p) <= near)
        ended = rests | (damping >= 1 / eps) | ((s.count == 0) & ~closed)
        return _State(base, step, trial, closed, damping, ended, s.count + 1)

    zero, no = jnp.zeros((), q0.dtype), jnp.zeros((), bool)
    q, lam = jnp.zeros_like(q0), jnp.zeros_like(phi(q0))
    A, K = jnp.outer(lam, q), jnp.outer(q, q)
    nowhere = Point(q0, q, A, K, jnp.zeros((*A.shape, *q.shape), q.dtype))
    init = _State(nowhere, _Step(q, lam, q + 1, zero), q0, no, zero, no, jnp.zeros((), jnp.int32))
    end = jax.lax.while_loop(lambda s: ~s.ended & (s.count < max_steps), body, init)
    return end.base.q, end.count


def _measures(base: Point, c: Array) -> tuple[Array, Array]:
    return _lengths(base.A * c[None]), jnp.linalg.norm(c * base.F)


def _measured(forces: Callable, q: Float[Array, " n"]) -> Point:
    def along(direction: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        return jax.jvp(forces, (q,), (direction,))

    directions = jnp.eye(q.shape[0], dtype=q.dtype)
    (F, A), (dF, dA) = jax.vmap(along, out_axes=(None, -1))(directions)
    return Point(q, F, A, dF, dA)


def _compared(s: _State, at_trial: Point) -> tuple[Array, Array, Array]:
    """(work done over work expected, error of predicted forces over forces, all finite).

    The work of F + A^T lam at constant lam, by the trapezoidal rule with end corrections. If F
    has a potential V it is the decrease of V - lam . phi, and phi vanishes at both ends. Unlike a
    difference of V it keeps its accuracy near the minimum.
    """
    lam, c, d = s.step.lam, s.step.c, at_trial.q - s.base.q
    before, after = s.base.balance(lam), at_trial.balance(lam)
    K0, K1 = s.base.stiffness(lam), at_trial.stiffness(lam)
    work = 0.5 * (before + after) @ d + d @ (K1 - K0) @ d / 12
    expected = jnp.where(s.step.expected > 0, s.step.expected, 1)
    size = jnp.linalg.norm(c * before)
    missed = jnp.linalg.norm(c * (after - before + K0 @ d)) / jnp.where(size > 0, size, 1)
    return work / expected, missed, jnp.all(jnp.isfinite(at_trial.dF))


def _step(base: Point, damping: Float[Array, ""]) -> _Step:
    (m, n), dtype = base.A.shape, base.q.dtype
    eps = float(jnp.finfo(dtype).eps)
    floor = eps ** (1 / 3)  # above the residual of the projection, eps^3/4
    lam = _rows(base.A, _lengths(base.A), floor).multipliers(base.F)
    border = jnp.block([[base.stiffness(lam), base.A.T], [base.A, jnp.zeros((m, m), dtype)]])
    c = units(border, jnp.concatenate([base.balance(lam), jnp.zeros((m,), dtype)]))[:n]

    A = base.A * c[None]
    rows = _rows(A, _lengths(A), floor)
    lam = rows.multipliers(c * base.F)
    free = ~rows.held
    g = jnp.where(free, rows.axes @ (c * base.balance(lam)), 0)
    K = rows.axes @ (c[:, None] * base.stiffness(lam) * c[None]) @ rows.axes.T
    K = jnp.where(free[:, None] & free[None], K, 0)
    above = jnp.where(free, 0, jnp.sum(jnp.abs(K)) + 1)
    least = jnp.linalg.eigvalsh(0.5 * (K + K.T) + jnp.diag(above))[0]
    size = jnp.max(jnp.abs(K), initial=0.0)
    for other in (jnp.linalg.norm(g), 1.0):  # without stiffness: steps in proportion to the forces
        size = jnp.where(size > 0, size, other)
    mu = jnp.maximum(-least, 0) + damping * size
    p = jnp.linalg.solve(K + jnp.diag(jnp.where(free, mu, 1)), g)
    return _Step(c * (p @ rows.axes), lam, c, g @ p - 0.5 * p @ K @ p)


class _Closing(NamedTuple):
    q: Float[Array, " n"]
    residual: Float[Array, ""]
    d: Float[Array, " n"]
    closed: Bool[Array, ""]
    fraction: Float[Array, ""]
    count: Int[Array, ""]


def _closed(
    forces: Callable,
    phi: Callable,
    q0: Float[Array, " n"],
    c: Float[Array, " n"],
    lengths: Float[Array, " m"],
    displacement: Float[Array, ""],
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """(q0 projected onto phi = 0 by the shortest steps in units c, whether it converged).

    Gauss-Newton's method, with shorter steps if the residual would not decrease.

    Args:
        forces: q -> (F, A).
        phi: q -> residuals.
        q0: start.
        c: units.
        lengths: lengths of the rows in these units, to compare residuals.
        displacement: by the forces; with q0 it defines the scale of small displacements.
    """
    if not lengths.shape[0]:
        return q0, jnp.array(True)
    eps = float(jnp.finfo(q0.dtype).eps)

    def body(s: _Closing) -> _Closing:
        q = s.q + s.fraction * c * s.d
        A, y = forces(q)[1] * c[None], phi(q)
        norms, reach = _lengths(A), jnp.linalg.norm(q / c) + displacement
        off = jnp.linalg.norm(y / norms)
        floor = jnp.clip(off / jnp.where(reach > 0, reach, 1), eps**0.5, 0.03)
        d = -_rows(A, norms, floor).shortest(y)
        closed = (jnp.linalg.norm(d) <= eps**0.75 * reach) | (off <= 16 * eps * reach)
        residual = jnp.linalg.norm(y / lengths)
        better = (s.count == 0) | (residual < (1 - 0.1 * s.fraction) * s.residual)
        moved = _Closing(q, residual, d, closed, jnp.minimum(1, 2 * s.fraction), s.count)
        chosen = jax.tree.map(
            lambda x, y: jnp.where(better, x, y), moved, s._replace(fraction=s.fraction / 4)
        )
        return chosen._replace(count=s.count + 1)

    def cond_fun(s: _Closing) -> Array:
        return ~s.closed & (s.fraction > 1e-3) & (s.count < CLOSING_STEPS)

    one = jnp.ones((), q0.dtype)
    init = _Closing(q0, one, 0 * q0, jnp.array(False), one, jnp.zeros((), jnp.int32))
    end = jax.lax.while_loop(cond_fun, body, init)
    return end.q + c * end.d, end.closed
