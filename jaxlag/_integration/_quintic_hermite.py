"""Quintic Hermite interpolation of a state within a step, or slightly beyond it."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def hermite(
    t0: Float[Array, ""],
    y0: Float[Array, " m"],
    f0: Float[Array, " m"],
    t1: Float[Array, ""],
    y1: Float[Array, " m"],
    f1: Float[Array, " m"],
    t: Float[Array, ""],
    n: int,
) -> Float[Array, " m"]:
    """Hermite interpolation: coordinates by a polynomial of degree 5, velocities by its derivative.

    The polynomial has the coordinates, velocities and accelerations of both ends. With h = t1 - t0
    and x = (t - t0) / h the error of coordinates is h^6 x^3 (x - 1)^3 / 720 times their sixth
    derivative. Integrals use a cubic: their error is h^4 x^2 (x - 1)^2 / 24 times the fourth.

    Args:
        t0: one end.
        y0: (q, v, integrals) there.
        f0: dy/dt there.
        t1: the other end.
        y1: as y0.
        f1: as f0.
        t: time of the state.
        n: number of coordinates.
    """
    h = (t1 - t0).astype(y0.dtype)
    x = ((t - t0) / (t1 - t0)).astype(y0.dtype)
    q0, v0, v1 = y0[:n], h * y0[n : 2 * n], h * y1[n : 2 * n]
    a0, a1 = h**2 * f0[n : 2 * n], h**2 * f1[n : 2 * n]
    a, b, c = y1[:n] - q0 - v0 - 0.5 * a0, v1 - v0 - a0, a1 - a0
    c3, c4, c5 = 10 * a - 4 * b + 0.5 * c, -15 * a + 7 * b - c, 6 * a - 3 * b + 0.5 * c
    q = q0 + x * (v0 + x * (0.5 * a0 + x * (c3 + x * (c4 + x * c5))))
    v = (v0 + x * (a0 + x * (3 * c3 + x * (4 * c4 + x * 5 * c5)))) / h
    w0, w1, s0, s1 = y0[2 * n :], y1[2 * n :], h * f0[2 * n :], h * f1[2 * n :]
    gain = w1 - w0
    w = w0 + x * (s0 + x * ((3 * gain - 2 * s0 - s1) + x * (s0 + s1 - 2 * gain)))
    return jnp.concatenate([q, v, w])
