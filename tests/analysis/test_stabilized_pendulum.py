"""Furuta's pendulum, stabilized by a linear-quadratic regulator of python-control."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import jaxlag as jl
from tests.analysis._eigenvalues import check_eigenvalues

G = 9.81
EPS = float(np.finfo(float).eps)

FURUTA = {"J": 0.004, "m": 0.12, "r": 0.18, "l": 0.15, "I": 0.0009, "g": G}


def furuta_lagrangian(t, q, v, p):
    """Arm and a slender pendulum; its angle is counted from the upright position."""
    about = p["I"] + p["m"] * p["l"] ** 2
    turning = p["J"] + p["m"] * p["r"] ** 2 + about * jnp.sin(q[1]) ** 2
    both = p["m"] * p["r"] * p["l"] * jnp.cos(q[1]) * v[0] * v[1]
    kinetic = 0.5 * turning * v[0] ** 2 + both + 0.5 * about * v[1] ** 2
    return kinetic - p["m"] * p["g"] * p["l"] * jnp.cos(q[1])


def motor(t, q, v, p, inputs):
    return jnp.stack([inputs["torque"], jnp.zeros_like(q[1])])


PENDULUM = jl.System(
    furuta_lagrangian, ("arm", "pendulum"), forces=[jl.GeneralizedForce(motor, "motor")]
)


@pytest.fixture(scope="module")
def upright():
    return jl.linearize(PENDULUM, [0.0, 0.0], [0.0, 0.0], FURUTA, inputs=("torque",))


def test_matrices_of_the_upright_furuta_pendulum(upright):
    """Source: Cazzolato, Prime, J. Control Sci. Eng. 2011, 528341."""
    p = FURUTA
    arm, about = p["J"] + p["m"] * p["r"] ** 2, p["I"] + p["m"] * p["l"] ** 2
    both, weight = p["m"] * p["r"] * p["l"], p["m"] * p["g"] * p["l"]
    size = arm * about - both**2
    A = np.zeros((4, 4))
    A[0, 2] = A[1, 3] = 1.0
    A[2, 1], A[3, 1] = -both * weight / size, arm * weight / size
    np.testing.assert_allclose(upright.A, A, rtol=8 * EPS, atol=0.0)
    np.testing.assert_allclose(upright.B[:, 0], [0, 0, about / size, -both / size], rtol=8 * EPS)


@pytest.mark.full
def test_stabilized_furuta_pendulum(upright):
    """Feedback of a linear-quadratic regulator moves the nonlinear pendulum upright."""
    control = pytest.importorskip("control")
    A, B = np.asarray(upright.A), np.asarray(upright.B)
    K, _, poles = control.lqr(A, B, np.diag([1.0, 1.0, 0.1, 0.1]), np.array([[10.0]]))
    gain = jnp.asarray(K[0])
    torque = jl.Feedback(lambda t, q, v, p: -gain @ jnp.concatenate([q, v]))
    inputs = {"torque": torque}
    closed = jl.linearize(PENDULUM, [0.0, 0.0], [0.0, 0.0], FURUTA, inputs=inputs)
    of_products = np.abs(A) + np.abs(B) @ np.abs(K)  # their differences are rounded
    assert np.all(np.abs(closed.A - (A - B @ K)) <= 4 * EPS * of_products)  # measured: 0.8 EPS
    check_eigenvalues(closed, np.linalg.eigvals(A - B @ K))
    check_eigenvalues(closed, poles)

    ts, rtol = np.linspace(0.0, 6.0, 13), 1e-12
    motion = jl.simulate(
        PENDULUM, [0.5, 0.3], [0.0, 0.0], ts, FURUTA, inputs=inputs, rtol=rtol, atol=1e-16
    )
    x = np.concatenate([motion.q, motion.v], axis=1)
    sizes, along = np.linalg.norm(x, axis=1), expm(np.asarray(closed.A) * ts[1])
    left = np.linalg.norm(x[1:] - x[:-1] @ along.T, axis=1)

    # The equations are odd in the state. What is left is cubic, measured as 3.01e-3 |x|^3.
    near = slice(4, len(left))
    assert np.all(left[near] <= 3.1e-3 * sizes[near] ** 3 + rtol * sizes[near])
    order = np.polyfit(np.log(sizes[4:8]), np.log(left[4:8]), 1)[0]
    assert order == pytest.approx(3.0, abs=2e-3)  # measured: 2.9990
    # The slowest pole remains: the others have fallen by exp(-gap t) relative to it.
    slowest, second = np.sort(-poles.real)[:2]
    rate = np.log(sizes[-2] / sizes[-1]) / ts[1]
    share = np.exp((slowest - second) * ts[-2])
    assert rate == pytest.approx(slowest, abs=2 * share / ts[1])  # measured: 1.5e-5 of 3.4e-5 1/s
