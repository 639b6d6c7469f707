"""Sine and cosine without branches or calls.

On CPU, XLA computes the sine of a double by a call of the C library, and the sines of a row by one
call after another. These calls take most of the time of a solve of a pendulum. A polynomial is
inlined, and is vectorized for a row of numbers.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxlag._core._custom_jvp import CustomJVP

# pi in parts: 33 bits, 33 bits and the rest, so that multiples of the first two are exact up to
# 2^20.
_PI = (3.1415926534682512, 1.2154201012607932e-10, 4.044532497591901e-21)

# sin r = r + r^3 (S0 + S1 r^2 + ...) to 5e-18 |sin r| and cos r = 1 - r^2/2 + r^4 (C0 + C1 r^2 +
# ...) to 1.3e-17, |r| <= pi/2: minimax polynomials, by Remez' exchange algorithm.
_SINE = (
    -0.16666666666666666,
    0.008333333333333194,
    -0.00019841269841209218,
    2.7557319211137343e-06,
    -2.5052106872809704e-08,
    1.605893970629013e-10,
    -7.642991499610401e-13,
    2.7211750705284894e-15,
)
_COSINE = (
    0.04166666666666583,
    -0.001388888888883005,
    2.4801587285783927e-05,
    -2.755731706850842e-07,
    2.087659259221951e-09,
    -1.1463635426834132e-11,
    4.616134911812934e-14,
)

# pi/2 plus the effect of the rounding of x/pi on r; past 2^53 r is only rounding.
_MOST = 1.6

# The sum with an integer below 2^51 is a number whose last bit is that of the integer.
_INTEGER = 1.5 * 2.0**52


@CustomJVP
def sincos(x: Float[Array, "*s"]) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
    """(sin x, cos x); NaN for infinite x.

    On CPU in float64 by Cody and Waite's reduction modulo pi and polynomials. Up to |x| = 1e6 the
    sine is within 2 eps |sin x| of the exact value and the cosine within 2 eps. Up to 1e13 both
    are exact for an x that differs by 2 eps |x|. For larger x the results become meaningless, but
    stay within [-1, 1].

    Source: Cody, Waite, Software Manual for the Elementary Functions (1980), ch. 8.
    """
    if x.dtype == jnp.float64 and jax.default_backend() == "cpu":
        return by_polynomials(x)
    return lax.sin(x), lax.cos(x)


@sincos.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple:
    (x,), (x_dot,) = primals, tangents
    s, c = sincos(x)
    return (s, c), (c * x_dot, -s * x_dot)


@CustomJVP
def recalled(x: Array, s: Array, c: Array) -> tuple[Array, Array]:
    """(sin x, cos x) = (s, c), from an earlier evaluation."""
    return s, c


@recalled.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    (_, s, c), (x_dot, _, _) = primals, tangents
    return recalled(*primals), (c * x_dot, -s * x_dot)


@jax.jit
def by_polynomials(x: Array) -> tuple[Array, Array]:
    """(-1)^n (sin r, cos r), r = x - n pi."""
    n = lax.round(x * (1.0 / np.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    r = x
    for part in _PI:
        r = r - n * part
    r = lax.clamp(-_MOST, r, _MOST)
    z = r * r
    sign = _parity(n)
    # The sign is available before the sine's polynomial.
    r = sign * r
    s = lax.clamp(-1.0, r + (r * z) * _polynomial(_SINE, z), 1.0)  # rounding may exceed 1
    c = (1.0 - 0.5 * z) + (z * z) * _polynomial(_COSINE, z)
    return s, sign * c


def _parity(n: Array) -> Array:
    """(-1)^n, by bits of numbers."""
    odd = lax.shift_left(_bits(n + _INTEGER), np.uint64(63))
    return lax.bitcast_convert_type(lax.bitwise_xor(_bits(jnp.ones_like(n)), odd), n.dtype)


def _bits(x: Array) -> Array:
    return lax.bitcast_convert_type(x, jnp.uint64)


def _polynomial(coefficients: Sequence[float], z: Array) -> Array:
    """sum_i c_i z^i in pairs, pairs of pairs, ... (Estrin's scheme): the shortest chain."""
    terms: list = list(coefficients)
    while len(terms) > 1:
        pairs = zip(terms[::2], terms[1::2], strict=False)
        terms = [a + b * z for a, b in pairs] + terms[2 * (len(terms) // 2) :]
        z = z * z
    return terms[0]
