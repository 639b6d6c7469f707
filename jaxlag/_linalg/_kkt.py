"""KKT systems: solves with M bordered by constraint rows, M x - A^T lam = r, A x + c = 0.

M may be singular, but is positive definite on the tangent space A x = 0. A mask `active_rows`
leaves out rows that depend on others; their lam is 0.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._linalg._mass_solve import (
    MassFactor,
    dependence_floor,
    eliminate,
    factor_mass,
    rank_floor,
    solve_mass,
)

FORMULATIONS = ("multipliers", "null_space")


class Multipliers(NamedTuple):
    """M + A^T W A and the Schur complement S = A (M + A^T W A)^-1 A^T, each factored once."""

    mass: MassFactor
    weights: Float[Array, " m"]
    spread: Float[Array, "m n"]  # (M + A^T W A)^-1 A^T, transposed
    schur: MassFactor

    def solve(
        self, A: Float[Array, "m n"], r: Float[Array, " n"], c: Float[Array, " m"]
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """(x, lam); A^T W (A x + c) = 0 is added to the first equation."""
        free = eliminate(self.mass, r - (self.weights * c) @ A)
        lam = -eliminate(self.schur, c + A @ free)
        return free + lam @ self.spread, lam

    @property
    def healthy(self) -> tuple[Bool[Array, " n"], Bool[Array, " m"]]:
        """Pivots of coordinates and of rows that are positive to working precision."""
        return self.mass.healthy, self.schur.healthy


class TangentSpace(NamedTuple):
    """The tangent space A x = 0 and its complement, A = L Y with orthonormal rows Y.

    All in units of coordinates in which their inertias are 1. P = 1 - Y^T Y projects onto the
    tangent space. `independent` is False for rows that depend on those before them.
    """

    units: Float[Array, " n"]
    M: Float[Array, "n n"]
    L: tuple[tuple[Array, ...], ...]
    Y: Float[Array, "m n"]
    independent: Bool[Array, " m"]

    def inertia(self) -> Float[Array, "n n"]:
        """P M P + s (1 - P), with the mean inertia s of the coordinates."""
        M, Y = self.M, self.Y
        M_P = M - (M @ Y.T) @ Y
        return M_P - Y.T @ (Y @ M_P) + _size(M) / M.shape[0] * (Y.T @ Y)

    def loads(
        self, r: Float[Array, " n"], c: Float[Array, " m"]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """(-Y^T L^-1 c, the part of x across the tangent space; the load left for y)."""
        z: list[Array] = []
        for k, row in enumerate(self.L):
            z.append((-c[k] - sum(row[j] * z[j] for j in range(k))) / row[k])
        across = jnp.stack(z) @ self.Y
        return across, self._along(self.units * r - self.M @ across)

    def acceleration(self, y: Float[Array, " n"], across: Float[Array, " n"]) -> Float[Array, " n"]:
        """x = P y - Y^T L^-1 c."""
        return self.units * (across + self._along(y))

    def multipliers(self, x: Float[Array, " n"], r: Float[Array, " n"]) -> Float[Array, " m"]:
        """lam = L^-T Y (M x - r)."""
        y = self.Y @ (self.M @ (x / self.units) - self.units * r)
        m = len(self.L)
        z: list[Array] = [jnp.zeros((), y.dtype)] * m
        for k in reversed(range(m)):
            known = sum(self.L[j][k] * z[j] for j in range(k + 1, m))
            z[k] = (y[k] - known) / self.L[k][k]
        return jnp.stack(z)

    def _along(self, x: Array) -> Array:
        """P x."""
        return x - (self.Y @ x) @ self.Y


class NullSpace(NamedTuple):
    """The inertia on the tangent space, factored once.

    Acceleration without multipliers: x = P y - Y^T L^-1 c (Siciliano et al., Robotics, sec. 9.4).
    """

    space: TangentSpace
    mass: MassFactor

    def solve(
        self, A: Float[Array, "m n"], r: Float[Array, " n"], c: Float[Array, " m"]
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """(x, lam)."""
        across, load = self.space.loads(r, c)
        x = self.space.acceleration(eliminate(self.mass, load), across)
        return x, self.space.multipliers(x, r)

    @property
    def healthy(self) -> tuple[Bool[Array, " n"], Bool[Array, " m"]]:
        """Pivots of coordinates and of rows that are positive to working precision."""
        return self.mass.healthy, self.space.independent


Factor = Multipliers | NullSpace


def factor_kkt(
    M: Float[Array, "n n"],
    A: Float[Array, "m n"],
    active_rows: Bool[Array, " m"] | None,
    formulation: str,
    crossing: bool = False,
) -> Factor:
    """Factor the KKT matrix once, for any number of right-hand sides.

    Args:
        M: symmetric, positive definite where A x = 0.
        A: rows.
        active_rows: rows to solve with; None for all.
        formulation: "multipliers" or "null_space".
        crossing: whether rows that depend on those before them are left out; otherwise they are
            unhealthy.
    """
    A = masked(A, active_rows)
    if formulation == "null_space":
        space = tangent_space(M, A, active_rows, crossing)
        return NullSpace(space, factor_mass(space.inertia()))
    bordered, weights = augmented(M, A)
    mass = factor_mass(bordered)
    spread = jax.vmap(lambda row: eliminate(mass, row))(A)
    S = A @ spread.T
    if active_rows is not None:
        S = S + jnp.diag((~active_rows).astype(S.dtype))
    return Multipliers(mass, weights, spread, factor_mass(S, rank_floor(S.dtype), crossing))


def augmented(
    M: Float[Array, "n n"], A: Float[Array, "m n"]
) -> tuple[Float[Array, "n n"], Float[Array, " m"]]:
    """(M + A^T W A, W): positive definite if M is semidefinite, and definite on A x = 0."""
    weights = row_weights(M, A)
    return M + (A.T * weights[None]) @ A, weights


def row_weights(M: Float[Array, "n n"], A: Float[Array, "m n"]) -> Float[Array, " m"]:
    """The diagonal of W, 1 / sum_i A_ki^2 / M_ii over the coordinates with inertia.

    The term of a row in M + A^T W A is then as large as the inertia of its coordinates, also if
    inertias differ widely.
    """
    inertias = _diagonal(M)
    inertial = inertias > float(jnp.finfo(M.dtype).tiny)
    mobilities = jnp.where(inertial, 1.0 / jnp.where(inertial, inertias, 1.0), 0.0)
    mobility = jnp.sum(A**2 * mobilities[None], axis=1)
    square = jnp.sum(A**2, axis=1)
    mobile = mobility > 0
    alone = _size(M) / jnp.where(square > 0, square, 1.0)
    weights = jnp.where(mobile, 1.0 / jnp.where(mobile, mobility, 1.0), alone)
    return jnp.where(square > 0, weights, 0.0)


def _size(M: Array) -> Array:
    """The trace of M; 1 if M = 0 (motion fully prescribed by constraints)."""
    trace = jnp.sum(_diagonal(M))
    return jnp.where(trace > 0, trace, jnp.ones_like(trace))


def _diagonal(M: Array) -> Array:
    """The diagonal as masked sums: unlike a gather they need no program to be read on scalars."""
    return jnp.sum(jnp.where(np.eye(M.shape[0], dtype=bool), M, jnp.zeros_like(M)), axis=1)


def units_of(M: Float[Array, "n n"], A: Float[Array, "m n"]) -> Float[Array, " n"]:
    """1 / sqrt of the inertia of every coordinate; of A^T W A if M has none."""
    inertias = _diagonal(M)
    by_rows = inertias + jnp.sum(row_weights(M, A)[:, None] * A**2, axis=0)
    inertias = jnp.where(inertias > 0, inertias, by_rows)
    return jax.lax.rsqrt(jnp.where(inertias > 0, inertias, 1.0))


def tangent_space(
    M: Float[Array, "n n"],
    A: Float[Array, "m n"],
    active_rows: Bool[Array, " m"] | None,
    crossing: bool,
    rejected: float = 1.0,
) -> TangentSpace:
    """Units of coordinates in which their inertias are 1, and orthonormal rows in them.

    Args:
        M: symmetric, positive definite where A x = 0.
        A: rows.
        active_rows: rows to solve with; None for all.
        crossing: whether rows that depend on those before them are left out.
        rejected: norm of such a row otherwise; NaN makes all results NaN.
    """
    units = units_of(M, A)
    M, A = units[:, None] * M * units[None], A * units[None]
    norm = jnp.inf if crossing else rejected
    L, Y, independent = orthonormal_rows(A, active_rows, rank_floor(A.dtype), norm)
    return TangentSpace(units, M, L, Y, independent | crossing)


def orthonormal_rows(
    A: Float[Array, "m n"], active_rows: Bool[Array, " m"] | None, floor: float, rejected: float
) -> tuple[tuple[tuple[Array, ...], ...], Float[Array, "m n"], Bool[Array, " m"]]:
    """(L, Y, independent), A = L Y, by Gram-Schmidt orthonormalization.

    Each row is orthogonalized twice ("twice is enough"). Rows that are not active have 0 in Y and 1
    in L, and count as independent.

    Args:
        A: rows, 0 if not active.
        active_rows: rows to solve with; None for all.
        floor: a row is dependent if the part that the rows before it leave has a square of at most
            this times that of the row.
        rejected: norm of the part that is left of a dependent row.
    """
    L: list[tuple[Array, ...]] = []
    Y: list[Array] = []
    independent: list[Array] = []
    for k in range(A.shape[0]):
        rest, parts = A[k], jnp.zeros((k,), A.dtype)
        for _ in range(2 if Y else 0):
            before = jnp.stack(Y)
            part = before @ rest
            rest, parts = rest - part @ before, parts + part
        square = jnp.sum(rest**2)
        fine = square > floor * jnp.sum(A[k] ** 2)
        norm = jnp.sqrt(jnp.where(fine, square, rejected))
        if active_rows is not None:
            norm = jnp.where(active_rows[k], norm, 1.0)
            fine = fine | ~active_rows[k]
        independent.append(fine)
        L.append((*parts, norm))
        Y.append(rest / norm)
    return tuple(L), jnp.stack(Y), jnp.stack(independent)


def masked(A: Array, active_rows: Bool[Array, " m"] | None) -> Array:
    """A, or entries of c, with zeros for rows that are not active."""
    if active_rows is None:
        return A
    return jnp.where(active_rows if A.ndim == 1 else active_rows[:, None], A, jnp.zeros_like(A))


def solve_kkt(
    M: Float[Array, "n n"],
    A: Float[Array, "m n"],
    r: Float[Array, " n"],
    c: Float[Array, " m"],
    active_rows: Bool[Array, " m"] | None = None,
    formulation: str = "multipliers",
    factor: Factor | None = None,
    crossing: bool = False,
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """(x, lam) with M x = r + A^T lam, A x + c = 0; NaN if there is no solution.

    Derivatives reuse the factor; they hold for a constant set of active rows.

    Args:
        M: symmetric, positive definite where A x = 0.
        A: rows.
        r: right-hand side.
        c: right-hand side of the rows.
        active_rows: rows to solve with; None for all.
        formulation: "multipliers" or "null_space".
        factor: `factor_kkt` of the same, if it exists already.
        crossing: as for `factor_kkt`.
    """
    frozen = jax.lax.stop_gradient((M, A))
    factor = factor_kkt(*frozen, active_rows, formulation, crossing) if factor is None else factor
    factor = jax.lax.stop_gradient(factor)
    A, c = masked(A, active_rows), masked(c, active_rows)
    rows = jax.lax.stop_gradient(A)

    n = M.shape[0]

    def bordered(z: Array) -> Array:
        x, lam = z[:n], z[n:]
        below = -(A @ x)
        below = below if active_rows is None else jnp.where(active_rows, below, -lam)
        return jnp.concatenate([M @ x - lam @ A, below])

    def solve(_: object, right: Array) -> Array:
        return jnp.concatenate(factor.solve(rows, right[:n], right[n:]))

    # One vector: pairs could contain symbolic zeros, which JAX's rule does not accept.
    z = jax.lax.custom_linear_solve(bordered, jnp.concatenate([r, c]), solve, symmetric=True)
    x, lam = z[:n], z[n:]
    fine = jnp.all(jnp.concatenate(factor.healthy))
    return jnp.where(fine, x, jnp.nan), jnp.where(fine, lam, jnp.nan)


def correction_matrix(
    M: Float[Array, "n n"],
    A: Float[Array, "m n"],
    active_rows: Bool[Array, " m"] | None,
    formulation: str,
    crossing: bool,
    augment: bool,
) -> tuple[Float[Array, "n m"], Float[Array, " m"]]:
    """(M^-1 A^T (A M^-1 A^T)^-1, the diagonal of (A M^-1 A^T)^-1): effective masses of rows.

    Args:
        M: symmetric, positive definite where A x = 0.
        A: rows.
        active_rows: rows to solve with; None for all. The columns of the others are zero.
        formulation: "multipliers" or "null_space".
        crossing: as for `factor_kkt`; a row that is left out has mass 0.
        augment: whether masses are those of M + A^T W A: rows without inertia would have none.
    """
    factor = factor_kkt(*jax.lax.stop_gradient((M, A)), active_rows, formulation, crossing)
    weights = row_weights(*jax.lax.stop_gradient((M, masked(A, active_rows)))) if augment else None

    def column(c: Array) -> tuple[Array, Array]:
        load = jnp.zeros(A.shape[1:], A.dtype) if weights is None else (weights * c) @ A
        x, lam = solve_kkt(M, A, load, c, active_rows, formulation, factor)
        return -x, -lam

    K, masses = jax.vmap(column, out_axes=1)(jnp.eye(A.shape[0], dtype=A.dtype))
    return K, jnp.diagonal(masses)


def solve_reactions(
    M: Float[Array, "n n"],
    A: Float[Array, "m n"],
    r: Float[Array, " n"],
    force: Callable,
    c: Float[Array, " m"],
    active_rows: Bool[Array, " m"] | None,
    affine: bool,
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """(x, lam) with M x = r + force(lam) + A^T lam, A x + c = 0; NaN if there is no solution.

    Newton's method on lam, with one step if force is affine. Each step solves with the unsymmetric
    A (M + A^T W A)^-1 (A^T + d force/d lam), by LU factorization without pivoting. A pivot that is
    not positive means that reaction forces have reversed the sense of rows (Painleve): there is no
    solution, or more than one.

    Args:
        M: symmetric, positive definite where A x = 0.
        A: rows.
        r: right-hand side.
        force: lam -> a force, (n,).
        c: right-hand side of the rows.
        active_rows: rows to solve with; None for all.
        affine: whether force is affine.
    """
    A, c = masked(A, active_rows), masked(c, active_rows)
    full, weights = augmented(M, A)
    factor = factor_mass(jax.lax.stop_gradient(full))
    frozen = jax.lax.stop_gradient
    spare = None if active_rows is None else jnp.diag((~active_rows).astype(M.dtype))

    def newton(lam: Array) -> tuple[Array, Array, Array]:
        G = jax.jacfwd(force)(lam)
        if active_rows is not None:
            G = jnp.where(active_rows, G, 0.0)
        rest = r + force(lam) - G @ lam - (weights * c) @ A
        sides = jnp.concatenate([(A.T + G).T, rest[None]])
        found = jax.vmap(lambda b: solve_mass(full, b, factor))(sides)
        spread, free = found[:-1], found[-1]
        S = A @ spread.T
        if spare is not None:
            S = S + spare
        lam, fine = solve_general(S, -(c + A @ free), rank_floor(S.dtype))
        return free + lam @ spread, lam, fine

    start = jnp.zeros_like(c)
    if not affine:
        start = frozen(_iterated(newton, start))
        start = newton(start)[1]
    x, lam, fine = newton(start)
    if not affine:
        left = jnp.max(jnp.abs(lam - start) / (1.0 + jnp.abs(lam)))
        fine = fine & (left <= dependence_floor(M.dtype))
    fine = fine & jnp.all(factor.healthy)
    return jnp.where(fine, x, jnp.nan), jnp.where(fine, lam, jnp.nan)


def solve_general(
    S: Float[Array, "m m"], right: Float[Array, " m"], relative: float
) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
    """(the x with S x = right, whether every pivot exceeds relative |S_kk|), S not symmetric."""
    m, fine = S.shape[0], jnp.array(True)
    least, rows = relative * jnp.abs(jnp.diagonal(S)), jnp.concatenate([S, right[:, None]], axis=1)
    for k in range(m):
        fine = fine & (rows[k, k] > least[k])
        below = (jnp.arange(m) > k)[:, None]
        rows = jnp.where(below, rows - jnp.outer(rows[:, k] / rows[k, k], rows[k]), rows)
    x = jnp.zeros_like(right)
    for k in reversed(range(m)):
        x = x.at[k].set((rows[k, m] - rows[k, :m] @ x) / rows[k, k])
    return x, fine


MAX_NEWTON = 50


def _iterated(newton: Callable, lam: Array) -> Array:
    """The lam at which Newton's method converges, or after MAX_NEWTON steps."""
    eps = float(jnp.finfo(lam.dtype).eps)

    def body_fun(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        lam, _, count = state
        found = newton(lam)[1]
        return found, jnp.max(jnp.abs(found - lam) / (1.0 + jnp.abs(found))), count + 1

    def cond_fun(state: tuple[Array, Array, Array]) -> Array:
        return (state[1] > 8 * eps) & (state[2] < MAX_NEWTON)

    init = (lam, jnp.full((), jnp.inf, lam.dtype), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(cond_fun, body_fun, init)[0]
