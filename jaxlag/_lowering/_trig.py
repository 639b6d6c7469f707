"""Sine and cosine of one argument together, without branches: for rows of numbers.

On CPU, XLA computes the sine of a row of doubles by one call of the library after another; a
polynomial is computed on the whole row at once.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

# pi/2 in parts: 33 bits, 33 bits and the rest, so that multiples of the first two are exact up
# to 2^20.
_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)

# sin r = r + r^3 (S0 + S1 r^2 + ...) and cos r = 1 - r^2/2 + r^4 (C0 + C1 r^2 + ...), |r| <= pi/4,
# to less than one rounding: coefficients of FreeBSD's msun (k_sin.c, k_cos.c).
_SINE = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COSINE = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)


@jax.custom_jvp
def sincos(x: Float[Array, "*s"]) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
    """(sin x, cos x); NaN for infinite x.

    On CPU in float64 by Cody and Waite's reduction modulo pi/2 and a polynomial: within 2 eps of
    the exact values up to |x| = 1e5, and up to 1e13 of those of an x that is off by 2 eps |x|.
    Past 1e16 nothing of x is left but rounding; the results stay within [-1, 1].

    Source: Cody, Waite, Software Manual for the Elementary Functions (1980), ch. 8.
    """
    if x.dtype == jnp.float64 and jax.default_backend() == "cpu":
        return _polynomial(x)
    return lax.sin(x), lax.cos(x)


@sincos.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple:
    (x,), (x_dot,) = primals, tangents
    s, c = sincos(x)
    return (s, c), (c * x_dot, -s * x_dot)


@jax.custom_jvp
def recalled(x: Array, s: Array, c: Array) -> tuple[Array, Array]:
    """(sin x, cos x) = (s, c), found before."""
    return s, c


@recalled.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    (_, s, c), (x_dot, _, _) = primals, tangents
    return recalled(*primals), (c * x_dot, -s * x_dot)


def _polynomial(x: Array) -> tuple[Array, Array]:
    n = lax.round(x * (2.0 / np.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    r = x
    for part in _HALF_PI:
        r = r - n * part
    r = lax.clamp(-1.0, r, 1.0)  # past 2^53 nothing is left of r but rounding
    quadrant = n - 4.0 * lax.floor(0.25 * n)
    z = r * r
    s = r + r * z * _horner(_SINE, z)
    c = 1.0 - 0.5 * z + z * z * _horner(_COSINE, z)
    odd = (quadrant == 1.0) | (quadrant == 3.0)
    sine, cosine = lax.select(odd, c, s), lax.select(odd, s, c)
    negative = quadrant >= 2.0
    return (
        lax.select(negative, -sine, sine),
        lax.select(negative ^ odd, -cosine, cosine),
    )


def _horner(coefficients: tuple[float, ...], z: Array) -> Array:
    total = coefficients[-1] * z + coefficients[-2]
    for c in reversed(coefficients[:-2]):
        total = total * z + c
    return total
