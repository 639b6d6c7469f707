"""Linear least squares with bounds, for few unknowns.

    min |R z - c|^2,  low <= z <= high

Block principal pivoting: unknowns beyond a bound are set to it, and unknowns at a bound with a
gradient that points inside are released, until neither remains. If this makes no progress, one
unknown at a time is exchanged, which always terminates (Portugal, Judice, Vicente, A comparison of
block pivoting and interior-point algorithms for linear least squares problems with nonnegative
variables, Math. Comp. 63, 1994).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

PATIENCE = 3
"""Consecutive block exchanges that may fail to reduce the number of infeasible unknowns."""
ROUNDS = 10
"""Exchanges per unknown, a bound that only rounding could reach."""


def box_least_squares(
    R: Float[Array, "p p"],
    c: Float[Array, " p"],
    low: Float[Array, " p"],
    high: Float[Array, " p"],
) -> Float[Array, " p"]:
    """The minimum.

    Args:
        R: upper triangular, regular.
        c: the right-hand side.
        low: lower bounds, -inf for none; if both are equal, that is the unknown's value.
        high: likewise.
    """
    p, eps = R.shape[0], jnp.finfo(R.dtype).eps
    if not p:
        return c
    given = low == high
    # Smaller gradients are rounding.
    size = 10 * p * eps * jnp.linalg.norm(R, axis=0) * jnp.linalg.norm(c)

    def at_limits(side: Array) -> Array:
        return jnp.where(side < 0, low, jnp.where(side > 0, high, 0.0))

    def solved(side: Array) -> Array:
        """Unknowns at a bound (-1, 1) are set to it, the others (0) follow by least squares."""
        held = side != 0
        known = at_limits(side)
        rows = jnp.concatenate([jnp.where(held, 0.0, R), jnp.diag(jnp.where(held, 1.0, 0.0))])
        right = jnp.append(c - R @ known, jnp.zeros(p, R.dtype))
        triangle = jnp.linalg.qr(jnp.concatenate([rows, right[:, None]], axis=1), mode="r")
        return jnp.where(held, known, solve_triangular(triangle[:p, :p], triangle[:p, -1]))

    def wrong(side: Array, z: Array) -> Array:
        """The new side (-1, 0, 1) of infeasible unknowns; 2 for those that stay."""
        slope = R.T @ (R @ z - c)
        free = jnp.where(z < low, -1, jnp.where(z > high, 1, 2))
        held = jnp.where(-side * slope < -size, 0, 2)
        return jnp.where(given, 2, jnp.where(side == 0, free, held))

    def cond_fun(carry: tuple[Array, Array, Array, Array, Array]) -> Array:
        *_, goal, _, iteration = carry
        return jnp.any(goal != 2) & (iteration < ROUNDS * p)

    def exchanged(carry: tuple[Array, Array, Array, Array, Array]) -> Any:
        side, _, goal, (best, patience), iteration = carry
        count = jnp.sum(goal != 2)
        better = count < best
        patience = jnp.where(better, PATIENCE, patience - 1)
        last = jnp.arange(p) == p - 1 - jnp.argmax((goal != 2)[::-1])
        moves = (goal != 2) & ((patience >= 0) | last)
        side = jnp.where(moves, goal, side)
        z = solved(side)
        left = jnp.stack([jnp.minimum(best, count), patience])
        return side, z, wrong(side, z), left, iteration + 1

    side = jnp.where(given, -1, 0)
    first = jax.lax.cond(jnp.any(given), solved, lambda _: solve_triangular(R, c), side)
    init = side, first, wrong(side, first), jnp.array([p + 1, PATIENCE]), jnp.array(0)
    _, z, *_ = jax.lax.while_loop(cond_fun, exchanged, init)
    return jnp.clip(z, low, high)
