"""A largest independent set of constraint rows, and the multipliers of dependent rows."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from jaxlag._linalg._kkt import augmented
from jaxlag._linalg._mass_solve import eliminate, factor_mass, rank_floor
from jaxlag._linalg._row_residuals import ROUNDINGS, row_lengths

ALIKE = 0.01
"""Part of the largest pivot from which on pivots count as equally good."""


class RowChoice(NamedTuple):
    """Rows used in solves.

    Attributes:
        active_rows: a largest independent set; the others follow from it.
        nonzero: rows that are more than rounding.
    """

    active_rows: Bool[Array, " m"]
    nonzero: Bool[Array, " m"]


def independent_rows(
    M: Float[Array, "n n"],
    A: Float[Array, "m n"],
    priority: Sequence[int] | np.ndarray | None = None,
    floor: float | None = None,
    nonzero: Bool[Array, " m"] | None = None,
    mobile_first: bool = False,
) -> Bool[Array, " m"]:
    """A largest independent set of rows, found greedily.

    Cholesky factorization with diagonal pivoting of A (M + A^T W A)^-1 A^T, rows scaled to 1. A
    pivot is the squared sine of the angle between a row and those chosen before it. Of equal
    pivots the first is taken.

    Args:
        M: symmetric, positive definite where A x = 0.
        A: rows.
        priority: of every row: rows of a lower number are taken first; None if all are equal.
        floor: least pivot; by default `rank_floor`.
        nonzero: rows that do not count as zero; by default those of positive length.
        mobile_first: of rows with similar pivots take the one along which a force of the same
            size moves most. `least_norm` is then accurate for the others.

    Source: Golub, Van Loan, Matrix Computations, sec. 4.2.8.
    """
    m = A.shape[0]
    norms = jnp.sqrt(jnp.sum(A**2, axis=1))
    floor = rank_floor(A.dtype) if floor is None else floor
    positive = norms > 0
    usable = positive if nonzero is None else positive & nonzero
    if m == 1:  # no other rows
        return usable
    A = jnp.where(usable[:, None], A, 0.0) / jnp.where(usable, norms, 1.0)[:, None]
    mass = factor_mass(augmented(M, A)[0])
    S = A @ jax.vmap(lambda row: eliminate(mass, row))(A).T
    pivots = jnp.diagonal(S)
    usable = usable & (pivots > 0)
    scale = jax.lax.rsqrt(jnp.where(usable, pivots, 1.0))
    S = scale[:, None] * S * scale[None]
    priorities = np.zeros(m, int) if priority is None else np.asarray(priority, int)

    def choose(_: Int[Array, ""], state: tuple[Array, Array]) -> tuple[Array, Array]:
        S, active = state
        left = jnp.where(active | ~usable, -1.0, jnp.diagonal(S))
        now = jnp.min(jnp.where(left > floor, priorities, np.max(priorities, initial=0)))
        left = jnp.where(priorities > now, -1.0, left)
        if mobile_first:
            left = jnp.where(left > ALIKE * jnp.max(left), left * pivots, -1.0)
        k = jnp.argmax(left > 0.999 * jnp.max(left))  # the first of nearly equal ones
        take = ~active[k] & usable[k] & (S[k, k] > floor)
        reduced = S - jnp.outer(S[:, k], S[k]) / jnp.where(take, S[k, k], 1.0)
        return jnp.where(take, reduced, S), active.at[k].set(active[k] | take)

    return jax.lax.fori_loop(0, m, choose, (S, jnp.zeros((m,), bool)))[1]


def least_norm(
    A: Float[Array, "m n"],
    lam: Float[Array, " m"],
    active_rows: Bool[Array, " m"] | None = None,
    nonzero: Bool[Array, " m"] | None = None,
    units: Float[Array, " n"] | None = None,
) -> Float[Array, " m"]:
    """The multipliers with the same A^T lam of least norm sum_k (|A_k| lam_k)^2.

    |A_k lam_k| is the generalized force of row k alone, so that the result does not depend on
    the scale of a residual. Rows are compared in units of the coordinates, because with short
    levers different rows look alike. With unit rows a_k, dependent rows are a_j = C_j a_active. A
    multiplier z_j of such a row reduces the active ones to mu_active - C^T z. The z of least norm
    is a least-squares problem; A^T lam does not depend on its accuracy. Rows that do not follow
    from the active ones have none. Derivatives are those at constant rank of A.

    Args:
        A: rows.
        lam: multipliers with that A^T lam.
        active_rows: a largest set of independent rows; by default it is computed.
        nonzero: rows that are more than rounding, see `row_sizes`; by default all rows.
        units: of the coordinates, for the comparison of rows; by default 1.

    Source: Golub, Pereyra, SIAM J. Numer. Anal. 10 (1973) 413 (pseudo-inverse at constant rank).
    """
    m, n = A.shape
    if nonzero is not None:
        A = jnp.where(nonzero[:, None], A, 0.0)
    if m == 1:
        return lam if nonzero is None else jnp.where(nonzero, lam, 0.0)
    units = jnp.ones((n,), A.dtype) if units is None else jax.lax.stop_gradient(units)
    if active_rows is None:
        metric, fixed = jnp.diag(units**-2), jax.lax.stop_gradient(A)
        active_rows = independent_rows(metric, fixed, nonzero=nonzero, mobile_first=True)
    norms, sizes = row_lengths(A), row_lengths(A * units[None])
    norms, sizes = (jnp.where(x > 0, x, 1.0) for x in (norms, sizes))
    unit = A * units[None] / sizes[:, None]
    C = _least_squares(unit.T, unit.T, active_rows).T
    squares = jnp.sum((unit - C @ unit) ** 2, axis=1)
    follows = ~active_rows & (squares <= float(jnp.finfo(A.dtype).eps))
    # Coefficients that are rounding could be large for a row of smaller weight.
    rounding = jnp.abs(C) <= ROUNDINGS * float(jnp.finfo(A.dtype).eps)
    C = C - jax.lax.stop_gradient(jnp.where(rounding, C, 0.0))
    C = jnp.where(follows[:, None], C, 0.0)
    mu, weights = sizes * lam, norms / sizes
    of_active = jnp.where(active_rows, mu + mu @ C, 0.0)
    # Normal equations, in units in which their diagonal is 1: weights may differ as much as forces
    # and moments of short levers. Rows of small weights stay, so that accuracy is not lost.
    moved = weights[:, None] * (C.T - jnp.diag(follows.astype(A.dtype)))
    lengths = row_lengths(moved.T)
    lengths = jnp.where(lengths > 0, lengths, 1.0)
    square = (moved.T @ moved) / jnp.outer(lengths, lengths)
    square = square + jnp.diag((~follows).astype(A.dtype))
    z = jnp.linalg.solve(square, (weights * of_active) @ moved / lengths) / lengths
    found = jnp.where(active_rows, of_active - z @ C, z)
    left = (jnp.where(active_rows | follows, mu, 0.0) - found) @ unit
    return (found + _least_squares(unit.T, left[:, None], active_rows)[:, 0]) / sizes


def _least_squares(
    X: Float[Array, "r m"], Y: Float[Array, "r k"], columns: Bool[Array, " m"]
) -> Float[Array, "m k"]:
    """The x that minimizes |X x - Y| over these columns of X, 0 in the others; by QR."""
    m = X.shape[1]
    spare = jnp.diag((~columns).astype(X.dtype))
    Q, R = jnp.linalg.qr(jnp.concatenate([jnp.where(columns, X, 0.0), spare]))
    right = jnp.concatenate([Y, jnp.zeros((m, Y.shape[1]), Y.dtype)])
    return jnp.where(columns[:, None], solve_triangular(R, Q.T @ right), 0.0)


def shared(
    A: Float[Array, "m n"],
    lam: Float[Array, " m"],
    active_rows: Bool[Array, " m"],
    nonzero: Bool[Array, " m"],
    group: Sequence[bool] | np.ndarray,
    units: Float[Array, " n"] | None = None,
) -> Float[Array, " m"]:
    """The multipliers, with those of a group of rows of least norm within the group.

    Args:
        A: rows.
        lam: multipliers with that A^T lam, 0 where rows are not active.
        active_rows: a largest set of independent rows, those of the group first.
        nonzero: rows that are more than rounding.
        group: for every row, whether it belongs to the group.
        units: of the coordinates, for the comparison of rows.
    """
    chosen = np.flatnonzero(group)
    if len(chosen) < 2:
        return lam
    found = least_norm(A[chosen], lam[chosen], active_rows[chosen], nonzero[chosen], units)
    return lam.at[chosen].set(found)
