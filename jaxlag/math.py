"""Elementary functions with correct derivatives at their singular points.

JAX differentiates |x|, sqrt, atan2 and the like to NaN or infinity where a mechanism is stretched
out or a spring has no length, and one NaN makes the whole acceleration NaN, even times zero. Here
values and derivatives, in every mode and of every order, are the limits if limits exist, and
otherwise follow a convention:

| function             | singular point  | value       | 1st, 2nd, 3rd derivative | these are   |
|----------------------|-----------------|-------------|--------------------------|-------------|
| `norm(x)`            | x = 0           | 0           | 0, 0, 0                  | convention  |
| `unit(x)`            | x = 0           | 0           | 0, 0, 0                  | convention  |
| `angle_between(a, b)`| a parallel to b | 0 or pi     | 0, 0, 0                  | convention  |
|                      | a = 0 or b = 0  | 0           | 0, 0, 0                  | convention  |
| `sqrt(x)`            | x = 0           | 0           | 0, 0, 0                  | convention  |
| `atan2(y, x)`        | y = x = 0       | +-0 or +-pi | 0, 0, 0                  | convention  |
| `acos(x)`            | x = 1, x = -1   | 0, pi       | 0, 0, 0                  | convention  |
| `asin(x)`            | x = +-1         | +-pi/2      | 0, 0, 0                  | convention  |
| `sinc(x)`            | x = 0           | 1           | 0, -1/3, 0               | the limits  |
| `cosc(x)`            | x = 0           | 1/2         | 0, -1/12, 0              | the limits  |
| `sinc_sqrt(z)`       | z = 0           | 1           | -1/6, 1/60, -1/840       | the limits  |
| `cosc_sqrt(z)`       | z = 0           | 1/2         | -1/24, 1/360, -1/6720    | the limits  |

A convention holds for the function itself, not for compositions: `norm(x)**2` and
`sinc(norm(x))` are smooth, but their second derivatives at x = 0 are computed as 0. Write functions
of the square directly: `x @ x`, `sinc_sqrt(x @ x)`.

Scalars act element by element, vectors along the last axis. The dtype is that of the arguments;
integers become the default float, complex numbers raise a ValueError.
"""

from functools import cache
from math import factorial, perm
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from jaxlag._core._custom_jvp import CustomJVP
from jaxlag._core._errors import invalid
from jaxlag._tracing._nonsmooth_points import smooth

# Of the Taylor series of sin(x)/x in z = x^2. Up to |z| = 4 the first omitted term is below eps
# of the sum, also in each of its first three derivatives; beyond, the quotient loses few digits.
_SINC_TERMS = 13
_SINC_SERIES_BELOW = 4.0


@smooth
def norm(x: Any) -> Float[Array, "..."]:
    """Euclidean length |x| = sqrt(sum x_i^2), without intermediate overflow and underflow.

    The derivative is x/|x|; the k-th is of order |x|^(1 - k), correct if it can be represented.
    At x = 0 none exists: all are 0 there, and the first is the smallest subgradient. A spring of
    unstretched length l0 is `k/2 * (r @ r - 2 * l0 * norm(r) + l0**2)`, not `(norm(r) - l0)**2`.

    Args:
        x: shape (..., n), any unit.

    Returns:
        Shape (...), in the unit of x.

    Raises:
        ValueError: x is a scalar, or complex.

    Source: Higham, Accuracy and Stability of Numerical Algorithms, ch. 27 (scaling by max|x_i|).
    """
    return _norm(_vector("norm: x", x))


@smooth
def unit(x: Any) -> Float[Array, "..."]:
    """Direction x/|x|, dimensionless, in the shape of x; at x = 0 it and its derivatives are 0.

    Args:
        x: shape (..., n), any unit.

    Raises:
        ValueError: x is a scalar, or complex.

    Source: d(x/|x|) = (1 - u u^T) dx/|x|, the Hessian of `norm`.
    """
    return _unit(_vector("unit: x", x))


@smooth
def angle_between(a: Any, b: Any) -> Float[Array, "..."]:
    """Angle in [0, pi] between two vectors, rad: atan2(|a ^ b|, a . b), to some eps everywhere.

    |a ^ b|^2 = sum_(i<j) (a_i b_j - a_j b_i)^2, the cross product in three dimensions. For parallel
    vectors no derivative exists, as for |x| at 0: all are 0 there. Vectors count as parallel if
    every difference above is within 4 eps of its two products, so b = c a does for every c. For a
    zero vector the angle and its derivatives are 0.

    Args:
        a: shape (..., n), any unit.
        b: shape (..., n), any unit.

    Returns:
        Shape (...), rad.

    Raises:
        ValueError: a or b is a scalar or complex, or their numbers of components differ.

    Source: Lagrange's identity, |a|^2 |b|^2 = (a . b)^2 + |a ^ b|^2.
    """
    a, b = _vector("angle_between: a", a), _vector("angle_between: b", b)
    if a.shape[-1] != b.shape[-1]:
        was = f"they had {a.shape[-1]} and {b.shape[-1]}"
        raise invalid("angle_between: a and b", "have the same number of components", was)
    (a, _), (b, _) = _scaled(a), _scaled(b)
    i, j = np.triu_indices(a.shape[-1], 1)
    left, right = a[..., i] * b[..., j], a[..., j] * b[..., i]
    across, along = left - right, jnp.sum(a * b, axis=-1)
    rounding = 4 * jnp.finfo(across.dtype).eps * (jnp.abs(left) + jnp.abs(right))
    parallel = jnp.all(jnp.abs(across) <= rounding, axis=-1)
    across = jnp.where(parallel[..., None], 0.0, across)
    nothing = parallel & (along == 0)  # the sum may be -0, at an angle of pi
    return atan2(_norm(across), jnp.where(nothing, 0.0, along))


def sqrt(x: Any) -> Float[Array, "..."]:
    """Square root; at x = 0 its derivatives, infinite from the right, are 0; NaN for x < 0.

    Args:
        x: any shape and unit.

    Source: d sqrt(x) = dx/(2 sqrt(x)).
    """
    x = _real("sqrt: x", x)
    zero = x == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, x)))


@smooth
def atan2(y: Any, x: Any) -> Float[Array, "..."]:
    """Angle of the point (x, y) from the x axis, rad, in [-pi, pi]: y = r sin, x = r cos.

    Axes, the branch at y = +-0 with x < 0, and the origin are as in numpy, by the signs of zero.
    The k-th derivative is of order r^-k, correct if it can be represented; all are 0 at r = 0.

    Args:
        y: any shape and unit.
        x: the same unit, a shape compatible with that of y.

    Source: d atan2 = (x dy - y dx)/(x^2 + y^2), taken of (x, y)/max(|x|, |y|).
    """
    y, x = _real("atan2: y", y), _real("atan2: x", x)
    y_value, x_value = stop_gradient(y), stop_gradient(x)
    origin = (y == 0) & (x == 0)
    scale = _scale(jnp.maximum(jnp.abs(y_value), jnp.abs(x_value)))
    angle = jnp.arctan2(jnp.where(origin, 1.0, y) / scale, jnp.where(origin, 1.0, x) / scale)
    return jnp.where(origin, jnp.arctan2(y_value, x_value), angle)


def acos(x: Any) -> Float[Array, "..."]:
    """Inverse cosine in [0, pi], rad; at x = +-1 derivatives are 0; NaN for |x| > 1.

    Args:
        x: any shape, dimensionless.

    Source: atan2(sqrt((1 - x) (1 + x)), x), which keeps its digits near x = 1.
    """
    x = _real("acos: x", x)
    return jnp.arctan2(sqrt((1 - x) * (1 + x)), x)


def asin(x: Any) -> Float[Array, "..."]:
    """Inverse sine in [-pi/2, pi/2], rad; at x = +-1 derivatives are 0; NaN for |x| > 1.

    Args:
        x: any shape, dimensionless.

    Source: atan2(x, sqrt((1 - x) (1 + x))), whose derivatives keep their digits near x = +-1.
    """
    x = _real("asin: x", x)
    return jnp.arctan2(x, sqrt((1 - x) * (1 + x)))


@smooth
def sinc(x: Any) -> Float[Array, "..."]:
    """sin(x)/x, NOT sin(pi x)/(pi x) as in numpy; 1 at x = 0. Smooth and even.

    Args:
        x: any shape, rad. Not `norm(w)`: see `sinc_sqrt`.

    Source: Taylor series for |x| < 2, the quotient beyond.
    """
    x = _real("sinc: x", x)
    small = jnp.abs(x) < _SINC_SERIES_BELOW**0.5
    away = jnp.where(small, 1.0, x)
    return jnp.where(small, _sinc_series(0)(jnp.where(small, x, 0.0) ** 2), jnp.sin(away) / away)


@smooth
def sinc_sqrt(z: Any) -> Float[Array, "..."]:
    """sin(x)/x as a function of z = x^2; smooth at z = 0, NaN for z <= -4.

    With z = w @ w it is the even, smooth factor in the rotation by the vector w,
    R = 1 + sinc_sqrt(z) [w]x + cosc_sqrt(z) [w]x^2, with correct derivatives at w = 0. Between
    -4 and 0 it is sinh(y)/y with y^2 = -z.

    Args:
        z: any shape, rad^2.

    Source: Taylor series for z < 4, the quotient beyond; R is Rodrigues' formula.
    """
    z = _real("sinc_sqrt: z", z)
    small = jnp.abs(z) < _SINC_SERIES_BELOW
    x = jnp.sqrt(jnp.where(small, 1.0, z))
    return jnp.where(small, _sinc_series(0)(jnp.where(small, z, 0.0)), jnp.sin(x) / x)


def one_minus_cos(x: Any) -> Float[Array, "..."]:
    """1 - cos(x) = 2 sin(x/2)^2, to full relative accuracy for small x.

    Args:
        x: any shape, rad.

    Source: half-angle formula.
    """
    return 2.0 * jnp.sin(0.5 * _real("one_minus_cos: x", x)) ** 2


@smooth
def cosc(x: Any) -> Float[Array, "..."]:
    """(1 - cos(x))/x^2 = sinc(x/2)^2/2; 1/2 at x = 0. Smooth and even.

    Args:
        x: any shape, rad. Not `norm(w)`: see `cosc_sqrt`.

    Source: half-angle formula.
    """
    return 0.5 * sinc(0.5 * _real("cosc: x", x)) ** 2


@smooth
def cosc_sqrt(z: Any) -> Float[Array, "..."]:
    """(1 - cos(x))/x^2 as a function of z = x^2, as `sinc_sqrt`; NaN for z <= -16.

    Args:
        z: any shape, rad^2.

    Source: half-angle formula.
    """
    return 0.5 * sinc_sqrt(0.25 * _real("cosc_sqrt: z", z)) ** 2


def _real(argument: str, x: Any) -> Array:
    # float() keeps a Python number weakly typed: it takes the dtype of the arrays in an operation.
    x = jnp.asarray(float(x) if isinstance(x, int) else x)
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise invalid(argument, "be real", f"its dtype was {x.dtype}")
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def _vector(argument: str, x: Any) -> Array:
    x = _real(argument, x)
    if x.ndim == 0:
        raise invalid(argument, "be a vector", "it was a scalar")
    return x


def _scale(largest: Array) -> Array:
    """`largest` if it can be a divisor, else 1."""
    return jnp.where((largest > 0) & (largest < jnp.inf), largest, 1.0)


def _scaled(x: Array) -> tuple[Array, Array]:
    """x/s and s = max|x|, which is not differentiated."""
    scale = _scale(jnp.max(jnp.abs(stop_gradient(x)), axis=-1, keepdims=True, initial=0.0))
    return x / scale, scale


# With custom rules, since the chain rule through the scaling contains |x|^-2 in the second
# derivative of |x|, of order 1/|x|, and overflows. Those of |x| for n = 1 are exact.
@CustomJVP
def _norm(x: Array) -> Array:
    scaled, scale = _scaled(x)
    return scale[..., 0] * sqrt(jnp.sum(scaled**2, axis=-1))


@_norm.defjvp
def _norm_rule(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    return _norm(x), jnp.sum(_unit(x) * dx, axis=-1)


@CustomJVP
def _unit(x: Array) -> Array:
    scaled, _ = _scaled(x)
    length = sqrt(jnp.sum(scaled**2, axis=-1, keepdims=True))
    return scaled / jnp.where(length == 0, 1.0, length)


@_unit.defjvp
def _unit_rule(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    u, length = _unit(x), _norm(x)[..., None]
    zero = length == 0
    across = jnp.where(zero, 0.0, dx - u * jnp.sum(u * dx, axis=-1, keepdims=True))
    return u, across / jnp.where(zero, 1.0, length)


# With a custom rule, as differentiating the sum costs many times the sum of the derivatives.
@cache
def _sinc_series(order: int) -> CustomJVP:
    """d^order/dz^order of sum_k (-z)^k/(2k + 1)!, by nested multiplication."""

    @CustomJVP
    def series(z: Array) -> Array:
        total = jnp.zeros_like(z)
        for k in reversed(range(order, order + _SINC_TERMS)):
            total = (-1) ** k * perm(k, order) / factorial(2 * k + 1) + z * total
        return total

    @series.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        (z,), (dz,) = primals, tangents
        return series(z), _sinc_series(order + 1)(z) * dz

    return series
