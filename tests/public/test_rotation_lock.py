"""Rotations at gimbal lock and near it, and quaternions of extreme norms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _rotations import ANGLES, EPS, LOCK, batch, every_angles, worst

from jaxlag import rotation
from jaxlag.rotation import quaternion, zxz


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("frame", ["body", "space"])
@every_angles
def test_at_gimbal_lock_two_rates_are_not_finite(kind, frame, dtype):
    """Also at the nearest representable angles, and for w of a finite x_dot."""
    p, rng = ANGLES[kind], np.random.default_rng(16)
    lock = np.pi * np.arange(-4, 5) + (np.pi / 2 if kind == "yaw_pitch_roll" else 0.0)
    x = rng.uniform(-np.pi, np.pi, (len(lock), 3)).astype(dtype)
    x[:, 1] = lock
    x_dot, w = rng.normal(size=(2, *x.shape)).astype(dtype)
    reachable = batch(getattr(p, f"{frame}_rates"), x, x_dot)
    invert = getattr(p, f"from_{frame}_rates")
    for rates in (reachable, w, np.zeros_like(w)):
        found = batch(invert, x, rates)
        assert found.dtype == dtype
        assert not np.any(np.isfinite(found[:, [0, 2]]))
    theta_dot = batch(invert, x, reachable)[:, 1]
    assert worst(theta_dot, x_dot[:, 1]) <= 12 * np.finfo(dtype).eps  # worst 3, |w| <= 6
    slope = batch(jax.jacfwd(invert), x, reachable)[:, [0, 2], 1]
    assert not np.any(np.isfinite(slope))


@every_angles
def test_near_gimbal_lock_the_error_grows_as_its_inverse_distance(kind):
    p, rng = ANGLES[kind], np.random.default_rng(17)
    lock = np.pi / 2 if kind == "yaw_pitch_roll" else 0.0
    theta = lock - np.repeat(10.0 ** np.arange(-1.0, -15.0, -1.0), 50)
    x = rng.uniform(-np.pi, np.pi, (len(theta), 3))
    x[:, 1] = theta
    x_dot = rng.normal(size=x.shape)

    def round_trip(x, x_dot):
        return (
            p.from_body_rates(x, p.body_rates(x, x_dot)),
            p.from_space_rates(x, p.space_rates(x, x_dot)),
        )

    determinant = np.abs(LOCK[kind](theta))[:, None]
    for found in batch(round_trip, x, x_dot):
        # Each w is |x_dot| <= 8 times some roundings, divided by the determinant.
        assert worst((found - x_dot) * determinant, 0) <= 8 * EPS  # worst 2.3


def test_smallest_nutation_does_not_count_as_lock():
    """sin(theta) = theta is exact there, for any size."""
    found = zxz.from_body_rates([0.0, 1e-200, 0.0], [0.5, 3e-200, 0.0])
    np.testing.assert_allclose(found, [3.0, 0.5, -3.0], rtol=4 * EPS)


@every_angles
def test_from_matrix_has_no_derivative_at_gimbal_lock(kind):
    """NaN in the first and last angle along any rotation, by forward and reverse mode."""
    R = jnp.eye(3) if kind == "zxz" else jnp.eye(3)[jnp.array([1, 2, 0])]
    from_matrix = ANGLES[kind].from_matrix
    for w in np.eye(3):
        R_dot = R @ rotation.skew(w)
        for jacobian in (jax.jacfwd, jax.jacrev):
            moved = jnp.sum(jacobian(from_matrix)(R) * R_dot, axis=(1, 2))
            assert np.all(np.isnan(moved[jnp.array([0, 2])]))


@pytest.mark.parametrize(("dtype", "powers"), [(np.float64, (-565, 565)), (np.float32, (-77, 90))])
def test_quaternions_of_extreme_norms_are_rotations(dtype, powers):
    """Squares of 2^-565 and 2^565 under- and overflow; R and its derivatives in e/s do not."""
    e, e_dot = (np.random.default_rng(23).normal(size=(2, 4))).astype(dtype)

    def rates(x, x_dot):
        moved = jax.jvp(quaternion.matrix, (x,), (x_dot,))[1]
        return quaternion.matrix(x), quaternion.body_rates(x, x_dot), moved

    expected = rates(e, e_dot)
    for power in powers:
        scale = dtype(2.0) ** dtype(power)
        for found, right in zip(rates(scale * e, scale * e_dot), expected, strict=True):
            np.testing.assert_array_equal(found, right)


def test_scale_of_a_quaternion_does_not_affect_derivatives():
    """To second order, forward and reverse, against R written with sums of squares."""

    def plain(x):
        a, b, c, d = x
        first = jnp.stack([a * a + b * b - c * c - d * d, 2 * (b * c + a * d), 2 * (b * d - a * c)])
        return first / (x @ x)

    def ours(x):
        return quaternion.matrix(x)[:, 0]

    x = jnp.array([0.7, -1.3, 0.2, 0.9])
    for order in range(3):
        found, expected = jax.jit(lambda x, f=ours, g=plain: (f(x), g(x)))(x)
        np.testing.assert_allclose(found, expected, atol=32 * EPS * np.max(np.abs(expected)))
        ours, plain = (jax.jacfwd if order else jax.jacrev)(ours), jax.jacfwd(plain)


def test_zero_quaternion_gives_nan():
    assert np.all(np.isnan(quaternion.matrix(np.zeros(4))))
    assert np.all(np.isnan(quaternion.body_rates(np.zeros(4), np.ones(4))))
