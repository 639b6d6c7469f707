"""Reference solution of M a + h = Q + A^T lam, A a + gamma = 0, independent of the library.

M, h, A, b and gamma come from plain Jacobians of L and of the residuals, in double precision for
all systems. Gaussian elimination in extended precision solves the equations with the independent
rows, in units in which inertias are 1. A full-rank factorization gives the multipliers of least
norm, implicit differentiation the derivatives.

The attainable accuracy is estimated by two perturbations: other rounding errors of the terms, and
errors of the size of rounding in every entry of the equations. A stable method may make both.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bench.fuzz._comparison import SLACK
from bench.fuzz._random_mechanisms import Mechanism
from bench.fuzz._random_systems import function

LONG = np.longdouble


class Unclear(Exception):
    """It is uncertain whether there is a solution."""


class Terms(NamedTuple):
    """M, h - Q, A, b, gamma at a state."""

    M: np.ndarray
    h: np.ndarray
    A: np.ndarray
    b: np.ndarray
    gamma: np.ndarray


class Solved(NamedTuple):
    """A solution in units of inertias and rows, with its derivatives along a direction.

    Attributes:
        a: accelerations divided by the units.
        mu: multipliers times lengths of rows; 0 for void rows.
        size: of the terms that determine the accelerations; they may cancel.
        dsize: of the derivatives of these terms.
    """

    a: np.ndarray
    mu: np.ndarray
    da: np.ndarray
    dmu: np.ndarray
    size: float = 0.0
    dsize: float = 0.0


def terms_of(mechanism: Mechanism) -> Any:
    """The terms as a function of (t, q, v, params)."""
    drawn, quasi = mechanism.drawn, mechanism.quasi
    written = function("t, q, v, p", drawn.lagrangian)
    rows = [(row, function(row.arguments, row.text)) for row in mechanism.all_rows]

    def rates(t: Any, q: Any, v: Any, p: Any) -> Any:
        assert quasi is not None
        if quasi.U is not None:
            return quasi.rates(t, q, v, p)
        given = function("t, q, u, p", quasi.kinematics or "")
        rest = jnp.zeros((quasi.size,))
        slopes = jax.jacfwd(given, 2)(t, q, rest, p)
        return jnp.linalg.solve(slopes, v - given(t, q, rest, p))

    def L(t: Any, q: Any, v: Any, p: Any) -> Any:
        if quasi is not None and quasi.written_in == "u":
            return written(t, q, rates(t, q, v, p), p)
        return written(t, q, v, p)

    def velocity(t: Any, q: Any, v: Any, p: Any) -> Any:
        found = []
        for row, residual in rows:
            if row.kind == "Pfaffian":
                found.append(residual(t, q, v, p))
            else:
                found.append(jax.grad(residual, 1)(t, q, p) @ v + jax.grad(residual)(t, q, p))
        return jnp.stack(found) if found else jnp.zeros((0,))

    def terms(t: Any, q: Any, v: Any, p: Any) -> Terms:
        momentum = jax.grad(L, 2)

        def along(f: Any) -> Any:
            return jax.jacfwd(f, 1)(t, q, v, p) @ v + jax.jacfwd(f, 0)(t, q, v, p)

        h = along(momentum) - jax.grad(L, 1)(t, q, v, p)
        if drawn.force:
            h = h - drawn.generalized_force(t, q, v, p)
        M = jax.jacfwd(momentum, 2)(t, q, v, p)
        A = jax.jacfwd(velocity, 2)(t, q, v, p)
        return Terms(M, h, A, velocity(t, q, 0.0 * v, p), along(velocity))

    return terms


def units_of(M: np.ndarray, A: np.ndarray) -> np.ndarray:
    """1 / sqrt of inertias; for coordinates without inertia, an estimate from their rows."""
    inertias = np.diagonal(M).copy()
    if np.any(inertias < 0):
        raise Unclear("inertias that are negative")
    nonzero = inertias > 0
    if not np.all(nonzero):
        met = np.sum(np.where(nonzero, A**2 / np.where(nonzero, inertias, 1.0), 0.0), axis=1)
        square = np.sum(A**2, axis=1)
        alone = (np.sum(inertias) or 1.0) / np.where(square > 0, square, 1.0)
        weights = np.where(met > 0, 1.0 / np.where(met > 0, met, 1.0), alone)
        estimated = weights @ A**2
        inertias = np.where(nonzero, inertias, estimated)
    return 1.0 / np.sqrt(np.where(inertias > 0, inertias, 1.0))


class Equations:
    """The equations at a state, with a set of independent rows and the kind of outcome.

    Attributes:
        units: of the coordinates.
        lengths: of the rows, in these units.
        base: a largest set of independent rows.
        void: rows that are zero except for rounding.
        outcome: "solution", "singular" (M on the tangent space) or "contradictory".
    """

    def __init__(
        self, terms: Terms, void: np.ndarray, eps: float, near: list[Terms] | None = None
    ) -> None:
        self.eps, self.void, self._near = eps, void, near or []
        M, A = terms.M, np.where(void[:, None], 0.0, terms.A)
        if not all(np.all(np.isfinite(x)) for x in terms):
            raise Unclear("terms that are not finite")
        self.units = units_of(M, A)
        lengths = np.linalg.norm(A * self.units, axis=1)
        if np.any((lengths == 0) & ~void):
            raise Unclear("rows that vanish")
        self.lengths = np.where(void, 1.0, lengths)
        self.base = self._independent(A)
        self.outcome = self._outcome(terms)

    def _independent(self, A: np.ndarray) -> np.ndarray:
        """A greedy choice of independent rows: the row of the largest sine first."""
        rows = A * self.units / self.lengths[:, None]
        floor = self.eps ** (1 / 3)  # bound on sines in the library
        left, base, others = rows.copy(), [], [k for k in range(len(A)) if not self.void[k]]
        while others:
            sines = np.linalg.norm(left[others], axis=1)
            k = others.pop(int(np.argmax(sines)))
            sine = float(np.max(sines))
            if sine < 1e3 * self.eps:
                break
            if sine < 30 * floor or len(base) == A.shape[1]:
                raise Unclear("rows that are nearly dependent")
            base.append(k)
            e = left[k] / np.linalg.norm(left[k])
            left = left - np.outer(left @ e, e)
        return np.array(sorted(base), int)

    def _outcome(self, terms: Terms) -> str:
        M = terms.M * np.outer(self.units, self.units)
        A = terms.A[self.base] * self.units / self.lengths[self.base, None]
        n, m = len(M), len(A)
        size = max(np.max(np.abs(M)), np.finfo(float).tiny)
        tangent = np.linalg.svd(A, full_matrices=True)[2][m:] if m else np.eye(n)
        least = np.min(np.linalg.eigvalsh(tangent @ M @ tangent.T), initial=np.inf) / size
        if least < 16 * n * np.finfo(float).eps:
            return "singular"
        if least < 3e3 * self.eps ** (2 / 3):
            raise Unclear("inertia that nearly vanishes")
        if m:
            metric = M + A.T @ A
            S = A @ np.linalg.solve(metric, A.T)
            if not np.all(np.diagonal(S) > 0.0):
                raise Unclear("rows that vanish in the metric of M")
            scale = 1.0 / np.sqrt(np.diagonal(S))
            pivots = np.linalg.eigvalsh(S * np.outer(scale, scale))
            if np.min(pivots) < 1e3 * self.eps ** (2 / 3):
                raise Unclear("rows that are nearly dependent in the metric of M")
        others = [k for k in range(len(self.void)) if k not in self.base and not self.void[k]]
        if not others:
            return "solution"
        off, size = self._left_open(terms)
        off = off[others]
        noise = max(
            (np.max(np.abs(self._left_open(x)[0][others] - off)) for x in self._near), default=0.0
        )
        # Programs may choose other rows; their solutions differ by as much as these residuals.
        if np.max(np.abs(off)) <= SLACK * (self.eps * size + noise):
            return "solution"
        if np.max(np.abs(off)) < 1e-2 * size + 1e6 * noise:
            raise Unclear("rows that nearly contradict")
        return "contradictory"

    def _left_open(self, terms: Terms) -> tuple[np.ndarray, float]:
        """(A a + gamma of all rows, in units, its size), with a from the base rows."""
        found = self.solve(terms)
        gamma = terms.gamma / self.lengths
        rows = terms.A * self.units / self.lengths[:, None]
        size = max(_largest(found.a, gamma), self.eps**0.5 * found.size)
        return rows @ found.a + gamma, size

    def solve(
        self, terms: Terms, rates: Terms | None = None, rng: np.random.Generator | None = None
    ) -> Solved:
        """The solution; with `rng`, every entry has an error of the size of rounding.

        Args:
            terms: of the equations.
            rates: derivatives of the terms along a direction; None to omit derivatives.
            rng: the random generator of the errors.
        """
        D, length, base = self.units.astype(LONG), self.lengths.astype(LONG), self.base

        def rows(A: Any) -> Any:
            return np.where(self.void[:, None], 0, A) * D / length[:, None]

        M, A = (terms.M * np.outer(D, D)).astype(LONG), rows(terms.A)
        h, gamma, n = terms.h * D, terms.gamma / length, len(terms.M)
        if rng is not None:
            M, A = self._nudged(M, rng), rows(terms.A) + self._nudged(0 * A, rng, 1.0)
            A = np.where(self.void[:, None], 0, A)
        K = _bordered(M, A[base])
        z = _eliminated(K, np.concatenate([-h, -gamma[base]]))
        if rng is not None:  # right-hand sides, by the size of their terms
            a, y = abs(z[:n]), abs(z[n:])
            h = self._shaken(h, abs(M) @ a + y @ abs(A[base]), rng)
            # Forces contribute to the rows before reactions cancel this contribution.
            forces = _largest(h, z[n:])
            gamma = self._shaken(gamma, abs(A) @ (a + forces), rng)
            z = _eliminated(K, np.concatenate([-h, -gamma[base]]))
        a, y = z[:n], z[n:]

        # In the user's units, rows of unit length are F times those of the base. nu are the
        # multipliers times the lengths: the solution of F^T nu = known with least norm.
        true = np.linalg.norm(terms.A.astype(LONG), axis=1)
        true = np.where(self.void | (true == 0), 1, true)
        ratio = true / length
        C = _spanned(A, A[base])
        F = C * ratio[base] / ratio[:, None]
        w = _eliminated(F.T @ F, ratio[base] * y)
        mu = F @ w / ratio
        size = _largest(terms.h * D, a, mu, gamma)
        if rates is None:
            return Solved(*(np.asarray(x, float) for x in (a, mu, 0 * a, 0 * mu)), size)

        dM, dA = (rates.M * np.outer(D, D)).astype(LONG), rows(rates.A)
        dh, dgamma = rates.h * D, (rates.gamma / length)[base]
        if rng is not None:
            dM, dA = self._shaken(dM, 0, rng), self._shaken(dA, 0, rng)
            dh = self._shaken(dh, abs(dM) @ abs(a) + abs(y) @ abs(dA[base]), rng)
            forces = _largest(dh, abs(dM) @ abs(a), abs(y) @ abs(dA[base]))
            more = abs(dA[base]) @ (abs(a) + size) + abs(A[base]) @ np.full(n, forces)
            dgamma = self._shaken(dgamma, more, rng)
        upper, lower = -dh - dM @ a + y @ dA[base], -dgamma - dA[base] @ a
        dz = _eliminated(K, np.concatenate([upper, lower]))
        da, dy = dz[:n], dz[n:]
        growth = np.where(self.void, 0, np.sum(terms.A * rates.A, axis=1)) / true**2
        # The dependence of the rows also holds along the constraints.
        dC = _spanned(dA - C @ dA[base], A[base])
        dF = dC * ratio[base] / ratio[:, None] + F * (growth[base] - growth[:, None])
        known = ratio[base] * (dy + growth[base] * y)
        dw = _eliminated(F.T @ F, known - (dF.T @ F + F.T @ dF) @ w)
        dmu = (dF @ w + F @ dw) / ratio - mu * growth
        dsize = _largest(rates.h * D, da, dmu, dgamma, abs(dM) @ abs(a), abs(y) @ abs(dA[base]))
        found = (np.asarray(x, float) for x in (a, mu, da, dmu))
        return Solved(*found, size, max(size, dsize))

    def _nudged(self, X: Any, rng: np.random.Generator, size: float | None = None) -> Any:
        """Each entry changed by a rounding error of the largest one, or of `size`."""
        size = np.max(np.abs(X), initial=0.0) if size is None else size
        E = rng.uniform(-1.0, 1.0, X.shape)
        E = (E + E.T) / 2 if X.shape[0] == X.shape[1] else E
        return X + self.eps * size * E

    def _shaken(self, x: Any, more: Any, rng: np.random.Generator) -> Any:
        """Each entry changed by a rounding error of its size plus `more`."""
        return x + self.eps * (abs(x) + more) * rng.uniform(-1.0, 1.0, np.shape(x))


def _largest(*arrays: Any) -> float:
    return max(float(np.max(np.abs(x), initial=0.0)) for x in arrays)


def _bordered(M: Any, A: Any) -> Any:
    return np.block([[M, -A.T], [A, np.zeros((len(A), len(A)), LONG)]])


def _spanned(rows: Any, base: Any) -> Any:
    """C with rows = C base, by least squares."""
    found = [_eliminated(base @ base.T, base @ row) for row in rows]
    return np.array(found, LONG).reshape(len(rows), len(base))


def _eliminated(K: Any, right: Any) -> Any:
    """The x with K x = right, in extended precision, by elimination with pivoting."""
    K, x = np.array(K, LONG), np.array(right, LONG)
    n = len(K)
    for k in range(n):
        p = k + int(np.argmax(np.abs(K[k:, k])))
        if K[p, k] == 0:
            raise Unclear("equations that are singular")
        K[[k, p]], x[[k, p]] = K[[p, k]], x[[p, k]]
        factors = K[k + 1 :, k] / K[k, k]
        K[k + 1 :] -= factors[:, None] * K[k]
        x[k + 1 :] -= factors * x[k]
    for k in reversed(range(n)):
        x[k] = (x[k] - K[k, k + 1 :] @ x[k + 1 :]) / K[k, k]
    return x
