"""Quintic Hermite interpolation of a state within a step, or slightly beyond it."""

from typing import Any

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
    curved: Float[Array, "2 k"] | None = None,
) -> Float[Array, " m"]:
    """Hermite interpolation: coordinates by a polynomial of degree 5, velocities by its derivative.

    The polynomial has the coordinates, velocities and accelerations of both ends. With h = t1 - t0
    and s = (t - t0) / h the error of coordinates is h^6 s^3 (s - 1)^3 / 720 times their sixth
    derivative. The same holds for states x beside (q, v), by their first and second derivatives.
    Integrals use a cubic, with an error of h^4 s^2 (s - 1)^2 / 24 times their fourth derivative.

    Args:
        t0: one end.
        y0: (q, v, x, integrals) there.
        f0: dy/dt there.
        t1: the other end.
        y1: as y0.
        f1: as f0.
        t: time of the state.
        n: number of coordinates.
        curved: (2, k), d2x/dt2 at both ends; None without states.
    """
    h = (t1 - t0).astype(y0.dtype)
    s = ((t - t0) / (t1 - t0)).astype(y0.dtype)

    def quintic(x: Any, dx: Any, ddx: Any) -> tuple[Array, Array]:
        """(x, dx/ds) at s, from (x, dx/dt, d2x/dt2) at both ends."""
        (x0, x1), (v0, v1), (a0, a1) = x, (h * u for u in dx), (h**2 * u for u in ddx)
        a, b, c = x1 - x0 - v0 - 0.5 * a0, v1 - v0 - a0, a1 - a0
        c3, c4, c5 = 10 * a - 4 * b + 0.5 * c, -15 * a + 7 * b - c, 6 * a - 3 * b + 0.5 * c
        value = x0 + s * (v0 + s * (0.5 * a0 + s * (c3 + s * (c4 + s * c5))))
        return value, v0 + s * (a0 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))

    ends, slopes, m = (y0, y1), (f0, f1), 2 * n
    q, hv = quintic([y[:n] for y in ends], [y[n:m] for y in ends], [f[n:m] for f in slopes])
    found = [q, hv / h]
    if curved is not None:
        m += curved.shape[1]
        own = slice(2 * n, m)
        found.append(quintic([y[own] for y in ends], [f[own] for f in slopes], curved)[0])
    (w0, w1), (s0, s1) = (y[m:] for y in ends), (h * f[m:] for f in slopes)
    gain = w1 - w0
    found.append(w0 + s * (s0 + s * ((3 * gain - 2 * s0 - s1) + s * (s0 + s1 - 2 * gain))))
    return jnp.concatenate(found)
