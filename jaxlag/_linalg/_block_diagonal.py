"""Symmetric matrices that consist of diagonal blocks, each factored by itself."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from jaxlag._linalg._mass_solve import MassFactor, eliminate, factor_mass


@dataclass(frozen=True, eq=False)
class Blocks:
    """Which coordinates form a block; blocks are padded to one size s.

    Attributes:
        members: coordinates of every block, shape (k, s); n where there is none.
        place: place of every coordinate among all members, shape (n,).
    """

    members: np.ndarray
    place: np.ndarray

    @property
    def count(self) -> int:
        """Number k of blocks."""
        return self.members.shape[0]

    @property
    def size(self) -> int:
        """The largest number s of coordinates in a block."""
        return self.members.shape[1]

    @property
    def absent(self) -> np.ndarray:
        """Which members are no coordinates, shape (k, s)."""
        return self.members == self.place.size

    def split(self, x: Float[Array, " n"]) -> Float[Array, "k s"]:
        """The parts of a vector, with zeros where there is no coordinate."""
        return padded(x)[self.members]

    def join(self, x: Float[Array, "k s"]) -> Float[Array, " n"]:
        """Inverse of `split`."""
        return x.reshape(-1)[self.place]


def blocks_of(pattern: csr_array) -> Blocks:
    """The blocks of a symmetric pattern, shape (n, n): connected components of its graph."""
    n, _ = shape_of(pattern)
    count, label = connected_components(pattern, directed=False)
    order, sizes = np.argsort(label, kind="stable"), np.bincount(label, minlength=count)
    slot = np.empty(n, int)
    slot[order] = np.arange(n) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    members = np.full((count, sizes.max()), n)
    members[label, slot] = np.arange(n)
    return Blocks(members, label * members.shape[1] + slot)


class BlockDiagonal(eqx.Module):
    """A matrix by its blocks.

    Attributes:
        blocks: their coordinates.
        entries: of the blocks, shape (k, s, s); 1 on the diagonal where there is no coordinate.
    """

    blocks: Blocks = eqx.field(static=True)
    entries: Float[Array, "k s s"]

    def times(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """M x."""
        return self.blocks.join(jnp.sum(self.entries * self.blocks.split(x)[:, None, :], axis=-1))


def factor_blocks(M: BlockDiagonal) -> MassFactor:
    """The factors of all blocks, without derivatives."""
    return jax.vmap(factor_mass)(jax.lax.stop_gradient(M.entries))


def solve_blocks(
    M: BlockDiagonal, r: Float[Array, " n"], factor: MassFactor | None = None
) -> Float[Array, " n"]:
    """The x with M x = r; NaN if M is not positive definite.

    Derivatives reuse the factor: dx = M^-1 (dr - dM x).

    Args:
        M: symmetric positive definite.
        r: right-hand side.
        factor: `factor_blocks(M)` if it exists already.
    """
    factor = jax.lax.stop_gradient(factor_blocks(M) if factor is None else factor)

    def solve(_: object, r: Array) -> Array:
        return M.blocks.join(jax.vmap(eliminate)(factor, M.blocks.split(r)))

    x = jax.lax.custom_linear_solve(M.times, r, solve, symmetric=True)
    return jnp.where(jnp.all(factor.healthy), x, jnp.nan)


def shape_of(pattern: csr_array) -> tuple[int, int]:
    """(rows, columns)."""
    shape: Any = pattern.shape
    return shape


def padded(x: Array) -> Array:
    """With a zero after the last entry."""
    return jnp.concatenate([x, jnp.zeros((1, *x.shape[1:]), x.dtype)])
