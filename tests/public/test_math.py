"""Values and derivatives to third order at, near and far from singular points.

Smooth functions are compared with their power series in exact rational arithmetic, the others with
closed forms. Tolerances are in units of EPS, about twice the largest error measured.
"""

import math as stdlib
from fractions import Fraction
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _ladders import EPS, ONE_EACH, close, each, ladder, of_pair
from numpy.testing import assert_allclose, assert_array_equal

import jaxlag._model._coordinates
from jaxlag import math

ELEMENTWISE = ("sqrt", "acos", "asin", "sinc", "sinc_sqrt", "one_minus_cos", "cosc", "cosc_sqrt")


# ---- Singular points ---------------------------------------------------------------------------

PI = np.pi
TABLE = {
    "sqrt": {0.0: (0, 0, 0, 0)},
    "acos": {1.0: (0, 0, 0, 0), -1.0: (PI, 0, 0, 0)},
    "asin": {1.0: (PI / 2, 0, 0, 0), -1.0: (-PI / 2, 0, 0, 0)},
    "sinc": {0.0: (1, 0, -1 / 3, 0)},
    "cosc": {0.0: (1 / 2, 0, -1 / 12, 0)},
    "sinc_sqrt": {0.0: (1, -1 / 6, 1 / 60, -1 / 840)},
    "cosc_sqrt": {0.0: (1 / 2, -1 / 24, 1 / 360, -1 / 6720)},
    "one_minus_cos": {0.0: (0, 0, 1, 0)},
}


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_scalar_functions_are_right_at_singular_points(name):
    for point, expected in TABLE[name].items():
        for values, value in zip(ladder(getattr(math, name))(point), expected, strict=True):
            close(values, value, 2)


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("function", [math.norm, math.unit])
def test_vector_functions_are_zero_at_zero(function, n):
    for values in ladder(function)(jnp.zeros(n)):
        assert_array_equal(values, 0.0)


@pytest.mark.parametrize("y", [0.0, -0.0])
@pytest.mark.parametrize("x", [0.0, -0.0])
def test_atan2_at_the_origin_has_zero_derivatives(y, x):
    value, *derivatives = ladder(of_pair("atan2"))(jnp.array([y, x]))
    assert_array_equal(value, np.arctan2(y, x))
    assert_array_equal(np.signbit(value), np.signbit(np.arctan2(y, x)))
    for values in derivatives:
        assert_array_equal(values, 0.0)


def test_functions_of_jax_fail_at_singular_points():
    zero = jnp.zeros(2)
    assert np.all(np.isnan(jax.hessian(jnp.linalg.norm)(zero)))
    assert np.all(np.isnan(jax.grad(lambda x: jnp.sqrt(x @ x))(zero)))
    assert np.isinf(jax.grad(jnp.sqrt)(0.0))
    assert np.isinf(jax.grad(jnp.arccos)(1.0))
    assert np.isinf(jax.grad(jnp.arcsin)(1.0))
    assert np.isnan(jax.grad(jnp.arctan2)(0.0, 0.0))
    assert not np.isfinite(jax.grad(jnp.arctan2)(1e-200, 1e-200))
    assert jax.grad(jnp.arctan2)(1e200, 1e200) == 0  # 5e-201
    assert jnp.linalg.norm(jnp.array([1e-200, 0.0])) == 0
    assert np.isnan(jax.grad(lambda x: jnp.sin(x) / x)(0.0))
    assert abs((1 - jnp.cos(1e-7)) / math.one_minus_cos(1e-7) - 1) > 1e-4  # cancellation


# ---- Smooth functions --------------------------------------------------------------------------


def series(coefficient, x, order):
    """d^order/dx^order of sum_k coefficient(k) x^k, summed as a fraction."""
    x, total = Fraction(float(x)), Fraction(0)
    for k in range(order, 90):
        total += coefficient(k) * stdlib.perm(k, order) * x ** (k - order)
    return float(total)


def even(coefficient):
    """Coefficients in x if `coefficient` is that in z = x^2."""
    return lambda k: Fraction(0) if k % 2 else coefficient(k // 2)


def of_sinc(k):
    return Fraction((-1) ** k, stdlib.factorial(2 * k + 1))


def of_cosc(k):
    return Fraction((-1) ** k, stdlib.factorial(2 * k + 2))


def of_one_minus_cos(k):
    return of_cosc(k - 1) if k else Fraction(0)


def around(threshold):
    inside = np.nextafter(threshold, 0)
    return [1e-300, 1e-160, 1e-8, 1e-3, 0.1, 0.5, 1.0, 1.5, 0.99 * threshold, inside, threshold]


# Name, coefficients, end of the series, tolerance of each order in EPS: twice the largest error
# measured. A large tolerance belongs to a derivative with a zero near one of the points.
SMOOTH = [
    ("sinc", even(of_sinc), 2.0, (2, 2, 32, 6)),
    ("cosc", even(of_cosc), 4.0, (3, 3, 10, 20)),
    ("sinc_sqrt", of_sinc, 4.0, (2, 2, 4, 30)),
    ("cosc_sqrt", of_cosc, 16.0, (3, 3, 6, 10)),
    ("one_minus_cos", even(of_one_minus_cos), 1.0, (3, 2, 11, 2)),
]


@pytest.mark.parametrize(
    ("name", "coefficient", "threshold", "worst"), mostly_full(SMOOTH, SMOOTH[0], SMOOTH[3])
)
def test_smooth_functions_are_accurate_to_third_order(name, coefficient, threshold, worst):
    """Relative errors of series and quotient, on both sides of the threshold."""
    x = np.array([*around(threshold), 1.01 * threshold, 1.1 * threshold, 5.0])
    if not name.endswith("sqrt"):
        x = np.concatenate([x, -x])
    for order, values in enumerate(each(getattr(math, name), x)):
        expected = [series(coefficient, point, order) for point in x]
        close(values, expected, worst[order], scale=1e-300)


def test_functions_of_the_square_are_hyperbolic_below_zero():
    y = np.array([0.1, 1.0, 1.9])
    assert_allclose(math.sinc_sqrt(-(y**2)), np.sinh(y) / y, rtol=4 * EPS)
    assert_allclose(math.cosc_sqrt(-(y**2)), 2 * np.sinh(y / 2) ** 2 / y**2, rtol=4 * EPS)
    assert np.isnan(math.sinc_sqrt(-4.0))
    assert np.isnan(math.cosc_sqrt(-16.0))


@pytest.mark.full
def test_rotation_by_a_vector_is_smooth_at_zero():
    """R(w) e = e + w x e + w x (w x e)/2 + w x (w x (w x e))/6 + ...: the exponential series."""
    e, direction = jnp.array([1.0, -2.0, 0.5]), jnp.array([0.3, 0.7, -0.2])

    def rotated(s):
        w = s * direction
        z, once = w @ w, jnp.cross(w, e)
        return e + math.sinc_sqrt(z) * once + math.cosc_sqrt(z) * jnp.cross(w, once)

    expected = np.asarray(e)
    for values in ladder(rotated)(0.0):
        assert_allclose(values, np.broadcast_to(expected, values.shape), atol=4 * EPS)
        expected = np.cross(direction, expected)


def test_conventions_do_not_carry_over_to_composed_functions():
    """As documented, for |x|^2 and sinc(|x|), whose Hessians at 0 are 2 and -1/3 times 1."""
    zero = jnp.zeros(2)
    assert_array_equal(jax.hessian(lambda x: math.norm(x) ** 2)(zero), 0.0)
    assert_array_equal(jax.hessian(lambda x: x @ x)(zero), 2 * np.eye(2))
    assert_array_equal(jax.hessian(lambda x: math.sinc(math.norm(x)))(zero), 0.0)
    hessian = jax.hessian(lambda x: math.sinc_sqrt(x @ x))(zero)
    assert_allclose(hessian, -np.eye(2) / 3, rtol=2 * EPS)


# ---- Roots and inverse functions ---------------------------------------------------------------


def test_sqrt_is_accurate_at_all_sizes():
    """Largest errors 0.5, 0.6, 1.6 and 2.1 EPS; the third derivative is of order x^(-5/2)."""
    x = np.array([1e-120, 1e-100, 1e-8, 0.1, 1.0, 2.0, 3e8, 1e120])
    root = np.sqrt(x)
    expected = root, 0.5 / root, -0.25 / root / x, 0.375 / root / x / x
    for values, value in zip(each(math.sqrt, x), expected, strict=True):
        close(values, value, 6)
    assert_array_equal(math.sqrt(np.array([1e-300, 1e300, np.inf])), [1e-150, 1e150, np.inf])
    for values in ladder(math.sqrt)(-1.0):
        assert np.all(np.isnan(values))


def inverse_cosine(x):
    d = (1 - x) * (1 + x)
    return np.arccos(x), -(d**-0.5), -x * d**-1.5, -(1 + 2 * x**2) * d**-2.5


def test_acos_and_asin_are_accurate_up_to_the_ends():
    """Largest relative errors 0.8, 1.2, 2.8 and 5 EPS; absolute near x = 0, a zero of both."""
    d = np.array([2.0**-53, 1e-15, 1e-12, 1e-8, 1e-4, 0.1, 0.5])
    x = np.concatenate([1 - d, d - 1, [0.3, 1e-3, 1e-160, 0.0]])
    expected = inverse_cosine(x)
    cosines, sines = each(math.acos, x), each(math.asin, x)
    for order in range(4):
        scale = 1.0 if order == 2 else 0.0
        close(cosines[order], expected[order], 10, scale)
        close(sines[order], -expected[order] if order else np.arcsin(x), 10, scale)
    for function in (math.acos, math.asin):
        for values in each(function, [1.5, -1.5, np.nan]):
            assert np.all(np.isnan(values))


# ---- Length and direction ----------------------------------------------------------------------


def derivatives_of_length(x):
    """|x|, u, (1 - u u)/r and -(sum of P_ij u_k over the three pairs)/r^2 with P = 1 - u u."""
    scale = np.abs(x).max()
    r = scale * np.sqrt(np.sum((x / scale) ** 2))
    u = x / r
    P = np.eye(len(x)) - np.outer(u, u)
    T = np.einsum("ij,k->ijk", P, u)
    with np.errstate(over="ignore"):
        return r, u, P / r, -(T + np.einsum("ikj->ijk", T) + np.einsum("kji->ijk", T)) / r / r


@pytest.mark.parametrize("n", [2, 3])
def test_length_is_accurate_to_third_order(n):
    """Largest error 3 EPS |x|^(1 - k)."""
    rng = np.random.default_rng(n)
    derivatives = ladder(math.norm)
    for size in (1e-150, 1e-100, 1e-8, 1e-3, 1.0, 1e8, 1e150, 1e200, 1e300):
        x = size * rng.normal(size=n)
        expected = derivatives_of_length(x)
        for order, (values, value) in enumerate(zip(derivatives(x), expected, strict=True)):
            close(values, value, 6, scale=expected[0] ** float(1 - order))


@pytest.mark.parametrize("size", [1e-307, 1e-300, 1e-200, 1e-160])
def test_length_of_tiny_vectors_is_accurate_to_second_order(size):
    """The third derivative, of order |x|^-2, overflows."""
    x = size * np.array([1.0, 2.0, 2.0])
    expected = derivatives_of_length(x)
    for order, values in enumerate(ladder(math.norm)(x)[:3]):
        close(values, expected[order], 6, scale=expected[0] ** float(1 - order))


def test_length_of_one_component_is_the_absolute_value():
    for x in (3e-150, -0.1, 7.0, -1e200):
        value, first, second, third = ladder(math.norm)(jnp.array([x]))
        assert_array_equal(value, abs(x))
        assert_array_equal(first, np.full_like(first, np.sign(x)))
        assert_array_equal(second, 0.0)
        assert_array_equal(third, 0.0)


def test_direction_is_the_derivative_of_length():
    rng = np.random.default_rng(0)
    derivatives = ladder(math.unit)
    for size in (1e-150, 1e-8, 1.0, 1e8, 1e150):
        x = size * rng.normal(size=3)
        r, *expected = derivatives_of_length(x)
        for order, values in enumerate(derivatives(x)[:3]):
            close(values, expected[order], 6, scale=r ** float(-order))


def test_length_of_empty_and_nonfinite_vectors_follows_numpy():
    assert_array_equal(math.norm(np.zeros((2, 0))), np.zeros(2))
    assert_array_equal(math.norm([np.inf, 1.0]), np.inf)
    assert np.isnan(math.norm([np.nan, 1.0]))


@pytest.mark.parametrize("x", [[0.0, 0.0], [0.3, -0.4]])
@pytest.mark.parametrize(
    "function",
    [
        lambda v: math.norm(v) * v,
        lambda v: math.unit(v) * jnp.sum(v**2),
        lambda v: math.sqrt(v**4),
        lambda v: jnp.stack([math.atan2(v[0], v[1]) * v[0] ** 2, v[1]]),
        lambda v: math.angle_between(v, jnp.array([1.0, 2.0])) * v,
    ],
    ids=["norm", "unit", "sqrt", "atan2", "angle_between"],
)
def test_second_derivatives_within_a_loop_are_right(function, x):
    """There JAX may skip a derivative rule and differentiate the body of the function."""
    x = jnp.array(x)

    def loop(v):
        return jax.lax.scan(lambda v, _: (function(v), None), v, None, length=2)[0]

    expected = jax.jacfwd(jax.jacfwd(lambda v: function(function(v))))(x)
    for outer in (jax.jacfwd, jax.jacrev):
        for inner in (jax.jacfwd, jax.jacrev):
            found = outer(inner(loop))(x)
            assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


def test_energy_of_a_spring_has_derivatives_at_zero_length():
    """V = k/2 (r.r - 2 l0 |r| + l0^2) at r = 0: with l0 > 0 the term in |r| has no effect."""

    def energy(r, rest):
        return 7.0 / 2 * (r @ r - 2 * rest * math.norm(r) + rest**2)

    for rest in (0.0, 0.5):
        V, force, stiffness, third = ladder(lambda r, rest=rest: energy(r, rest))(jnp.zeros(3))
        assert_array_equal(V, 7.0 / 2 * rest**2)
        assert_array_equal(force, 0.0)
        assert_array_equal(stiffness, np.broadcast_to(7.0 * np.eye(3), stiffness.shape))
        assert_array_equal(third, 0.0)
    # Stretched: k along the spring, k (1 - l0/|r|) across.
    stiffness = jax.hessian(energy)(jnp.array([2.0, 0.0, 0.0]), 0.5)
    assert_allclose(stiffness, 7.0 * np.diag([1.0, 0.75, 0.75]), rtol=4 * EPS)


# ---- Batches and dtypes ------------------------------------------------------------------------

BATCHES = {
    "sqrt": [4.0, 0.0, 1e-8, 9.0],
    "acos": [0.5, 1.0, -1.0, -0.25],
    "asin": [0.5, 1.0, -1.0, -0.25],
    "sinc": [0.5, 0.0, 1e200, 3.0],
    "sinc_sqrt": [0.5, 0.0, -1.0, 1e200],
    "cosc": [0.5, 0.0, 1e100, 9.0],
    "cosc_sqrt": [0.5, 0.0, -1.0, 17.0],
    "one_minus_cos": [0.5, 0.0, 3.0, 9.0],
    "norm": [[3.0, 4.0], [0.0, 0.0], [1e-9, 0.0], [1e100, 1e100]],
    "unit": [[3.0, 4.0], [0.0, 0.0], [1e-9, 0.0], [1e100, 1e100]],
    "atan2": [[3.0, 4.0], [0.0, 0.0], [0.0, -1.0], [1e100, 1e100]],
    "angle_between": [[[1.0, 0.0], [0.0, 2.0]], [[0.0, 0.0], [1.0, 2.0]], [[1.0, 2.0], [3.0, 6.0]]],
}


def of_one_argument(name):
    function = getattr(math, name)
    return of_pair(name) if name in ("atan2", "angle_between") else function


@cache
def together(function):
    """One derivative of each order of a batch: the first axis of each order has length one."""
    return jax.jit(jax.vmap(ladder(function, ONE_EACH), out_axes=1))


def test_every_function_has_a_batch():
    public = {name for name in vars(math) if not name.startswith("_")}
    own = {n for n in public if getattr(vars(math)[n], "__module__", "") == math.__name__}
    assert own == set(BATCHES)


@pytest.mark.parametrize("name", mostly_full(BATCHES, "angle_between", "norm", "sinc"))
def test_singular_point_in_a_batch_does_not_affect_others(name):
    """Nor does a large argument: each value equals the single one."""
    x, function = np.array(BATCHES[name]), of_one_argument(name)
    batch = [values[0] for values in together(function)(x)]
    for i, point in enumerate(x):
        for values, alone in zip(batch, ladder(function)(point), strict=True):
            close(values[i], alone[-1], 8, scale=np.abs(alone).max())
    if name not in ("atan2", "angle_between"):  # batches without vmap
        close(getattr(math, name)(x), jax.vmap(getattr(math, name))(x), 2)


@pytest.mark.parametrize("name", mostly_full(BATCHES, "angle_between", "norm", "sinc"))
def test_float32_stays_float32(name):
    """Against double precision at the same points."""
    x = np.clip(np.array(BATCHES[name]), -1e8, 1e8).astype(np.float32)
    derivatives = together(of_one_argument(name))
    for single, double in zip(derivatives(x), derivatives(x.astype(float)), strict=True):
        assert single.dtype == jnp.float32
        for values, value in zip(single[0], double[0].astype(jnp.float32), strict=True):
            close(values, value, 40, scale=np.abs(value).max())


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_numbers_and_integers_are_promoted(name):
    function = getattr(math, name)
    for one in (1, 1.0, np.arange(1, 2), jnp.array(1)):
        assert function(one).dtype == jnp.float64
        assert_array_equal(np.ravel(function(one)), function(jnp.array(1.0)))
    for number in (1, 1.0):  # takes the dtype of the other operand, as in jnp
        assert (function(number) * jnp.float32(2)).dtype == jnp.float32
    with jax.enable_x64(False):
        assert function(np.arange(1, 2)).dtype == jnp.float32


def test_numbers_and_integers_in_vectors_and_pairs_are_promoted():
    assert_array_equal(math.norm([3, 4]), 5.0)
    assert_array_equal(math.unit(np.array([0, 4])), [0.0, 1.0])
    assert_array_equal(math.angle_between([1, 0], [0, 1]), PI / 2)
    assert_array_equal(math.atan2(1, jnp.float32(0)), np.float32(PI / 2))
    assert math.atan2(1.0, jnp.float32(0)).dtype == jnp.float32
    assert_array_equal(math.atan2(0, -1), PI)


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_complex_numbers_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}: `.` must be real, but its dtype was complex128"):
        getattr(math, name)(1j)


def test_invalid_vectors_are_refused():
    for function in (math.norm, math.unit):
        with pytest.raises(ValueError, match="`x` must be a vector, but it was a scalar"):
            function(1.0)
    with pytest.raises(ValueError, match="`b` must be a vector"):
        math.angle_between([1.0, 0.0], 1.0)
    with pytest.raises(ValueError, match="same number of components, but they had 2 and 1"):
        math.angle_between([1.0, 0.0], [1.0])
    with pytest.raises(ValueError, match="atan2: `x` must be real"):
        math.atan2(1.0, 1j)


def test_module_does_not_hide_the_standard_library():
    """Modules that import math get the standard library's."""
    assert jaxlag._model._coordinates.math is stdlib
    assert stdlib is not math
