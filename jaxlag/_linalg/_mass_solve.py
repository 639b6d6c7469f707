"""Solves with the mass matrix: symmetric positive definite, small, factored once."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float, Int

# Up to the first size the elimination is unrolled into scalar operations, which XLA fuses into the
# surrounding loop; up to the second it is a loop over the rows. A library call keeps the loop of
# steps from compiling to one native function. Milliseconds of a solve of chains, library | loop
# over rows, compile times alike: 10 links 5.0 | 2.6, 12 links 7.1 | 4.4, 16 links 12.9 | 9.8, 24
# links 60 | 70.
UNROLL_UP_TO = 8
LOOP_UP_TO = 16


def dependence_floor(dtype: jnp.dtype) -> float:
    """Square of the sine of the angle below which a row depends on others at a start: eps^1/2."""
    return float(jnp.finfo(dtype).eps) ** 0.5


def rank_floor(dtype: jnp.dtype) -> float:
    """The same during a motion, for rows that were independent at its start: eps^2/3."""
    return float(jnp.finfo(dtype).eps) ** (2 / 3)


def closed_to(dtype: jnp.dtype) -> float:
    """Residual over row and state up to which dependent rows count as satisfied: eps^3/4."""
    return float(jnp.finfo(dtype).eps) ** 0.75


class MassFactor(NamedTuple):
    """Factor of M = L D L^T, with U = D L^T (upper) and the pivots' health.

    `upper`: rows of U as scalars for small n, as one array for larger ones (zero below the
    diagonal); otherwise `cholesky`, the lower Cholesky factor.
    """

    upper: tuple[tuple[Array, ...], ...] | Float[Array, "n n"] | None
    cholesky: Float[Array, "n n"] | None
    healthy: Bool[Array, " n"]

    @property
    def pivots(self) -> Float[Array, " n"]:
        """The diagonal of D."""
        if self.upper is None:
            assert self.cholesky is not None
            return jnp.diagonal(self.cholesky) ** 2
        if isinstance(self.upper, jax.Array):
            return jnp.diagonal(self.upper)
        return jnp.stack([row[0] for row in self.upper])


def factor_mass(
    M: Float[Array, "n n"], relative: float | None = None, crossing: bool = False
) -> MassFactor:
    """Factor M once; `healthy[i]` is whether pivot i is positive to working precision.

    A pivot below 4 n eps M_ii is the rounding of a singular matrix, for all units of
    coordinate i. A singular matrix whose other pivots are ill-conditioned can
    pass: its rounding is larger than that.

    Args:
        M: symmetric.
        relative: factor of M_ii instead of 4 n eps.
        crossing: whether a pivot that is too small is set to infinity, so that its unknown is 0.
    """
    n = M.shape[0]
    floor = _floor(M) if relative is None else relative * jnp.abs(jnp.diagonal(M))
    if n > LOOP_UP_TO and not crossing:
        lower = jnp.linalg.cholesky(M, symmetrize_input=False)
        pivots = jnp.diagonal(lower) ** 2
        return MassFactor(None, lower, pivots > floor)
    if n > UNROLL_UP_TO:
        eliminated = _eliminated(M, floor if crossing else None)
        return MassFactor(jnp.triu(eliminated), None, jnp.diagonal(eliminated) > floor)
    rows = [[M[i, j] for j in range(i, n)] for i in range(n)]  # row i holds columns i to n - 1
    for k in range(n):
        if crossing:
            rows[k][0] = jnp.where(rows[k][0] <= floor[k], jnp.inf, rows[k][0])
        for i in range(k + 1, n):
            ratio = rows[k][i - k] / rows[k][0]
            for j in range(i, n):
                rows[i][j - i] = rows[i][j - i] - ratio * rows[k][j - k]
    upper = tuple(tuple(row) for row in rows)
    pivots = jnp.stack([upper[i][0] for i in range(n)]) if n else jnp.zeros((0,), M.dtype)
    return MassFactor(upper, None, pivots > floor)


def first_unhealthy(M: Float[Array, "n n"], factor: MassFactor | None = None) -> Int[Array, ""]:
    """Index of the coordinate whose pivot fails first, -1 if M is positive definite.

    A failed library factorization does not report the index, so a plain elimination finds it.

    Args:
        M: symmetric.
        factor: `factor_mass(M)` if it exists already.
    """
    factor = factor_mass(M) if factor is None else factor
    pivots = jnp.diagonal(_eliminated(M))
    failed = ~(pivots > _floor(M))
    weakest = jnp.argmin(pivots / jnp.diagonal(M))
    first = jnp.where(jnp.any(failed), jnp.argmax(failed), weakest)
    return jnp.where(jnp.all(factor.healthy), -1, first).astype(jnp.int32)


def _eliminated(
    M: Float[Array, "n n"], floor: Float[Array, " n"] | None = None
) -> Float[Array, "n n"]:
    """U = D L^T on and above the diagonal, by rows; elements below it are meaningless.

    Pivots up to `floor` are set to infinity.
    """
    n = M.shape[0]
    at = jnp.arange(n)

    def one(k: Int[Array, ""], M: Float[Array, "n n"]) -> Float[Array, "n n"]:
        if floor is not None:
            M = M.at[k, k].set(jnp.where(M[k, k] <= floor[k], jnp.inf, M[k, k]))
        # XLA would repeat the division for every entry.
        ratio = jax.lax.optimization_barrier(M[k] / M[k, k])
        return jnp.where((at > k)[:, None], M - ratio[:, None] * M[k][None], M)

    return jax.lax.fori_loop(0, n, one, M)


def known_definite(M: np.ndarray, dtype: Any) -> bool:
    """The same of a known matrix, or of several, by the eigenvalues of M_ij / sqrt(M_ii M_jj).

    Args:
        M: symmetric; False if it is not finite.
        dtype: of the state, whose precision it has.
    """
    diagonal = np.diagonal(M, axis1=-2, axis2=-1)
    if not np.all(np.isfinite(M)) or not np.all(diagonal > 0):
        return False
    units, floor = np.sqrt(diagonal), np.sqrt(float(jnp.finfo(dtype).eps))
    scaled = M / (units[..., :, None] * units[..., None, :])
    return bool(np.min(np.linalg.eigvalsh(scaled)) > floor)


def clearly_definite(M: Float[Array, "n n"]) -> Bool[Array, ""]:
    """Whether M is positive definite: its pivots, each over M_ii, are above eps^1/2."""
    units = jnp.sqrt(jnp.abs(jnp.diagonal(M)))
    units_or_one = jnp.where(units > 0, units, 1)
    scaled = M / jnp.outer(units_or_one, units_or_one)
    floor = float(jnp.finfo(M.dtype).eps) ** 0.5
    return jnp.all(units > 0) & jnp.all(factor_mass(scaled, relative=floor).healthy)


def _floor(M: Float[Array, "n n"]) -> Float[Array, " n"]:
    return 4 * M.shape[0] * jnp.finfo(M.dtype).eps * jnp.abs(jnp.diagonal(M))


def eliminate(factor: MassFactor, r: Float[Array, " n"]) -> Float[Array, " n"]:
    """The x with M x = r, also for an unhealthy factor."""
    if factor.upper is None:
        assert factor.cholesky is not None
        return cho_solve((factor.cholesky, True), r)
    U = factor.upper
    if isinstance(U, jax.Array):
        return _substituted(U, r)
    n = len(U)
    z = [r[i] for i in range(n)]
    for k in range(n):
        scaled = z[k] / U[k][0]
        for i in range(k + 1, n):
            z[i] = z[i] - U[k][i - k] * scaled
    x: list[Array] = [jnp.zeros((), r.dtype)] * n
    for i in reversed(range(n)):
        # Each component ends in a true divide: XLA recomputes cheap producers in every consumer.
        x[i] = (z[i] - sum(U[i][k - i] * x[k] for k in range(i + 1, n))) / U[i][0]
    return jnp.stack(x)


def _substituted(U: Float[Array, "n n"], r: Float[Array, " n"]) -> Float[Array, " n"]:
    """The x with L U x = r, row by row; L^T = D^-1 U."""
    n = len(r)
    at = jnp.arange(n)

    def down(k: Int[Array, ""], z: Float[Array, " n"]) -> Float[Array, " n"]:
        return jnp.where(at > k, z - U[k] * (z[k] / U[k, k]), z)

    def up(k: Int[Array, ""], x: Float[Array, " n"]) -> Float[Array, " n"]:
        i = n - 1 - k
        rest = z[i] - jnp.sum(jnp.where(at > i, U[i] * x, 0.0))
        return jnp.where(at == i, rest / U[i, i], x)

    z = jax.lax.fori_loop(0, n, down, r)
    return jax.lax.fori_loop(0, n, up, jnp.zeros_like(r))


def solve_mass(
    M: Float[Array, "n n"], r: Float[Array, " n"], factor: MassFactor | None = None
) -> Float[Array, " n"]:
    """The x with M x = r; NaN if M is not positive definite.

    Derivatives reuse the factor: dx = M^-1 (dr - dM x).

    Args:
        M: symmetric positive definite.
        r: right-hand side.
        factor: `factor_mass(M)` if it exists already.
    """
    factor = factor_mass(jax.lax.stop_gradient(M)) if factor is None else factor
    factor = jax.lax.stop_gradient(factor)
    x = jax.lax.custom_linear_solve(
        lambda x: M @ x, r, solve=lambda _, b: eliminate(factor, b), symmetric=True
    )
    return jnp.where(jnp.all(factor.healthy), x, jnp.nan)
