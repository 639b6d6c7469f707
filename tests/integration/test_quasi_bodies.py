"""Bodies in body rates: by angles and by quaternions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.quasi_systems import I, angles, body_rates, spinning
from _user import unchecked  # noqa: F401
from numpy.linalg import norm
from scipy.integrate import solve_ivp

import jaxlag as jl
from jaxlag import rotation
from jaxlag._core._errors import SimulationError

EPS = np.finfo(float).eps
TIGHT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.mark.full
def test_gamma_of_body_rates_is_the_cross_product():
    """B^T Gamma = [w]x at all angles: I w' + w x I w = 0; no small-angle approximation."""
    system = angles()
    rng = np.random.default_rng(5)
    for _ in range(5):
        q, w = rng.uniform(-1.2, 1.2, 3), rng.uniform(-2, 2, 3)
        v = system.velocities(q, w, {})
        a = system._quasi_reactions(q, v, {})["a"]
        rate = jax.jvp(
            lambda q, v: body_rates(0.0, q, v, {}), (jnp.asarray(q), v), (v, jnp.asarray(a))
        )[1]
        expected = -np.cross(w, I * w) / I
        np.testing.assert_allclose(rate, expected, atol=200 * EPS * (1 + norm(v) ** 2))


def quaternion_rates(t, q, u, params):
    return rotation.quaternion.from_body_rates(q, u)


def unit(t, q, params):
    return q @ q - 1.0


def tumbling(**options):
    quasi = jl.QuasiVelocities(kinematics=quaternion_rates, names=("wx", "wy", "wz"))
    return jl.System(
        spinning,
        ("q0", "q1", "q2", "q3"),
        quasi=quasi,
        written_in="u",
        constraints=(jl.Holonomic(unit, "unit"),),
        **options,
    )


@pytest.mark.full
def test_the_norm_of_a_quaternion_has_no_reaction():
    """T in body rates does not change if q and q' are scaled: to the rounding of |I| |w|^2."""
    system, rng = tumbling(), np.random.default_rng(2)
    for _ in range(5):
        q, w = rng.standard_normal(4), rng.uniform(-2, 2, 3)
        v = system.velocities(q / norm(q), w, {})
        lam = system.multipliers(q / norm(q), v, {})["unit"]
        assert abs(lam) <= 100 * EPS * np.max(I) * norm(w) ** 2


@pytest.mark.full
def test_free_top_in_quaternions_passes_gimbal_lock():
    """Against R' = R [w]x by scipy; the pitch comes within 1e-3 of 90 degrees, at large roll."""
    w0 = np.array([0.02, 1.0, 0.6])
    ts = np.linspace(0.0, 4.0, 5)
    motion = jl.simulate(tumbling(), [1.0, 0.0, 0.0, 0.0], None, u0=w0, ts=ts, **TIGHT)

    def rates(t, y):
        w, R = y[:3], y[3:].reshape(3, 3)
        turning = R @ np.asarray(rotation.skew(jnp.asarray(w)))
        return np.concatenate([-np.cross(w, I * w) / I, turning.ravel()])

    start = np.concatenate([w0, np.eye(3).ravel()])
    right = solve_ivp(rates, (0, 4), start, "DOP853", ts, rtol=1e-12, atol=1e-12).y.T
    np.testing.assert_allclose(motion.u, right[:, :3], atol=1e-10)
    for q, state in zip(motion.q, right, strict=True):
        np.testing.assert_allclose(
            rotation.quaternion.matrix(q), state[3:].reshape(3, 3), atol=1e-10
        )
    np.testing.assert_allclose(jnp.sum(motion.q**2, axis=1), 1.0, atol=4 * EPS)
    # T does not contain the norm: its constraint force is zero.
    assert np.max(np.abs(motion.lam["unit"])) <= 1e-12


@pytest.mark.full
def test_a_quaternion_passes_the_attitude_at_which_angles_fail():
    """Pitch 90 degrees with roll and yaw rates: dU/dv is singular, the quaternion is not."""
    w = [0.3, 0.5, 0.4]
    with pytest.raises(SimulationError, match="kinematics_singular"):
        jl.simulate(angles(), [0.1, np.pi / 2, 0.2], None, u0=w, ts=[0.0, 1.0], params={})
    half = np.sqrt(0.5)
    motion = jl.simulate(tumbling(), [half, 0.0, half, 0.0], None, u0=w, ts=[0.0, 1.0], **TIGHT)
    momentum = [
        rotation.quaternion.matrix(q) @ (I * u) for q, u in zip(motion.q, motion.u, strict=True)
    ]
    np.testing.assert_allclose(*momentum, atol=1e-10)


@pytest.mark.full
def test_norm_of_a_quaternion_is_constant_over_a_million_steps():
    """To 1e-12 with a fixed step; without projection the errors of the solver accumulate."""
    steps = 1_000_000
    start = {"v0": None, "u0": [0.1, 2.0, 0.2], "dt": 0.2, "max_steps": steps + 1}
    ts = np.linspace(0.0, 0.2 * steps, 101)
    q0 = [1.0, 0.0, 0.0, 0.0]
    motion = jl.simulate(tumbling(), q0, ts=ts, **start)
    # Measured 2026-11-22: 4e-16.
    assert np.max(np.abs(np.sum(np.asarray(motion.q) ** 2, axis=1) - 1.0)) <= 1e-12
    drifted = jl.simulate(tumbling(), q0, ts=ts[:11], stabilization=None, **start)
    assert np.max(np.abs(np.sum(np.asarray(drifted.q) ** 2, axis=1) - 1.0)) >= 1e-10
