"""Motions in closed form that several systems share: (q, v) at t from (q0, v0) at t = 0.

Their derivatives by JAX are exact to rounding.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import block_diag, expm
from jax.typing import ArrayLike

_LANDEN = 7
"""Number of Landen's transformations: they reduce the modulus below 1e-16 for m up to 0.9999."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)
_PIECES = 8


def accelerated(t: Array, q0: Array, v0: Array, a: Array) -> tuple[Array, Array]:
    """Motion with a constant acceleration a, shape (n,)."""
    return q0 + v0 * t + 0.5 * a * t**2, v0 + a * t


def oscillating(
    t: Array,
    q0: Array,
    v0: Array,
    M: Array,
    C: Array,
    K: Array,
    f: Array,
    F: Array,
    w: ArrayLike,
) -> tuple[Array, Array]:
    """Motion of M q'' + C q' + K q = f + F cos(w t), by one matrix exponential.

    It acts on (q, v, 1, cos(w t), sin(w t)). M, C and K are (n, n), f and F are (n,).
    """
    n = len(f)
    rates = jnp.linalg.solve(M, jnp.column_stack([-K, -C, f, F, 0.0 * F]))
    forms = jnp.concatenate([jnp.eye(n, 2 * n + 3, n), rates])
    rotation = w * jnp.array([[0.0, -1.0], [1.0, 0.0]])
    forcing = block_diag(jnp.zeros((1, 1)), rotation)
    whole = jnp.concatenate([forms, jnp.pad(forcing, ((0, 0), (2 * n, 0)))])
    y = expm(t * whole) @ jnp.concatenate([q0, v0, jnp.array([1.0, 1.0, 0.0])])
    return y[:n], y[n : 2 * n]


def swinging(t: Array, q0: Array, v0: Array, rate: Array) -> tuple[Array, Array]:
    """Motion of theta'' = -rate^2 sin(theta) without full turns.

    sin(theta/2) = k sn(rate t + s), cos(theta/2) = dn and theta' = 2 rate k cn. The addition
    theorem accounts for the start s, so that only k^2 is needed, not k and s.
    """
    theta, p = q0[0], v0[0] / (2 * rate)
    s0, c0 = jnp.sin(theta / 2), jnp.cos(theta / 2)
    sn, cn, dn = _jacobi(rate * t, s0**2 + p**2)
    below = 1 - (sn * s0) ** 2
    s = (sn * p * c0 + s0 * cn * dn) / below
    d = (dn * c0 - sn * cn * s0 * p) / below
    c = (cn * p - s0 * c0 * sn * dn) / below
    return 2 * jnp.arctan2(s, d)[None], 2 * rate * c[None]


def integral(function: Callable[[Array], Array], t: Array) -> Array:
    """Integral of function(t) from 0 to t, by Gauss-Legendre with 20 points in each of 8 pieces.

    It is exact to rounding for the functions here.

    `function` maps times of any shape to values of the same shape.
    """
    edges = np.arange(_PIECES)[:, None]
    places = (edges + 0.5 * (1 + _NODES)) / _PIECES
    return 0.5 * t / _PIECES * jnp.sum(function(t * places) @ _WEIGHTS)


def _jacobi(u: Array, m: Array) -> tuple[Array, Array, Array]:
    """(sn, cn, dn) of parameter m = k^2 below 1."""
    a, b, ratios = jnp.ones_like(m), jnp.sqrt(1 - m), []
    for _ in range(_LANDEN):
        a, b, c = 0.5 * (a + b), jnp.sqrt(a * b), 0.5 * (a - b)
        ratios.append(c / a)
    angle = 2**_LANDEN * a * u
    for ratio in reversed(ratios):
        angle = 0.5 * (angle + jnp.arcsin(ratio * jnp.sin(angle)))
    sn = jnp.sin(angle)
    return sn, jnp.cos(angle), jnp.sqrt(1 - m * sn**2)
