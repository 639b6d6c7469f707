"""Advice on the constraint rows at one state: dependent, void or singular rows."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag._linalg._kkt import units_of

EVEN = 0.25
"""Difference of a residual on two sides, over their sum, up to which it counts as even."""
SINGULAR = 1e-2
"""Least sine over that nearby, below which rows count as almost dependent at a state."""
NEARBY = 1e-2
"""Distance of the states for comparison, over 1 + |q|."""


def advice_on_rows(system: Any, params: Any, t: Any, q: Any, dependent: bool = True) -> str:
    """Advice on singular rows at a state; "" if there are none.

    Args:
        system: its rows are examined.
        params: as the Lagrangian takes them.
        t: time, s.
        q: coordinates, (n,), m or rad.
        dependent: whether to report rows that are dependent at this state alone, too.
    """
    vanishing = vanishing_rows(system, params, t, q)
    if vanishing:
        return (
            f"The gradient of {', '.join(map(repr, vanishing))} vanishes wherever the row holds, "
            "as for y**2, a length, or 1 - cos(y): such a row defines neither velocities nor a "
            "reaction. Write the quantity itself, y; for a length, each component."
        )
    if dependent and is_singular(system, params, t, q):
        return (
            "Rows are nearly dependent there: a dead point or a change point, where no tolerance "
            "helps and the motion may have more than one continuation. Start beyond it, or add a "
            "row that selects one branch."
        )
    return ""


def vanishing_rows(system: Any, params: Any, t: Any, q: Any) -> list[str]:
    """Holonomic rows with an extremum of value 0 here, as squares and lengths have."""
    if not system.constraints:
        return []
    t, q = jnp.asarray(t, float), jnp.asarray(q)
    rows = system._rows(params, q.dtype)
    here = np.flatnonzero(rows.holonomic)
    if not len(here) or not np.all(np.isfinite(q)):
        return []

    @jax.jit
    def around(far: Array) -> tuple[Array, Array, Array, Array]:
        """Residuals here, on both sides, and their first order."""

        def position(q: Array) -> Array:
            return system._terms.position(t, q, params)

        ahead, behind = (jax.vmap(position)(q[None] + step) for step in (far, -far))
        return position(q), ahead, behind, jax.vmap(jax.linearize(position, q)[1])(far)

    vanish, regular = np.zeros((2, len(here)), bool)
    for power in (0.375, 0.25, 0.125, 0.0625):
        far = float(jnp.finfo(q.dtype).eps) ** power * _ways(q)
        middle, ahead, behind, first = map(np.asarray, around(far))
        both = ahead + behind
        largest = np.max(np.abs([*ahead, *behind, middle]), axis=0)
        one_sign = np.all(both >= 0, axis=0) | np.all(both <= 0, axis=0)
        even = np.all(np.abs(ahead - behind) <= EVEN * np.abs(both) + 1e-3 * largest, axis=0)
        # Of (x + y)^2 the first order 2 x y is at most half of the even part, wherever x is.
        regular |= np.any(np.abs(first) > np.abs(both), axis=0)
        vanish |= one_sign & even & (largest > 0) & (np.abs(middle) <= EVEN * largest) & ~regular
    return [rows.labels[i] for i in here[vanish]]


def is_singular(system: Any, params: Any, t: Any, q: Any) -> bool:
    """Whether rows that are independent nearby are almost dependent here."""
    if not system.constraints:
        return False
    t, q = jnp.asarray(t, float), jnp.asarray(q)

    def sizes(q: Array) -> Array:
        v = jnp.zeros_like(q)
        A = system._terms.rows(t, q, v, params)[0]
        A = A * units_of(system._terms.mass(t, q, v, params), A)[None]
        norms = jnp.linalg.norm(A, axis=1, keepdims=True)
        return jnp.linalg.svd(A / jnp.where(norms > 0, norms, 1.0), compute_uv=False)

    places = jnp.concatenate([q[None], q[None] + NEARBY * _ways(q)])
    here, *nearby = np.asarray(jax.jit(jax.vmap(sizes))(places))
    if not np.all(np.isfinite(here)):
        return False
    usual = np.max(nearby, axis=0)
    independent = usual > float(jnp.finfo(q.dtype).eps) ** 0.5
    return bool(np.any(independent & (here < SINGULAR * usual)))


def _ways(q: Array) -> Array:
    """A few directions of length 1 + |q|."""
    draw = np.random.default_rng(0).uniform(0.3, 1.0, (4, q.shape[0]))
    signs = np.where(np.arange(q.shape[0])[None] % np.arange(1, 5)[:, None], -1.0, 1.0)
    return jnp.asarray(draw * signs, q.dtype) * (1.0 + jnp.abs(q))
