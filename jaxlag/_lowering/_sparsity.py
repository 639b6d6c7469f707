"""Sparsity of M and A, from the traced program, and their entries from few derivatives."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array, eye_array

from jaxlag._linalg._block_diagonal import BlockDiagonal, Blocks, blocks_of, shape_of
from jaxlag._linalg._mass_solve import known_definite
from jaxlag._linalg._sparse_kkt import Rows, SparseKkt, half_bandwidth, rows_of
from jaxlag._lowering._jaxpr._element_dependence import element_dependence
from jaxlag._tracing._interpret import interpret

# Times as large as its blocks M must be, and A as the half bandwidth w of S. Microseconds of an
# evaluation, sparse | whole matrices: net of 5 x 5 masses in space (40 rows, w = 10) 23 | 3,100;
# of 12 x 12 (264 rows, w = 24) 177 | 9,600; 6 bodies with quaternions (24 rows, w = 6) 11 | 38.
SMALLER = 4
ROWS_MORE = 2
STATES = 2  # random states for the comparison of products


@dataclass(frozen=True, eq=False)
class Compressed:
    """Entries of a Jacobian that are read from few directional derivatives.

    Columns (or rows) without a common entry form a group, of which one derivative is taken.

    Attributes:
        seeds: one direction for each group, shape (groups, columns or rows).
        of_rows: whether groups are rows, of which reverse derivatives are taken.
        places: of every wanted entry, in the derivatives, flat; their number where it is 0.

    Source: Curtis, Powell, Reid, IMA J. Appl. Math. 13 (1974) 117.
    """

    seeds: np.ndarray
    of_rows: bool
    places: np.ndarray

    def entries(self, function: Callable, x: Array) -> Array:
        """The wanted entries of the Jacobian of a function at x, of the shape of `places`."""
        seeds = jnp.asarray(self.seeds, x.dtype)
        if self.of_rows:
            pull = jax.vjp(function, x)[1]
            found = jax.vmap(lambda e: pull(e)[0])(seeds)
        else:
            found = jax.vmap(lambda e: jax.jvp(function, (x,), (e,))[1])(seeds)
        return jnp.concatenate([found.reshape(-1), jnp.zeros((1,), x.dtype)])[self.places]


def compressed(pattern: csr_array, rows: np.ndarray, columns: np.ndarray) -> Compressed:
    """How to read the entries (rows, columns) of a Jacobian with this pattern.

    Args:
        pattern: shape (m, n).
        rows: of the wanted entries.
        columns: of the same shape; an entry outside of the matrix or of the pattern is 0.
    """
    m, n = shape_of(pattern)
    by_columns, by_rows = _groups(pattern), _groups(csr_array(pattern.T))
    of_rows = by_rows.max(initial=0) < by_columns.max(initial=0)
    group = by_rows if of_rows else by_columns
    seeds = np.zeros((group.max(initial=-1) + 1, group.size))
    seeds[group, np.arange(group.size)] = 1.0
    inside = (rows < m) & (columns < n)
    row, column = np.where(inside, rows, 0), np.where(inside, columns, 0)
    present = inside & np.isin(row * n + column, _keys(pattern))
    length = n if of_rows else m
    places = group[row] * length + column if of_rows else group[column] * length + row
    return Compressed(seeds, bool(of_rows), np.where(present, places, len(seeds) * length))


def _keys(pattern: csr_array) -> np.ndarray:
    row, column = pattern.nonzero()
    return np.asarray(row, int) * shape_of(pattern)[1] + column


def _groups(pattern: csr_array) -> np.ndarray:
    """A number for every column: columns of one number have no row in common. Greedy."""
    conflicts = csr_array((pattern.T.astype(np.int32) @ pattern.astype(np.int32)).astype(bool))
    group = np.full(shape_of(pattern)[1], -1)
    for j in range(group.size):
        near = group[conflicts.indices[conflicts.indptr[j] : conflicts.indptr[j + 1]]]
        taken = set(near.tolist())
        group[j] = next(g for g in range(len(taken) + 1) if g not in taken)
    return group


def jacobian_pattern(function: Callable, x: Any, *others: Any) -> csr_array:
    """Entries of d function/dx that may differ from zero, shape (results, elements of x).

    Args:
        function: of x and others, with one array as result.
        x: shape and dtype of an array.
        others: shapes and dtypes.
    """
    program = jax.make_jaxpr(function)(x, *others)
    given = [csr_array(eye_array(x.size, dtype=bool)), *(None for _ in jax.tree.leaves(others))]
    (found,) = element_dependence(program, given, x.size)
    return found


@dataclass(frozen=True, eq=False)
class Sparsity:
    """Which entries of M and A may differ from zero, and how they are read.

    Attributes:
        blocks: of M.
        of_mass: reads their entries.
        constrained: the rows of A; None without constraints.
    """

    blocks: Blocks
    of_mass: Compressed
    constrained: "SparseRows | None" = None

    def mass(self, momentum: Callable, v: Float[Array, " n"]) -> BlockDiagonal:
        """M.

        Args:
            momentum: p as a function of v.
            v: velocities.
        """
        own = np.eye(self.blocks.size, dtype=bool) & self.blocks.absent[:, :, None]
        entries = jnp.where(own, 1.0, self.of_mass.entries(momentum, v))
        return BlockDiagonal(self.blocks, entries)


@dataclass(frozen=True, eq=False)
class SparseRows:
    """The same of A.

    Attributes:
        rows: which blocks of M they meet.
        entries: reads their entries there.
        holonomic: the holonomic rows alone and their indices, if there are others.
    """

    rows: Rows
    of_rows: Compressed
    holonomic: tuple[Rows, np.ndarray] | None

    def kkt(self, mass: BlockDiagonal, velocity: Callable, v: Float[Array, " n"]) -> SparseKkt:
        """M and A.

        Args:
            mass: M.
            velocity: A v + b as a function of v.
            v: velocities.
        """
        return SparseKkt(mass, self.rows, self.of_rows.entries(velocity, v))


def sparsity_of(
    blocks: Blocks,
    pattern: csr_array,
    rows: csr_array | None = None,
    holonomic: Sequence[bool] = (),
) -> Sparsity:
    """From the patterns of M and A.

    Args:
        blocks: of M.
        pattern: of M, symmetric, shape (n, n).
        rows: shape (m, n); None without constraints.
        holonomic: for every row whether it is holonomic.
    """
    row = np.broadcast_to(blocks.members[:, :, None], (*blocks.members.shape, blocks.size))
    of_mass = compressed(pattern, row, blocks.members[:, None, :] + 0 * row)
    if rows is None:
        return Sparsity(blocks, of_mass)
    every = rows_of(blocks, rows, np.array(holonomic))
    nowhere = np.full((1, blocks.size), blocks.place.size)
    columns = np.concatenate([blocks.members, nowhere])[every.met]
    of_rows = compressed(rows, np.arange(every.count)[:, None, None] + 0 * columns, columns)
    chosen, part = np.flatnonzero(holonomic), None
    if 0 < chosen.size < every.count:
        part = rows_of(blocks, csr_array(rows[chosen]), np.ones(chosen.size, bool)), chosen
    return Sparsity(blocks, of_mass, SparseRows(every, of_rows, part))


class SparsityFound(NamedTuple):
    """The sparsity of a system.

    Attributes:
        sparsity: of M and A; None if solves use whole matrices.
        reason: why they do, as text.
        definite: whether blocks of M, with the rows inside of them, are positive definite for
            random params.
    """

    sparsity: Sparsity | None
    reason: str = ""
    definite: bool = False


def search_sparsity(
    momentum: Callable, velocity: Callable | None, holonomic: Sequence[bool], given: tuple
) -> SparsityFound:
    """The sparsity of M = dp/dv and A = d(A v + b)/dv, if solves with it are shorter.

    Args:
        momentum: p(v, t, q, params).
        velocity: A v + b of the same; None without constraints.
        holonomic: for every row whether it is holonomic.
        given: shapes and dtypes of the arguments.
    """
    mass = jacobian_pattern(momentum, *given)
    mass = csr_array(mass + mass.T)
    blocks, size = blocks_of(mass), given[0].size
    if SMALLER * blocks.size > size:
        return SparsityFound(None, f"a block of M has {blocks.size} of {size} coordinates")
    rows = None
    if velocity is not None:
        rows = jacobian_pattern(velocity, *given)
        if not rows.nnz:
            return SparsityFound(None, "no row depends on v")
        width, count = half_bandwidth(blocks, rows)[0], len(holonomic)
        if ROWS_MORE * width > count:
            reason = f"A M^-1 A^T of {count} rows has a half bandwidth of {width} or more"
            return SparsityFound(None, reason)
    found, definite = sparsity_of(blocks, mass, rows, holonomic), True
    for products, inertia in _samples(found, momentum, velocity, given):
        if not all(_equal(*pair) for pair in products):
            reason = "products with the entries are not directional derivatives for random params"
            return SparsityFound(None, reason)
        definite = definite and known_definite(inertia, given[0].dtype)
    return SparsityFound(found, definite=definite)


def _samples(
    found: Sparsity, momentum: Callable, velocity: Callable | None, given: tuple
) -> Iterator[tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]]:
    """Pairs of products with the entries and derivatives, and blocks, in random states.

    A derivative rule may let results depend on arguments that their values do not depend on.
    """

    def evaluated(x: Array, v: Array, *others: Any) -> tuple[list[tuple[Array, Array]], Array]:
        def along(function: Callable) -> Array:
            return jax.jvp(lambda v: function(v, *others), (v,), (x,))[1]

        mass = found.mass(lambda v: momentum(v, *others), v)
        pairs, constrained = [(mass.times(x), along(momentum))], found.constrained
        if velocity is None or constrained is None:
            return pairs, mass.entries
        residual = velocity
        kkt = constrained.kkt(mass, lambda v: residual(v, *others), v)
        return [*pairs, (kkt.times(x), along(residual))], kkt.augmented()[0].entries

    program, shape = jax.make_jaxpr(evaluated, return_shape=True)(given[0], *given)
    draw = np.random.default_rng(0)

    def drawn(like: Any) -> np.ndarray:
        if jnp.issubdtype(like.dtype, jnp.floating):
            return draw.uniform(0.5, 1.5, like.shape)
        return draw.integers(1, 4, like.shape).astype(like.dtype)

    for _ in range(STATES):
        results = interpret(program, *map(drawn, jax.tree.leaves((given[0], *given))))
        yield jax.tree.unflatten(jax.tree.structure(shape), results)


def _equal(ours: np.ndarray, theirs: np.ndarray) -> bool:
    """To eps^1/2, where both are finite."""
    both = np.isfinite(ours) & np.isfinite(theirs)
    off, size = np.abs(ours - theirs)[both], np.max(np.abs(theirs[both]), initial=0.0)
    allowed = float(np.finfo(ours.dtype).eps) ** 0.5
    return bool(np.any(both) and np.all(off <= allowed * (1.0 + size)))
