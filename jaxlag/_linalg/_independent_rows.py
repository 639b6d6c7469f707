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
        kept: a largest independent set; the others follow from it.
        there: rows that are more than rounding.
    """

    kept: Bool[Array, " m"]
    there: Bool[Array, " m"]


def independent_rows(
    M: Float[Array, "n n"],
    A: Float[Array, "m n"],
    turn: Sequence[int] | np.ndarray | None = None,
    floor: float | None = None,
    there: Bool[Array, " m"] | None = None,
    mobile_first: bool = False,
) -> Bool[Array, " m"]:
    """A largest independent set of rows, found greedily.

    Cholesky factorization with diagonal pivoting of A (M + A^T W A)^-1 A^T, rows scaled to 1. A
    pivot is the squared sine of the angle between a row and those chosen before it. Of equal
    pivots the first is taken.

    Args:
        M: symmetric, positive definite where A x = 0.
        A: rows.
        turn: for every row its priority: rows of a lower number are taken first; None for
            one priority.
        floor: least pivot; by default `rank_floor`.
        there: rows that do not count as zero; by default the nonzero ones.
        mobile_first: of rows with similar pivots take the one along which a force of the same
            size moves most. `least_norm` is then accurate for the others.

    Source: Golub, Van Loan, Matrix Computations, sec. 4.2.8.
    """
    m = A.shape[0]
    norms = jnp.sqrt(jnp.sum(A**2, axis=1))
    floor = rank_floor(A.dtype) if floor is None else floor
    nonzero = norms > 0
    usable = nonzero if there is None else nonzero & there
    if m == 1:  # no other rows
        return usable
    A = jnp.where(usable[:, None], A, 0.0) / jnp.where(usable, norms, 1.0)[:, None]
    mass = factor_mass(augmented(M, A)[0])
    S = A @ jax.vmap(lambda row: eliminate(mass, row))(A).T
    pivots = jnp.diagonal(S)
    usable = usable & (pivots > 0)
    scale = jax.lax.rsqrt(jnp.where(usable, pivots, 1.0))
    S = scale[:, None] * S * scale[None]
    turns = np.zeros(m, int) if turn is None else np.asarray(turn, int)

    def choose(_: Int[Array, ""], state: tuple[Array, Array]) -> tuple[Array, Array]:
        S, kept = state
        left = jnp.where(kept | ~usable, -1.0, jnp.diagonal(S))
        now = jnp.min(jnp.where(left > floor, turns, np.max(turns, initial=0)))
        left = jnp.where(turns > now, -1.0, left)
        if mobile_first:
            left = jnp.where(left > ALIKE * jnp.max(left), left * pivots, -1.0)
        k = jnp.argmax(left > 0.999 * jnp.max(left))  # the first of nearly equal ones
        take = ~kept[k] & usable[k] & (S[k, k] > floor)
        reduced = S - jnp.outer(S[:, k], S[k]) / jnp.where(take, S[k, k], 1.0)
        return jnp.where(take, reduced, S), kept.at[k].set(kept[k] | take)

    return jax.lax.fori_loop(0, m, choose, (S, jnp.zeros((m,), bool)))[1]


def least_norm(
    A: Float[Array, "m n"],
    lam: Float[Array, " m"],
    kept: Bool[Array, " m"] | None = None,
    there: Bool[Array, " m"] | None = None,
    units: Float[Array, " n"] | None = None,
) -> Float[Array, " m"]:
    """The multipliers with the same A^T lam of least norm sum_k (|A_k| lam_k)^2.

    |A_k lam_k| is the generalized force of row k alone, so that the result does not depend on
    the scale of a residual. Rows are compared in units of the coordinates, because with short
    levers different rows look alike. With unit rows a_k, dependent rows are a_j = C_j a_kept. A
    multiplier z_j of such a row reduces the kept ones to mu_kept - C^T z. The z of least norm is a
    least-squares problem; A^T lam does not depend on its accuracy. Rows that do
    not follow from the kept ones have none. Derivatives are those at constant rank of A.

    Args:
        A: rows.
        lam: multipliers with that A^T lam.
        kept: a largest set of independent rows; by default it is computed.
        there: rows that are more than rounding, see `row_sizes`; by default the nonzero ones.
        units: of the coordinates, for the comparison of rows; by default 1.

    Source: Golub, Pereyra, SIAM J. Numer. Anal. 10 (1973) 413 (pseudo-inverse at constant rank).
    """
    m, n = A.shape
    if there is not None:
        A = jnp.where(there[:, None], A, 0.0)
    if m == 1:
        return lam if there is None else jnp.where(there, lam, 0.0)
    units = jnp.ones((n,), A.dtype) if units is None else jax.lax.stop_gradient(units)
    if kept is None:
        metric, fixed = jnp.diag(units**-2), jax.lax.stop_gradient(A)
        kept = independent_rows(metric, fixed, there=there, mobile_first=True)
    norms, sizes = row_lengths(A), row_lengths(A * units[None])
    norms, sizes = (jnp.where(x > 0, x, 1.0) for x in (norms, sizes))
    unit = A * units[None] / sizes[:, None]
    C = _least_squares(unit.T, unit.T, kept).T
    apart = jnp.sum((unit - C @ unit) ** 2, axis=1)
    follows = ~kept & (apart <= float(jnp.finfo(A.dtype).eps))
    # Coefficients that are rounding could be large for a row of smaller weight.
    rounding = jnp.abs(C) <= ROUNDINGS * float(jnp.finfo(A.dtype).eps)
    C = C - jax.lax.stop_gradient(jnp.where(rounding, C, 0.0))
    C = jnp.where(follows[:, None], C, 0.0)
    mu, weights = sizes * lam, norms / sizes
    of_kept = jnp.where(kept, mu + mu @ C, 0.0)
    # Normal equations, in units in which their diagonal is 1: weights may differ as much as forces
    # and moments of short levers. Rows of small weights are kept, so that accuracy is not lost.
    moved = weights[:, None] * (C.T - jnp.diag(follows.astype(A.dtype)))
    lengths = row_lengths(moved.T)
    lengths = jnp.where(lengths > 0, lengths, 1.0)
    square = (moved.T @ moved) / jnp.outer(lengths, lengths)
    square = square + jnp.diag((~follows).astype(A.dtype))
    z = jnp.linalg.solve(square, (weights * of_kept) @ moved / lengths) / lengths
    found = jnp.where(kept, of_kept - z @ C, z)
    left = (jnp.where(kept | follows, mu, 0.0) - found) @ unit
    return (found + _least_squares(unit.T, left[:, None], kept)[:, 0]) / sizes


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
    kept: Bool[Array, " m"],
    there: Bool[Array, " m"],
    group: Sequence[bool] | np.ndarray,
    units: Float[Array, " n"] | None = None,
) -> Float[Array, " m"]:
    """The multipliers, with those of a group of rows of least norm within the group.

    Args:
        A: rows.
        lam: multipliers with that A^T lam, 0 where rows are not kept.
        kept: a largest set of independent rows, those of the group first.
        there: rows that are more than rounding.
        group: for every row, whether it belongs to the group.
        units: of the coordinates, for the comparison of rows.
    """
    chosen = np.flatnonzero(group)
    if len(chosen) < 2:
        return lam
    found = least_norm(A[chosen], lam[chosen], kept[chosen], there[chosen], units)
    return lam.at[chosen].set(found)
