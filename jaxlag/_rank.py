"""Which constraint rows are independent, and how rows that are not share what they exert."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlag._kkt import augmented
from jaxlag._linalg import eliminate, factor_mass, rank_floor

ROUNDINGS = 16
"""Of the coordinates: a row that they make is none."""


class Choice(NamedTuple):
    """Rows to solve with.

    Attributes:
        kept: a largest set of independent ones; the others follow from them.
        there: those that are more than rounding.
    """

    kept: Bool[Array, " m"]
    there: Bool[Array, " m"]


def row_sizes(
    rows: Callable[[Array], Array], q: Float[Array, " n"], A: Float[Array, "m n"]
) -> tuple[Bool[Array, " m"], Float[Array, " m"]]:
    """(whether rows are more than rounding, their lengths, or how fast they grow where not).

    At a dead point, where rows vanish, sin(pi) leaves 1e-16 of them, of no meaning whatever: what
    a few roundings of the coordinates change.

    Args:
        rows: A as a function of q.
        q: coordinates.
        A: rows(q).
    """
    eps, at = float(jnp.finfo(q.dtype).eps), np.arange(q.shape[0])
    small = eps**0.25
    signs = jnp.asarray([(-1.0) ** at, (-1.0) ** (at // 2)], q.dtype)
    ways = jnp.concatenate([ROUNDINGS * eps * signs * jnp.abs(q), small * signs])
    changes = jax.lax.stop_gradient(jax.vmap(rows)(q + ways) - A)
    rounding, growth = jnp.max(_lengths(changes).reshape(2, 2, -1), axis=1)
    growth = growth / small
    norms = _lengths(A)
    # What is not known, as derivatives beside the end of a domain, speaks for the row.
    there = (norms > 0) & ~(norms <= rounding)
    size = jnp.where(there, norms, growth)
    return there, jnp.where(size > 0, size, 1.0)


def _lengths(A: Float[Array, "*k m n"]) -> Float[Array, "*k m"]:
    """Lengths of rows; derivatives of those that vanish are 0."""
    square = jnp.sum(A**2, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def rows_hold(
    A: Float[Array, "m n"],
    x: Float[Array, " n"],
    c: Float[Array, " m"],
    size: Float[Array, " m"],
    v: Float[Array, " n"],
) -> Bool[Array, ""]:
    """Whether A x + c = 0 for all rows, those that were left out included.

    Up to what the angle may be below which a row counts as dependent.

    Args:
        A: rows.
        x: an acceleration that some of them have been solved for.
        c: gamma.
        size: of the rows, see `row_sizes`.
        v: velocities, whose squares make gamma.
    """
    eps = float(jnp.finfo(A.dtype).eps)
    scale = jnp.max(jnp.abs(x)) + jnp.max(jnp.abs(c) / size)
    allowed = rank_floor(A.dtype) ** 0.5 * scale + 1e3 * eps * (1.0 + jnp.sum(v**2))
    return jnp.all(jnp.abs(A @ x + c) <= allowed * size)


def independent_rows(
    M: Float[Array, "n n"],
    A: Float[Array, "m n"],
    turn: Sequence[int] | np.ndarray | None = None,
    floor: float | None = None,
    there: Bool[Array, " m"] | None = None,
) -> Bool[Array, " m"]:
    """A largest set of rows that are independent of one another, found greedily.

    Cholesky with the largest pivot first of A (M + A^T W A)^-1 A^T, rows scaled to 1: a pivot is
    the squared sine of the angle between a row and those chosen before it. Of equal ones the
    first is taken.

    Args:
        M: symmetric, positive definite where A x = 0.
        A: rows.
        turn: for every row, when it is to be taken: before all rows of a higher number; None for
            all at once.
        floor: least pivot; by default `rank_floor`.
        there: rows that are not taken for zero; by default those that are not.

    Source: Golub, Van Loan, Matrix Computations, sec. 4.2.8.
    """
    m = A.shape[0]
    norms = jnp.sqrt(jnp.sum(A**2, axis=1))
    floor = rank_floor(A.dtype) if floor is None else floor
    nonzero = norms > 0
    usable = nonzero if there is None else nonzero & there
    if m == 1:  # nothing to depend on
        return usable
    A = A / jnp.where(usable, norms, 1.0)[:, None]
    mass = factor_mass(augmented(M, A)[0])
    S = A @ jax.vmap(lambda row: eliminate(mass, row))(A).T
    pivots = jnp.diagonal(S)
    usable = usable & (pivots > 0)
    scale = jax.lax.rsqrt(jnp.where(usable, pivots, 1.0))
    S = scale[:, None] * S * scale
    turns = np.zeros(m, int) if turn is None else np.asarray(turn, int)

    def choose(_: Int[Array, ""], state: tuple[Array, Array]) -> tuple[Array, Array]:
        S, kept = state
        left = jnp.where(kept | ~usable, -1.0, jnp.diagonal(S))
        now = jnp.min(jnp.where(left > floor, turns, np.max(turns, initial=0)))
        left = jnp.where(turns > now, -1.0, left)
        k = jnp.argmax(left > 0.999 * jnp.max(left))  # the first of nearly equal ones
        take = left[k] > floor
        reduced = S - jnp.outer(S[:, k], S[k]) / jnp.where(take, S[k, k], 1.0)
        return jnp.where(take, reduced, S), kept.at[k].set(kept[k] | take)

    return jax.lax.fori_loop(0, m, choose, (S, jnp.zeros((m,), bool)))[1]


def least_norm(
    A: Float[Array, "m n"],
    lam: Float[Array, " m"],
    kept: Bool[Array, " m"] | None = None,
    there: Bool[Array, " m"] | None = None,
) -> Float[Array, " m"]:
    """The multipliers with the same A^T lam of least norm sum_k (|A_k| lam_k)^2.

    |A_k lam_k| is the generalized force of row k alone, so that the choice does not depend on
    how a residual is scaled. With C the rows in terms of those that are kept, A = C A_kept,
    lam = C (C^T C)^-1 lam_kept: the same where none is left out. Rows that do not follow from
    those that are kept have none. Derivatives are those at constant rank of A.

    Args:
        A: rows.
        lam: multipliers with that A^T lam.
        kept: a largest set of independent rows; by default it is looked for.
        there: rows that are more than rounding, see `row_sizes`; by default those that are not 0.

    Source: Golub, Pereyra, SIAM J. Numer. Anal. 10 (1973) 413 (pseudo-inverse at constant rank).
    """
    m, n = A.shape
    if m == 1:
        return lam
    if kept is None:
        kept = independent_rows(jnp.eye(n, dtype=A.dtype), jax.lax.stop_gradient(A))
    if there is not None:
        A = jnp.where(there[:, None], A, 0.0)
    norms = _lengths(A)
    norms = jnp.where(norms > 0, norms, 1.0)
    unit = A / norms[:, None]
    gram, one = unit @ unit.T, jnp.eye(m, dtype=A.dtype)
    among = jnp.where(jnp.outer(kept, kept), gram, one)
    C = jnp.linalg.solve(among, jnp.where(kept[:, None], gram, 0.0)).T
    apart = jnp.sum((unit - C @ unit) ** 2, axis=1)
    C = jnp.where((apart <= rank_floor(A.dtype))[:, None], C, 0.0)
    C = jnp.where(kept[:, None], jnp.where(kept, one, 0.0), C)
    # What all rows do, by those that are kept: with C^T, for lam may be on any of them.
    of_kept = C.T @ (norms * lam)
    square = C.T @ C + jnp.where(kept, 0.0, one)
    return (C @ jnp.linalg.solve(square, of_kept)) / norms


def shared(
    A: Float[Array, "m n"],
    lam: Float[Array, " m"],
    kept: Bool[Array, " m"],
    there: Bool[Array, " m"],
    group: Sequence[bool] | np.ndarray,
) -> Float[Array, " m"]:
    """The multipliers with those of a group of rows of least norm among themselves.

    Args:
        A: rows.
        lam: multipliers with that A^T lam, 0 where rows are not kept.
        kept: a largest set of independent rows, first of those of the group.
        there: rows that are more than rounding.
        group: for every row, whether it belongs to the group.
    """
    chosen = np.flatnonzero(group)
    if len(chosen) < 2:
        return lam
    found = least_norm(*(x[chosen] for x in (A, lam, kept, there)))
    return lam.at[chosen].set(found)
