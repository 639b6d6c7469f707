"""Independent columns: unknowns of A x = b that determine the others, and their solutions."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import qr

from jaxlag._linalg._refined_qr import nearest

UNSOLVED = 0.25
"""Residual over rows times solution above which there is no solution, as a power of eps. Rows that
depend on others are consistent up to the residuals of the state, which are up to eps^1/2."""


def unit_rows(A: np.ndarray) -> np.ndarray:
    """Rows of length 1, or 0."""
    size = np.linalg.norm(A, axis=1, keepdims=True)
    return A / np.where(size > 0, size, 1.0)


def rank_of(A: np.ndarray, floor: float) -> int:
    """Number of pivots above the largest one times `floor`."""
    if not A.size:
        return 0
    factors: Any = qr(A, mode="r", pivoting=True)
    pivots = np.abs(np.diagonal(factors[0]))
    return int(np.sum(pivots > floor * np.max(pivots)))


def dependent_columns(
    A: np.ndarray, floor: float, first: Sequence[int] = (), last: Sequence[int] = ()
) -> list[int]:
    """As many columns as the rank of A, as well conditioned as possible.

    Householder factorization with column pivoting (Golub, Van Loan, Matrix Computations, 4th ed.,
    sec. 5.4.2), of the columns in `first`, then of the others, and of `last` at the end.

    Args:
        A: shape (m, n), in units in which rows and columns can be compared.
        floor: least pivot over the largest one.
        first: columns that are taken first.
        last: columns that are taken only if the others do not suffice.
    """
    rank, chosen, left = rank_of(A, floor), [], A
    least = floor * np.max(np.abs(A), initial=0.0)
    others = [i for i in range(A.shape[1]) if i not in (*first, *last)]
    for group in filter(None, (list(first), others, list(last))):
        factors: Any = qr(left[:, group], mode="economic", pivoting=True)
        Q, R, order = factors
        above = int(np.sum(np.abs(np.diagonal(R)) > least))
        count = min(above, rank - len(chosen))
        chosen += [group[i] for i in order[:count]]
        left = left - Q[:, :count] @ (Q[:, :count].T @ left)
    return sorted(chosen)


def completed(
    A: Float[Array, "m n"],
    given: Float[Array, "f k"],
    right: Float[Array, "m k"],
    independent: Sequence[int],
) -> Float[Array, "n k"]:
    """The X with A X = right and `given` in its independent rows; NaN if there is none.

    Derivatives hold for redundant rows that are consistent.
    """
    free = np.array(independent, int)
    bound = np.setdiff1d(np.arange(A.shape[1]), free)
    X = jnp.zeros((A.shape[1], given.shape[1]), A.dtype).at[free].set(given)
    if bound.size:
        B, left = A[:, bound], right - A[:, free] @ given
        X = X.at[bound].set(jax.vmap(lambda b: nearest(B, b), 1, 1)(left))
    size = jnp.sum(jnp.abs(A), axis=1)[:, None] * jnp.max(jnp.abs(X), axis=0, initial=0.0)
    off = jnp.abs(A @ X - right)
    solved = jnp.all(off <= float(jnp.finfo(A.dtype).eps) ** UNSOLVED * (size + jnp.abs(right)))
    return jnp.where(solved, X, jnp.nan)
