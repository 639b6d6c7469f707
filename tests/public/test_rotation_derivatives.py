"""Derivatives of rotations, in batches and in single precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _rotations import ALL, COUNT, EPS, batch, every, principal, worst

from jaxlag import rotation
from jaxlag.rotation import quaternion, yaw_pitch_roll, zxz


def functions(p):
    """Functions of x alone; x_dot and w are fixed, coordinates of matrices vary along rotations."""

    def x_dot(x):
        return jnp.array([0.3, -0.8, 0.5, 1.1], x.dtype)[: len(p.names)]

    def w(x):
        return jnp.array([0.7, -0.2, 0.4], x.dtype)

    return {
        "matrix": p.matrix,
        "body_rates": lambda x: p.body_rates(x, x_dot(x)),
        "space_rates": lambda x: p.space_rates(x, x_dot(x)),
        "body_rate_matrix": p.body_rate_matrix,
        "from_body_rates": lambda x: p.from_body_rates(x, w(x)),
        "from_space_rates": lambda x: p.from_space_rates(x, w(x)),
        "from_matrix": lambda x: p.from_matrix(p.matrix(x)),
    }


@every
@pytest.mark.parametrize("name", mostly_full(functions(zxz), "from_matrix", "from_space_rates"))
def test_derivatives_agree_with_central_differences(kind, name):
    p, h = ALL[kind], 1e-5
    function = functions(p)[name]
    x = principal(kind, np.random.default_rng(18), 20)
    forward, reverse = batch(lambda x: (jax.jacfwd(function)(x), jax.jacrev(function)(x)), x)
    steps = h * np.concatenate([np.eye(x.shape[1]), -np.eye(x.shape[1])])
    ahead, behind = np.split(batch(jax.vmap(function), x + steps[:, None]), 2)
    differences = np.moveaxis(ahead - behind, 0, -1) / (2 * h)
    scale = np.max(np.abs(forward))
    assert worst(forward, reverse) <= 8 * EPS * scale  # worst 3
    # h^2/6 of the third derivative, at most 6/0.2^2 times the first one, and EPS/h of the values.
    atol = (h**2 / 0.2**2 + 10 * EPS / h) * scale
    assert worst(forward, differences) <= atol
    assert scale > 0.1


@every
def test_from_matrix_is_differentiable_along_rotations(kind):
    """d/dt from_matrix(R) = from_body_rates(x, w) for R_dot = R [w]x."""
    p, rng = ALL[kind], np.random.default_rng(19)
    x, w = principal(kind, rng), rng.normal(size=(COUNT, 3))

    def moved(x, w):
        R = p.matrix(x)
        return jax.jvp(p.from_matrix, (R,), (R @ rotation.skew(w),))[1]

    assert worst(batch(moved, x, w), batch(p.from_body_rates, x, w)) <= 50 * EPS  # worst 16


def by_parametrization(p, x, a, b):
    x_dot = p.from_body_rates(x, a)
    rates = x_dot, p.from_space_rates(x, a), p.body_rates(x, x_dot), p.space_rates(x, x_dot)
    return p.matrix(x), p.from_matrix(p.matrix(x)), p.body_rate_matrix(x), rates


def by_matrix(p, x, a, b):
    R = rotation.compose(rotation.about_x(a[0]), rotation.about_y(a[1]), rotation.about_z(a[2]))
    R_dot = R @ rotation.skew(b)
    return (
        rotation.direction_cosines(R),
        rotation.body_rates(R, R_dot),
        rotation.space_rates(R, R_dot),
        rotation.unskew(R),
    )


def by_quaternion(p, x, a, b):
    return p.multiply(x, p.conjugate(jnp.concatenate([a, b[:1]])))


@pytest.mark.parametrize(
    ("kind", "function"),
    [
        *((kind, by_parametrization) for kind in ALL),
        ("zxz", by_matrix),
        ("quaternion", by_quaternion),
    ],
)
def test_float32_results_agree_with_float64(kind, function):
    p, rng = ALL[kind], np.random.default_rng(20)
    x = principal(kind, rng, 50).astype(np.float32)
    a, b = rng.normal(size=(2, 50, 3)).astype(np.float32)
    single = batch(lambda *given: function(p, *given), x, a, b)
    double = batch(lambda *given: function(p, *given), *(z.astype(float) for z in (x, a, b)))
    eps = float(np.finfo(np.float32).eps)
    for found, expected in zip(jax.tree.leaves(single), jax.tree.leaves(double), strict=True):
        assert (found.dtype, expected.dtype) == (np.float32, np.float64)
        # As in double precision: |a|, |b| <= 5 and 1/|det W| <= 5.
        assert worst(found, expected) <= 25 * eps  # worst 5.5


@every
def test_float32_gradients_stay_float32(kind):
    x = jnp.asarray(principal(kind, np.random.default_rng(21), 1)[0], jnp.float32)
    for function in functions(ALL[kind]).values():
        gradient = jax.eval_shape(jax.grad(lambda x, f=function: jnp.sum(f(x))), x)
        assert gradient.dtype == jnp.float32


def test_numbers_and_lists_are_accepted():
    expected = np.asarray(zxz.matrix(np.array([1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(zxz.matrix([1, 2, 3]), expected)
    np.testing.assert_array_equal(zxz.matrix((1.0, 2, 3.0)), expected)
    np.testing.assert_array_equal(rotation.skew([1, 2, 3]), [[0, -3, 2], [3, 0, -1], [-2, 1, 0]])


def test_parametrizations_have_names_of_coordinates():
    assert yaw_pitch_roll.names == ("psi", "theta", "phi")
    assert zxz.names == ("phi", "theta", "psi")
    assert quaternion.names == ("e0", "e1", "e2", "e3")
