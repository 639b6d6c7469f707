"""Sizes and residuals of constraint rows, and the bounds up to which a row counts as satisfied.

A residual c of a row is compared as |c| / size / (1 + max |x|): over the size of the row and of
the state, phi with x = q and A v + b with x = v. The size is the length of the row; for a row that
is rounding at the state, its rate of change (`row_sizes`).

| check | bound |
| --- | --- |
| a start: phi, A v + b | eps^1/2, `dependence_floor`: measured starts have few digits |
| a start: the part that the independent rows leave | eps^3/4, `closed_to` |
| a start: A a + gamma that they leave | eps^1/2 of its terms, and their rounding |
| saved states, if kinematics satisfy the rows | eps^1/2 |
| a step: rows left out as dependent | eps^3/4, and 100 times the drift of the others |
| accelerations: rows left out as dependent | eps^1/3 of x and gamma, and the rounding of all rows |
| assembly | half of eps^3/4, so that a start passes |
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._linalg._mass_solve import rank_floor
from jaxlag._linalg._rounding_bounds import with_rounding, with_scatter

ROUNDINGS = 16
"""Multiple of the rounding of a row up to which the row counts as zero."""


class Sizes(NamedTuple):
    """Sizes of the constraint rows.

    Attributes:
        nonzero: rows that are more than rounding.
        void: rows that are rounding here and nearby: 0 = 0 for every motion.
        size: their lengths. For rows that are rounding, their rate of change, or the size of their
            terms if that is larger.
    """

    nonzero: Bool[Array, " m"]
    void: Bool[Array, " m"]
    size: Float[Array, " m"]


def row_sizes(
    rows: Callable[[Array], Array],
    q: Float[Array, " n"],
    A: Float[Array, "m e"],
    sure: bool = False,
) -> Sizes:
    """The rows that are more than rounding, and the sizes of all rows.

    At a dead point, where rows vanish, sin(pi) leaves a meaningless 1e-16. Such a value changes
    with a few roundings of the coordinates, and of all intermediate results.

    Args:
        rows: A as a function of q, all columns or those that may differ from zero.
        q: coordinates.
        A: rows(q).
        sure: whether no row is void, so that roundings of the coordinates are sufficient.
    """
    eps, at = float(jnp.finfo(q.dtype).eps), np.arange(q.shape[0])
    small = eps**0.25
    signs = jnp.asarray([(-1.0) ** at, (-1.0) ** (at // 2)], q.dtype)
    places = jax.lax.stop_gradient(jnp.concatenate([q[None], q[None] + small * signs]))
    if sure:
        places = jnp.concatenate([places, q[None] + ROUNDINGS * eps * signs * jnp.abs(places[:1])])
        changes = row_lengths(jax.vmap(rows)(places[1:]) - jax.lax.stop_gradient(A)[None])
        growth, rounding = jnp.max(changes[:2], axis=0) / small, jnp.max(changes[2:], axis=0)
        norms = row_lengths(A)
        nonzero = (norms != 0) & ~(norms <= rounding)
        size = jnp.where(nonzero, norms, growth)
        return Sizes(nonzero, norms < 0, jnp.where(size > 0, size, 1.0))
    found, rounding = jax.vmap(partial(with_rounding, rows))(places)
    rounding, norms = row_lengths(rounding), row_lengths(A)
    growth = row_lengths(found[1:] - jax.lax.stop_gradient(A)[None])
    # Unknown rounding, as of derivatives beside the end of a domain, does not exclude the row.
    nonzero = (norms != 0) & ~(norms <= ROUNDINGS * rounding[0])
    void = ~nonzero & jnp.all(growth <= ROUNDINGS * (rounding[:1] + rounding[1:]), axis=0)
    made_of = jnp.max(jnp.nan_to_num(rounding), axis=0) / eps
    size = jnp.where(nonzero, norms, jnp.maximum(jnp.max(growth, axis=0) / small, made_of))
    return Sizes(nonzero, void, jnp.where(size > 0, size, 1.0))


def without_rounding(
    residuals: Callable[..., tuple[Array, ...]],
    void: Bool[Array, " m"],
    size: Float[Array, " m"],
    *args: Array,
) -> tuple[Array, ...]:
    """Residuals of rows; 0 for void rows if they are no more than rounding.

    The residual of such a row does not depend on the state: its changes nearby are rounding.

    Args:
        residuals: of all rows, as functions of `args`.
        void: rows, see `row_sizes`.
        size: of the rows.
        args: coordinates, velocities.
    """
    found, scatter = with_scatter(residuals, *args)
    least = float(jnp.finfo(size.dtype).eps) * size
    return tuple(
        jnp.where(void & (jnp.abs(c) <= ROUNDINGS * jnp.maximum(less, least)), 0.0, c)
        for c, less in zip(found, scatter, strict=True)
    )


def relative_residual(
    c: Float[Array, " m"], size: Float[Array, " m"], x: Float[Array, " n"]
) -> Float[Array, " m"]:
    """|c| / size / (1 + max |x|).

    Args:
        c: residuals of rows.
        size: of the rows, see `row_sizes`.
        x: coordinates for phi, velocities for A v + b.
    """
    return jnp.abs(c) / size / (1.0 + jnp.max(jnp.abs(x)))


def row_lengths(A: Float[Array, "*k m n"]) -> Float[Array, "*k m"]:
    """Lengths of rows; derivatives of rows that vanish are 0. NaN stays NaN."""
    square = jnp.sum(A**2, axis=-1)
    return jnp.where(square == 0, 0.0, jnp.sqrt(jnp.where(square == 0, 1.0, square)))


def redundant_rows_hold(
    A: Float[Array, "m n"],
    x: Float[Array, " n"],
    gamma: Callable[..., Array],
    state: tuple[Array, Array, Array],
    sizes: Sizes,
    force: Float[Array, " n"],
    units: Float[Array, " n"],
) -> Bool[Array, ""]:
    """Whether A x + gamma = 0 for all rows, including those left out as dependent.

    The tolerance is the angle below which a row counts as dependent, in units of the coordinates,
    plus the rounding of gamma, of any row, and of the accelerations by forces that
    reactions cancel.

    Args:
        A: rows.
        x: an acceleration that satisfies some of them.
        gamma: of (t, q, v).
        state: (t, q, v).
        sizes: of the rows, see `row_sizes`.
        force: Q - h.
        units: of the coordinates, in which their inertias are 1.
    """
    eps = float(jnp.finfo(A.dtype).eps)
    c, rounding = with_rounding(gamma, *state)
    lengths = row_lengths(A * units[None])
    size = jnp.where(sizes.nonzero & (lengths > 0), lengths, sizes.size * jnp.max(units))
    scale = jnp.max(jnp.abs(x / units)) + jnp.max(jnp.abs(c) / size)
    allowed = rank_floor(A.dtype) ** 0.5 * scale + 1e3 * eps * jnp.max(jnp.abs(units * force))
    # The rounding of x from the solved rows appears in the others.
    rounding = jnp.nan_to_num(rounding)
    allowed += ROUNDINGS * jnp.max(jnp.where(sizes.nonzero, rounding / size, 0.0))
    allowed = allowed * size + ROUNDINGS * rounding
    return jnp.all(jnp.abs(A @ x + c) <= allowed)
