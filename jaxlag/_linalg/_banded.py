"""Banded matrices, symmetric and positive definite: S = L D L^T column by column.

A solve takes a time proportional to the number of unknowns. Every pass is one loop, whose code
does not grow with the matrix.

Source: Golub, Van Loan, Matrix Computations, 4th ed., sec. 4.3.5 (band Cholesky).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class BandFactor(NamedTuple):
    """The factors of a matrix of half bandwidth w.

    Attributes:
        pivots: diagonal of D.
        below: entries of L below the diagonal, by columns: `below[k, i]` is L_(k+i+1, k).
        healthy: whether each pivot is positive to working precision.
    """

    pivots: Float[Array, " m"]
    below: Float[Array, "m w"]
    healthy: Bool[Array, " m"]

    def solve(self, c: Float[Array, " m"]) -> Float[Array, " m"]:
        """The x with S x = c."""

        def down(ahead: Array, column: tuple) -> tuple[Array, Array]:
            b, below = column
            z = b + ahead[0]
            return _shifted(ahead) - z * below, z

        def up(after: Array, column: tuple) -> tuple[Array, Array]:
            z, pivot, below = column
            x = z / pivot - jnp.sum(below * after)
            return jnp.concatenate([x[None], after[:-1]]), x

        none = jnp.zeros_like(self.below[0])
        _, z = jax.lax.scan(down, none, (c, self.below))
        return jax.lax.scan(up, none, (z, self.pivots, self.below), reverse=True)[1]

    def diagonal_of_inverse(self) -> Float[Array, " m"]:
        """The diagonal of S^-1, by the entries of S^-1 within the band.

        Source: Takahashi, Fagan, Chen, Proc. PICA (1973) 63.
        """

        def up(after: Array, column: tuple) -> tuple[Array, Array]:
            pivot, below = column
            across = -jnp.sum(after * below[None], axis=1)
            own = 1.0 / pivot - jnp.sum(across * below)
            first = jnp.concatenate([own[None], across[:-1]])
            rest = jnp.concatenate([across[:-1, None], after[:-1, :-1]], axis=1)
            return jnp.concatenate([first[None], rest]), own

        w = self.below.shape[1]
        none = jnp.zeros((w, w), self.below.dtype)
        return jax.lax.scan(up, none, (self.pivots, self.below), reverse=True)[1]


def factor_banded(
    columns: Float[Array, "m w_1"], floor: float, crossing: bool = False
) -> BandFactor:
    """Factor S once; `healthy` is whether each pivot exceeds the floor.

    Args:
        columns: the lower band, shape (m, w + 1): `columns[k, i]` is S_(k+i, k), 0 beyond the end.
            Entries on the diagonal are about 1.
        floor: least pivot.
        crossing: whether a pivot that is too small is set to infinity, so that its unknown is 0.
    """

    def one(ahead: Array, column: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        column = column + jnp.concatenate([ahead[0], jnp.zeros_like(column[:1])])
        pivot, below = column[0], column[1:]
        if crossing:
            pivot = jnp.where(pivot <= floor, jnp.inf, pivot)
        fine, ratio = pivot > floor, below / pivot
        rest = jnp.pad(ahead[1:, 1:], ((0, 1), (0, 1)))
        return rest - ratio[:, None] * below[None], (pivot, ratio, fine)

    w = columns.shape[1] - 1
    return BandFactor(*jax.lax.scan(one, jnp.zeros((w, w), columns.dtype), columns)[1])


def banded_pivots(lower: Float[Array, "m w_1"], upper: Float[Array, "m w_1"]) -> Float[Array, " m"]:
    """The pivots of a matrix that is not symmetric, by LU factorization without pivoting.

    Args:
        lower: `lower[k, i]` is B_(k+i, k), 0 beyond the end.
        upper: `upper[k, i]` is B_(k, k+i).
    """

    def one(ahead: Array, column: tuple[Array, Array]) -> tuple[Array, Array]:
        beyond = jnp.zeros_like(ahead[0, :1])
        below = column[0] + jnp.concatenate([ahead[:, 0], beyond])
        right = column[1] + jnp.concatenate([ahead[0], beyond])
        pivot, rest = right[0], jnp.pad(ahead[1:, 1:], ((0, 1), (0, 1)))
        return rest - (below[1:] / pivot)[:, None] * right[None, 1:], pivot

    w = lower.shape[1] - 1
    return jax.lax.scan(one, jnp.zeros((w, w), lower.dtype), (lower, upper))[1]


def _shifted(x: Array) -> Array:
    return jnp.concatenate([x[1:], jnp.zeros_like(x[:1])])
