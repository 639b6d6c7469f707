"""Sparse KKT systems, M x - A^T lam = r, A x + c = 0: M in small blocks, A with few entries a row.

M is factored block by block. A block may be singular if holonomic rows that meet no other block, as
that of a quaternion's length, make it definite: M + A^T W A with these rows is factored. The Schur
complement S = A (M + A^T W A)^-1 A^T is banded in the order of Cuthill and McKee. A solve takes a
time proportional to the number of coordinates if the bandwidth is that of a chain.

Source: Golub, Van Loan, Matrix Computations, 4th ed., sec. 11.1 (orderings); Benzi, Golub, Liesen,
Acta Numerica 14 (2005) 1, sec. 5 (Schur complement).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxlag._linalg._banded import BandFactor, banded_pivots, factor_banded
from jaxlag._linalg._block_diagonal import BlockDiagonal, Blocks, factor_blocks, padded, shape_of
from jaxlag._linalg._kkt import row_weights
from jaxlag._linalg._mass_solve import MassFactor, eliminate, rank_floor


@dataclass(frozen=True, eq=False)
class Rows:
    """Which blocks of M the rows of A meet, and the band of S.

    Attributes:
        met: for every row the blocks that it meets, shape (m, r); k where there is none.
        of_block: for every block the entries of `met` that name it; m r where there is none.
        inside: for every block the holonomic rows that meet no other one; m where there is none.
        order: rows in the order of S, shape (m,).
        position: of every row in that order, shape (m,).
        products: pairs of entries of `met` whose products add up to S_(k+i, k), i = 0 to w, shape
            (2, m, w + 1, p); m r where there is none.
    """

    met: np.ndarray
    of_block: np.ndarray
    inside: np.ndarray
    order: np.ndarray
    position: np.ndarray
    products: np.ndarray

    @property
    def count(self) -> int:
        """Number m of rows."""
        return self.met.shape[0]

    @property
    def width(self) -> int:
        """The half bandwidth w of S."""
        return self.products.shape[2] - 1

    @property
    def is_inside(self) -> np.ndarray:
        """Whether a row is among those inside of one block, shape (m,)."""
        return np.isin(np.arange(self.count), self.inside)

    @property
    def known(self) -> np.ndarray:
        """As `met`, with any block where there is none: entries of A are 0 there."""
        return np.minimum(self.met, len(self.of_block) - 1)


def half_bandwidth(blocks: Blocks, pattern: csr_array) -> tuple[int, np.ndarray]:
    """(w, order of the rows): of S for rows of a pattern, shape (m, n), of A.

    The rows that meet one block bound w from below; if they are more than half of all, they are
    not ordered.
    """
    meets = _meets(blocks, pattern)
    m, _ = shape_of(pattern)
    least = int(np.max(np.diff(csr_array(meets.T).indptr))) - 1
    if 2 * least > m:
        return least, np.arange(m)
    coupled = csr_array((meets @ meets.T).astype(bool))
    order = np.asarray(reverse_cuthill_mckee(coupled, symmetric_mode=True), int)
    position = np.argsort(order)
    first, second = coupled.nonzero()
    return max(1, int(np.max(np.abs(position[first] - position[second]), initial=0))), order


def _meets(blocks: Blocks, pattern: csr_array) -> csr_array:
    """Which blocks the rows meet, shape (m, k)."""
    n, k = blocks.place.size, blocks.count
    of = csr_array((np.ones(n, bool), (np.arange(n), blocks.place // blocks.size)), shape=(n, k))
    meets = csr_array((pattern @ of).astype(bool))
    meets.sort_indices()
    return meets


def rows_of(blocks: Blocks, pattern: csr_array, holonomic: np.ndarray) -> Rows:
    """The rows of a pattern, shape (m, n), of A.

    Args:
        blocks: of M.
        pattern: of A.
        holonomic: for every row whether it is holonomic.
    """
    (m, _), k = shape_of(pattern), blocks.count
    meets = _meets(blocks, pattern)
    met = _lists(meets, k)
    entry = {
        (row, block): row * met.shape[1] + slot
        for row, listed in enumerate(met.tolist())
        for slot, block in enumerate(listed)
        if block < k
    }
    of_block = _lists(csr_array(meets.T), m)
    for block, listed in enumerate(of_block):
        of_block[block] = [entry.get((row, block), met.size) for row in listed.tolist()]
    alone = np.flatnonzero((np.diff(meets.indptr) == 1) & holonomic)
    inside = csr_array((np.ones(alone.size, bool), (met[alone, 0], alone)), shape=(k, m))
    width, order = half_bandwidth(blocks, pattern)
    sets = [{block for block in listed if block < k} for listed in met.tolist()]
    pairs = [
        [(entry[i, block], entry[j, block]) for block in sets[i] & sets[j]] if i is not None else []
        for at, j in enumerate(order.tolist())
        for i in [*order[at : at + width + 1].tolist(), *[None] * (width + 1 + at - m)]
    ]
    products = np.full((len(pairs), max(map(len, pairs), default=0), 2), met.size)
    for place, listed in enumerate(pairs):
        products[place, : len(listed)] = np.reshape(listed, (-1, 2))
    products = np.moveaxis(products, 2, 0).reshape(2, m, width + 1, -1)
    return Rows(met, of_block, _lists(inside, m), order, np.argsort(order), products)


def _lists(pattern: csr_array, missing: int) -> np.ndarray:
    """The columns of every row, in one array filled with `missing`."""
    counts = np.diff(pattern.indptr)
    lists = np.full((counts.size, counts.max(initial=0)), missing)
    for row, (start, count) in enumerate(zip(pattern.indptr[:-1], counts, strict=True)):
        lists[row, :count] = pattern.indices[start : start + count]
    return lists


class SparseKkt(eqx.Module):
    """M and A by their entries.

    Attributes:
        mass: M.
        rows: which blocks the rows meet.
        A: entries of every row in the blocks that it meets, shape (m, r, s).
    """

    mass: BlockDiagonal
    rows: Rows = eqx.field(static=True)
    A: Float[Array, "m r s"]

    def masked(self, active_rows: Bool[Array, " m"] | None) -> "SparseKkt":
        """With zeros for rows that are not active."""
        if active_rows is None:
            return self
        return replace(self, A=jnp.where(active_rows[:, None, None], self.A, 0.0))

    def times(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """A x."""
        return self.of_parts(self.mass.blocks.split(x))

    def of_parts(self, x: Float[Array, "k s"]) -> Float[Array, " m"]:
        """A x, from the parts of x."""
        return jnp.sum(self.A * x[self.rows.known], axis=(1, 2))

    def loads(self, lam: Float[Array, " m"]) -> Float[Array, "k s"]:
        """The parts of A^T lam."""
        entries = (self.A * lam[:, None, None]).reshape(-1, self.mass.blocks.size)
        return jnp.sum(padded(entries)[self.rows.of_block], axis=1)

    def units(self) -> Float[Array, " n"]:
        """1 / sqrt of the inertia of every coordinate; of A^T W A if M has none."""
        inertias = jnp.sum(jnp.where(np.eye(self.mass.blocks.size), self.mass.entries, 0.0), axis=2)
        here = jax.vmap(lambda M, a: row_weights(jnp.diag(M.reshape(-1)), a.reshape(1, -1))[0])
        squares = replace(self, A=self.A**2).loads(here(inertias[self.rows.known], self.A))
        inertias = jnp.where(inertias > 0, inertias, squares)
        return self.mass.blocks.join(jax.lax.rsqrt(jnp.where(inertias > 0, inertias, 1.0)))

    def bands(
        self, A: Array, spread: Array, active_rows: Bool[Array, " m"] | None
    ) -> tuple[Float[Array, "m w_1"], Float[Array, "m w_1"]]:
        """The lower band of the products of rows A with rows `spread`, and the upper one."""
        rows, size = self.rows, self.mass.blocks.size
        left, right = (padded(x.reshape(-1, size)) for x in (A, spread))
        below, above = rows.products

        def band(of_left: np.ndarray, of_right: np.ndarray) -> Array:
            found = jnp.sum(left[of_left] * right[of_right], axis=(-2, -1))
            if active_rows is None:
                return found
            own = jnp.where(active_rows[rows.order], found[:, 0], 1.0)
            return jnp.concatenate([own[:, None], found[:, 1:]], axis=1)

        return band(below, above), band(above, below)

    def augmented(self) -> tuple[BlockDiagonal, Float[Array, " m"]]:
        """(M + A^T W A by the rows inside of one block, W, which is 0 for the others)."""
        rows, blocks = self.rows, self.mass.entries
        own = jax.vmap(row_weights)(blocks[rows.known[:, 0]], self.A[:, :1])[:, 0]
        weights = jnp.where(rows.is_inside, own, 0.0)
        a, w = padded(self.A[:, 0])[rows.inside], padded(weights)[rows.inside]
        added = jnp.sum((w[:, :, None] * a)[:, :, :, None] * a[:, :, None, :], axis=1)
        return replace(self.mass, entries=blocks + added), weights


class SparseFactor(NamedTuple):
    """Factors of M and S.

    Attributes:
        kkt: M and A without derivatives, 0 for rows that are not active.
        mass: factors of the blocks of M, or of M + A^T W A.
        weights: the diagonal of W; None if M is regular.
        schur: factors of S with rows of length 1.
        scale: factors of the rows.
        spread: entries of (M + A^T W A)^-1 A^T, as those of A.
    """

    kkt: SparseKkt
    mass: MassFactor
    weights: Float[Array, " m"] | None
    schur: BandFactor
    scale: Float[Array, " m"]
    spread: Float[Array, "m r s"]

    def solve(
        self, r: Float[Array, " n"], c: Float[Array, " m"]
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """(x, lam)."""
        blocks, load = self.kkt.mass.blocks, self.kkt.mass.blocks.split(r)
        if self.weights is not None:
            load = load - self.kkt.loads(self.weights * c)
        free = self._by_mass(load)
        lam = -self._by_schur(c + self.kkt.of_parts(free))
        return blocks.join(free + self._by_mass(self.kkt.loads(lam))), lam

    def masses(self) -> Float[Array, " m"]:
        """The diagonal of S^-1."""
        return self.scale**2 * self.schur.diagonal_of_inverse()[self.kkt.rows.position]

    def keeps_sense(
        self, later: SparseKkt, active_rows: Bool[Array, " m"] | None
    ) -> Bool[Array, ""]:
        """Whether the pivots of A' M^-1 A^T, with rows A' elsewhere, are positive as those of S."""
        lower, upper = self.kkt.bands(later.masked(active_rows).A, self.spread, active_rows)
        return jnp.all(banded_pivots(lower, upper) > 0)

    @property
    def healthy(self) -> Bool[Array, ""]:
        """Whether all pivots are positive to working precision."""
        return jnp.all(self.mass.healthy) & jnp.all(self.schur.healthy)

    def _by_mass(self, r: Float[Array, "k s"]) -> Float[Array, "k s"]:
        return jax.vmap(eliminate)(self.mass, r)

    def _by_schur(self, c: Float[Array, " m"]) -> Float[Array, " m"]:
        rows = self.kkt.rows
        return self.scale * self.schur.solve((self.scale * c)[rows.order])[rows.position]


def factor_sparse(
    kkt: SparseKkt,
    active_rows: Bool[Array, " m"] | None,
    regular: bool,
    crossing: bool = False,
    mass: MassFactor | None = None,
) -> SparseFactor:
    """Factor once, for any number of right-hand sides; without derivatives.

    Args:
        kkt: the matrices.
        active_rows: rows to solve with; None for all.
        regular: whether M is known to be positive definite by itself.
        crossing: whether rows that depend on those eliminated before them are left out; otherwise
            they are unhealthy.
        mass: `factor_blocks` of a regular M if it exists already.
    """
    kkt = jax.lax.stop_gradient(kkt).masked(active_rows)
    A, rows, weights = kkt.A, kkt.rows, None
    if not regular:
        inertia, weights = kkt.augmented()
        mass = factor_blocks(inertia)
    elif mass is None:
        mass = factor_blocks(kkt.mass)
    spread = jax.vmap(jax.vmap(eliminate))(jax.tree.map(lambda x: x[rows.known], mass), A)
    squares = jnp.sum(A * spread, axis=(1, 2))
    scale = jax.lax.rsqrt(jnp.where(squares > 0, squares, 1.0))
    unit = scale[:, None, None]
    band, _ = kkt.bands(unit * A, unit * spread, active_rows)
    schur = factor_banded(band, rank_floor(A.dtype), crossing)
    return SparseFactor(kkt, mass, weights, schur, scale, spread)


def solve_sparse(
    kkt: SparseKkt,
    r: Float[Array, " n"],
    c: Float[Array, " m"],
    factor: SparseFactor,
    active_rows: Bool[Array, " m"] | None = None,
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """(x, lam) with M x = r + A^T lam, A x + c = 0; NaN if there is no solution.

    Derivatives reuse the factor; they hold for a constant set of active rows.

    Args:
        kkt: the matrices.
        r: right-hand side.
        c: right-hand side of the rows.
        factor: `factor_sparse` of the same.
        active_rows: rows to solve with; None for all.
    """
    factor, n, kkt = jax.lax.stop_gradient(factor), r.shape[0], kkt.masked(active_rows)
    if active_rows is not None:
        c = jnp.where(active_rows, c, 0.0)

    def bordered(z: Array) -> Array:
        x, lam = z[:n], z[n:]
        below = -kkt.times(x)
        below = below if active_rows is None else jnp.where(active_rows, below, -lam)
        return jnp.concatenate([kkt.mass.times(x) - kkt.mass.blocks.join(kkt.loads(lam)), below])

    def solve(_: object, right: Array) -> Array:
        return jnp.concatenate(factor.solve(right[:n], right[n:]))

    # One vector: pairs could contain symbolic zeros, which JAX's rule does not accept.
    z = jax.lax.custom_linear_solve(bordered, jnp.concatenate([r, c]), solve, symmetric=True)
    z = jnp.where(factor.healthy, z, jnp.nan)
    return z[:n], z[n:]
