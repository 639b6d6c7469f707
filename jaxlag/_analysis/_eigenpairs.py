"""Eigenvalues and eigenvectors of a matrix that are differentiable beside repeated ones.

Each pair solves (A - lambda I) x = 0, c x = 1 for one entry of x. Its derivatives are those of
this system, whose matrix is regular if and only if the eigenvalue is simple. They need no other
pair.

Source: Nelson, AIAA J. 14 (1976) 1201; Andrew, Chu, Lancaster, SIAM J. Matrix Anal. Appl. 14
(1993) 903; errors: Golub, Van Loan, Matrix Computations, 4th ed., sec. 7.2.2.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from jaxlag._core._arrays import as_complex, stop_gradient

SWEEPS = 20
"""Of the balancing; each halves the logarithm of what is left."""
MOST = 4
"""Largest Jordan blocks whose errors are bounded by their size."""


class Eigenpairs(NamedTuple):
    """Pairs of a real matrix, by ascending |lambda|; conjugate ones are adjacent, Im > 0 first.

    Attributes:
        values: of the eigenvalues.
        vectors: one per column; the largest entry, in balanced units, is 1. Entries that are
            rounding are 0, with their derivatives.
        errors: estimated errors of the eigenvalues by rounding in the algorithm.
        simple: whether rounding cannot merge it with another eigenvalue.
    """

    values: Complex[Array, " k"]
    vectors: Complex[Array, "k k"]
    errors: Float[Array, " k"]
    simple: Bool[Array, " k"]


def eigenpairs(A: Float[Array, "k k"]) -> Eigenpairs:
    """The eigenpairs.

    Derivatives in every mode and order are exact for simple eigenvalues. Those of others are NaN
    unless they are 0, and leave those of simple ones as they are. Only a reverse derivative of a
    reverse Jacobian with rows of others is NaN as a whole.
    """
    units = _balancing(jax.lax.stop_gradient(A))
    values, vectors, errors = _pairs(A * units / units[:, None])
    simple, gaps = _simple(values, errors)
    noise = jnp.abs(vectors) <= jnp.where(simple, errors / gaps, 0.0)
    vectors = vectors - jnp.where(noise, stop_gradient(vectors), jnp.zeros_like(vectors))
    errors = _bounded(jax.lax.stop_gradient(A * units / units[:, None]), values, errors)
    return Eigenpairs(values, vectors * as_complex(units)[:, None], errors, simple)


def left_vectors(A: Float[Array, "k k"], pairs: Eigenpairs) -> Complex[Array, "k k"]:
    """Rows w with w A = lambda w and w x = 1; 0 for eigenvalues that are not simple."""
    units = _balancing(jax.lax.stop_gradient(A))
    k = A.shape[0]
    balanced, vectors = A * units / units[:, None], pairs.vectors / as_complex(units)[:, None]
    K = _bordered(balanced, pairs.values, vectors, pairs.simple)
    last = jnp.zeros((k, k + 1, 1), K.dtype).at[:, k].set(-1.0)
    return jnp.linalg.solve(jnp.swapaxes(K, 1, 2), last)[:, :k, 0] / as_complex(units)


def _balancing(A: Float[Array, "k k"]) -> Float[Array, " k"]:
    """Powers of 2, in units of which rows and columns of A without its diagonal are equally large.

    Source: Osborne, J. ACM 7 (1960) 338.
    """
    size = jnp.abs(A) * (1.0 - jnp.eye(A.shape[0], dtype=A.dtype))

    def swept(_: Any, log: Array) -> Array:
        x = size * jnp.exp2(log - log[:, None])
        rows, columns = jnp.sum(x, 1), jnp.sum(x, 0)
        both = (rows > 0) & (columns > 0)
        ratio = jnp.where(both, rows, 1.0) / jnp.where(both, columns, 1.0)
        return log + 0.25 * jnp.log2(ratio)

    return jnp.exp2(jnp.round(jax.lax.fori_loop(0, SWEEPS, swept, jnp.zeros_like(A[0]))))


@jax.custom_jvp
def _pairs(A: Float[Array, "k k"]) -> tuple[Array, Array, Array]:
    """(eigenvalues, vectors, errors); order and normalization as in `Eigenpairs`."""
    norm = _norm(A)
    scale = jnp.exp2(jnp.round(jnp.log2(jnp.where(norm > 0, norm, 1.0))))
    values, left, right = jax.lax.linalg.eig(A / scale)  # LAPACK's own scaling loses large values
    values = values * as_complex(scale)
    order = jnp.lexsort((jnp.real(values), jnp.abs(values)))  # stable: LAPACK's pairs stay together
    values, left, right = values[order], left[:, order], right[:, order]
    sizes = [jnp.linalg.norm(x, axis=0) for x in (left, right)]
    sine = jnp.abs(jnp.sum(jnp.conj(left) * right, 0))
    condition = sizes[0] * sizes[1] / sine
    errors = A.shape[0] * jnp.finfo(A.dtype).eps * norm * condition
    largest = jnp.argmax(jnp.abs(right), 0)
    return values, right / jnp.take_along_axis(right, largest[None], 0), errors


@_pairs.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    (A,), (change,) = primals, tangents
    values, vectors, errors = _pairs(A)
    simple, _ = _simple(values, errors)
    # Derivatives of others are NaN, and would be multiplied by 0.
    at = jnp.where(simple, values, stop_gradient(values))
    x = jnp.where(simple, vectors, stop_gradient(vectors))
    right = jnp.concatenate([-as_complex(change) @ x, jnp.zeros_like(x[:1])]).T
    K = _bordered(A, at, x, simple)
    moved = _nan_unless(simple, jnp.linalg.solve(K, right[..., None])[..., 0])
    along = moved[:, -1], moved[:, :-1].T, jnp.zeros_like(errors)
    return (values, vectors, errors), along


def _simple(
    values: Complex[Array, " k"], errors: Float[Array, " k"]
) -> tuple[Bool[Array, " k"], Float[Array, " k"]]:
    """(whether no other eigenvalue is within twice its error, distances to the nearest other)."""
    values, errors = stop_gradient((values, errors))
    itself = jnp.eye(values.shape[0], dtype=bool)
    gaps = jnp.min(jnp.where(itself, jnp.inf, jnp.abs(values - values[:, None])), 1)
    return (gaps > 2.0 * errors) & jnp.isfinite(errors), gaps


def _bounded(
    A: Float[Array, "k k"], values: Complex[Array, " k"], errors: Float[Array, " k"]
) -> Float[Array, " k"]:
    """Errors of defective eigenvalues by the size of their Jordan block, for which they are inf.

    Eigenvalues of a block of size m move with the power 1/m of a perturbation.
    """
    values = stop_gradient(values)
    norm, rounding = _norm(A), A.shape[0] * jnp.finfo(A.dtype).eps
    near = jnp.abs(values - values[:, None]) <= norm * rounding ** (1.0 / MOST)
    block = jnp.clip(jnp.sum(near, 1), 2, MOST).astype(A.dtype)
    return jnp.minimum(errors, norm * rounding ** (1.0 / block))


def _norm(A: Float[Array, "k k"]) -> Float[Array, ""]:
    """Largest sum of a row."""
    return jnp.max(jnp.sum(jnp.abs(A), 1))


def _bordered(
    A: Float[Array, "k k"],
    values: Complex[Array, " k"],
    vectors: Complex[Array, "k k"],
    simple: Bool[Array, " k"],
) -> Complex[Array, "k k+1 k+1"]:
    """[[A - lambda I, -x], [c, 0]] of every pair, c x = x's largest entry.

    If the eigenvalue is not simple, I that changes with A: then second derivatives are NaN, too.
    """
    k = A.shape[0]
    one = jnp.eye(k, dtype=vectors.dtype)

    def of(value: Array, x: Array) -> Array:
        c = one[jnp.argmax(jnp.abs(x))]
        above = jnp.concatenate([as_complex(A) - value * one, -x[:, None]], 1)
        return jnp.concatenate([above, jnp.append(c, jnp.zeros_like(value))[None]])

    moving = as_complex(1.0 + jnp.sum(A - jax.lax.stop_gradient(A)))
    regular = moving * jnp.eye(k + 1, dtype=vectors.dtype)
    return jnp.where(simple[:, None, None], jax.vmap(of, (0, 1))(values, vectors), regular)


def _nan_unless(known: Bool[Array, " k"], x: Complex[Array, "k j"]) -> Complex[Array, "k j"]:
    """x; NaN in rows that are unknown, unless all of a row is 0. It is its own transpose.

    A product with NaN would not leave zeros as they are: then reverse derivatives of all pairs were
    NaN.
    """

    def solve(_: Any, x: Array) -> Array:
        none = jnp.all(x == 0, 1)
        return jnp.where((known | none)[:, None], x, jnp.nan)

    return jax.lax.custom_linear_solve(lambda x: x, x, solve, solve, symmetric=True)
