"""Linear least squares of many segments: states are eliminated in turn, params last.

    min  sum_k |E_k x_k + F_k p - r_k|^2 + sum_k |A_k x_k + B_k p - W x_{k+1} - g_k|^2
         + |P p - c|^2 + damping (|p|^2 + sum_k |x_k|^2)

The first sum holds the measurements of segment k, with x_k the state at its start. The second sum
joins its end to the start of the next segment. The third term is the prior of the params. An
orthogonal matrix transforms the rows with x_k so that only d of them contain it. The remaining
rows contain x_{k+1} and p. The work is linear in the number of segments, and no condition
number is squared (square-root information filter: Bierman, Factorization Methods for Discrete
Sequential Estimation, 1977, ch. V and VI).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float


class LinearRows(NamedTuple):
    """Rows of the problem; the last column of each is the right-hand side.

    Attributes:
        measured: (k, m, d + p + 1), of x_k, p and the right-hand side.
        joined: (k, d, d + p + 1), likewise; None if no segment is joined to another.
        next: (k, d), the diagonal of W; zero for segments that are not joined to the next.
        prior: (c, p + 1), of p and the right-hand side.
    """

    measured: Float[Array, "k m c"]
    joined: Float[Array, "k d c"] | None
    next: Float[Array, "k d"] | None
    prior: Float[Array, "c e"]


class ReducedRows(NamedTuple):
    """The rows after the elimination.

    Attributes:
        states: (k, d, d + d + p + 1), upper triangular rows of x_k, x_{k+1}, p, right-hand side.
        params: (p + 1, p + 1), the upper triangular rows of p with the right-hand side.
    """

    states: Float[Array, "k d c"]
    params: Float[Array, "e e"]


def _triangle(rows: Float[Array, "*k m c"]) -> Float[Array, "*k c c"]:
    """R of the rows' QR factors, square: with rows of zeros if there are fewer rows."""
    *_, m, c = rows.shape
    if m < c:
        rows = jnp.concatenate([rows, jnp.zeros((*rows.shape[:-2], c - m, c), rows.dtype)], -2)
    return jnp.linalg.qr(rows, mode="r")


def condense(rows: LinearRows) -> LinearRows:
    """The same problem with as many measured rows as columns, for repeated damping."""
    return rows._replace(measured=_triangle(rows.measured), prior=_triangle(rows.prior))


def sizes_of(rows: LinearRows) -> Float[Array, " c"]:
    """Norms of the columns of one state, the params and the right-hand side, all rows together."""
    d = rows.measured.shape[-1] - rows.prior.shape[-1]
    squares = jnp.sum(rows.measured**2, axis=(0, 1))
    if rows.joined is not None:
        squares += jnp.sum(rows.joined**2, axis=(0, 1))
    return jnp.sqrt(squares.at[d:].add(jnp.sum(rows.prior**2, axis=0)))


def eliminate(
    rows: LinearRows, damping: Float[Array, ""], weights: Float[Array, " p"] | None = None
) -> ReducedRows:
    """The triangular rows of condensed problems: params and states follow by substitution.

    Args:
        rows: of the problem.
        damping: damping of all unknowns.
        weights: factors of its root for params.
    """
    count, _, columns = rows.measured.shape
    size = rows.prior.shape[1]
    d, dtype = columns - size, rows.measured.dtype
    root = jnp.sqrt(damping)
    held = jnp.concatenate([root * jnp.eye(d, dtype=dtype), jnp.zeros((d, size), dtype)], 1)
    weak = root * jnp.eye(size - 1, size, dtype=dtype)
    if weights is not None:
        weak = weights[:, None] * weak
    about = jnp.concatenate([rows.prior, weak])
    if rows.joined is None or rows.next is None:
        both = jnp.concatenate([rows.measured, jnp.broadcast_to(held, (count, d, columns))], 1)
        triangle = _triangle(both)
        states = jnp.insert(triangle[:, :d], jnp.full(d, d), 0.0, axis=2)
        rest = triangle[:, d:, d:].reshape(-1, size)
        return ReducedRows(states, _triangle(jnp.concatenate([about, rest])))

    def spread(x: Array) -> Array:
        """Zeros in the columns of the next state."""
        return jnp.concatenate([x[:, :d], jnp.zeros((x.shape[0], d), dtype), x[:, d:]], 1)

    def one(carry: tuple[Array, Array], row: tuple[Array, Array, Array]) -> Any:
        known, params = carry
        measured, joined, following = row
        join = spread(joined).at[:, d : 2 * d].set(-jnp.diag(following))
        triangle = _triangle(jnp.concatenate([join, *map(spread, (known, measured, held))]))
        state, later, rest = triangle[:d], triangle[d : 2 * d], triangle[2 * d :, 2 * d :]
        return (later[:, d:], _triangle(jnp.concatenate([params, rest]))), state

    start = jnp.zeros((d, columns), dtype), _triangle(about)
    (left, params), states = jax.lax.scan(one, start, (rows.measured, rows.joined, rows.next))
    # The last segment is not joined: the remaining rows contain p alone.
    return ReducedRows(states, _triangle(jnp.concatenate([params, left[:, d:]])))


def states_of(left: ReducedRows, p: Float[Array, " p"]) -> Float[Array, "k d"]:
    """The least-squares states x for the params p."""
    d = left.states.shape[1]

    def back(later: Array, row: Array) -> tuple[Array, Array]:
        known = row[:, -1] - row[:, d : 2 * d] @ later - row[:, 2 * d : -1] @ p
        x = solve_triangular(row[:, :d], known)
        return x, x

    _, states = jax.lax.scan(back, jnp.zeros(d, left.states.dtype), left.states, reverse=True)
    return states
