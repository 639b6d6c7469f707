"""Derivatives of motions at rest, or steady beside slower ones: steps resolve perturbations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag, expm

import jaxlag as jl
from jaxlag._integration._linearized_rates import spectral_size, turning_rate


@pytest.mark.full
@pytest.mark.parametrize("form", ["auto", "array"])
def test_a_motion_at_rest_has_the_derivatives_of_its_linear_equations(form):
    """Error estimates vanish there: the motion alone would allow steps of any length.

    Single, and with a moving lane. Tolerance 1e-9 over some ten steps.
    """

    def lagrangian(t, q, v, params):
        c = jnp.cos(q[0] - q[1])
        T = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * c
        return T + params["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))

    system, params, t1 = jl.System(lagrangian, ("a", "b"), lowering=form), {"g": 9.81}, 3.0

    def end(y0):
        motion = jl.simulate(system, y0[:2], y0[2:], [0.0, t1], params)
        return jnp.concatenate([motion.q[-1], motion.v[-1]]), motion.stats["accepted"]

    M, K = np.array([[2.0, 1.0], [1.0, 1.0]]), 9.81 * np.diag([2.0, 1.0])
    zero = np.zeros((2, 2))
    flow = expm(t1 * np.block([[zero, np.eye(2)], [-np.linalg.solve(M, K), zero]]))
    rest, moving = jnp.zeros(4), jnp.array([0.4, -0.2, 0.0, 0.1])
    forward, count = jax.jacfwd(end, has_aux=True)(rest)
    np.testing.assert_allclose(forward, flow, rtol=0, atol=1e-7)
    assert count > end(rest)[1]
    slope = jax.jit(jax.vmap(jax.jacrev(end, has_aux=True)))
    lanes, counts = slope(jnp.stack([rest, moving]))
    np.testing.assert_allclose(lanes[0], flow, rtol=0, atol=1e-7)
    # A motion with nonzero error estimates has the same steps, differentiated or not.
    assert list(counts) == [count, end(moving)[1]]


@pytest.mark.full
def test_pendulum_at_rest_beside_a_steady_motion_has_derivatives():
    """Error estimates of a uniform motion vanish, too."""
    system = jl.System(lambda t, q, v, p: 0.5 * (v @ v) + 9.0 * jnp.cos(q[1]), ("x", "a"))

    def angle(start):
        return jl.simulate(system, [0.0, start], [1.0, 0.0], [0.0, 100.0], {}).q[-1, 1]

    np.testing.assert_allclose(jax.jacfwd(angle)(0.0), np.cos(300.0), rtol=0, atol=1e-7)


@pytest.mark.parametrize("start", [0.0, pytest.param(1e-9, marks=pytest.mark.full)])
def test_fast_spring_at_rest_beside_a_slow_one_has_derivatives(start):
    """Two springs of 0.1 and 10 rad/s: perturbations of the fast one go through 100 rad."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - 0.005 * q[0] ** 2 - 50.0 * q[1] ** 2, ("slow", "fast")
    )

    def fast(start):
        return jl.simulate(system, jnp.stack([1.0, start]), [0.0, 0.0], [0.0, 10.0], {}).q[-1, 1]

    np.testing.assert_allclose(jax.grad(fast)(start), np.cos(100.0), rtol=0, atol=1e-7)


@pytest.mark.full
@pytest.mark.parametrize("method", ["kvaerno3", "kvaerno5"])
def test_implicit_methods_at_rest_have_derivatives(method):
    """They would step over unresolved oscillations and damp them: theta'' = -4 sin theta."""
    pendulum = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 + 4.0 * jnp.cos(q[0]), ("a",))

    def angle(v0):
        motion = jl.simulate(pendulum, [0.0], [v0], [0.0, 10.0], {}, method=method)
        return motion.q[-1, 0]

    np.testing.assert_allclose(jax.grad(angle)(0.0), 0.5 * np.sin(20.0), rtol=0, atol=1e-6)


@pytest.mark.full
def test_implicit_methods_at_rest_step_over_decaying_modes():
    """A dashpot of 1e6/s beside a spring: oscillations of 1 rad/s bound the steps, it does not."""
    dashpot = jl.Rayleigh(lambda t, q, v, p: 0.5e6 * v[1] ** 2, "dashpot")
    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - 0.5 * q[0] ** 2 - 5e3 * q[1] ** 2,
        ("a", "b"),
        forces=(dashpot,),
    )

    def end(a0):
        q0 = jnp.stack([a0, 0.0])
        motion = jl.simulate(system, q0, [0.0, 0.0], [0.0, 10.0], {}, method="kvaerno5")
        return motion.q[-1, 0], motion.stats["accepted"]

    slope, steps = jax.grad(end, has_aux=True)(0.0)
    np.testing.assert_allclose(slope, np.cos(10.0), rtol=0, atol=1e-6)
    assert steps < 1000


def test_turning_rate_excludes_decaying_modes():
    """Eigenvalues +-3i and -1 +- 5i oscillate or nearly so, -100 and -7 +- i decay, 2 grows."""

    def block(real, imaginary):
        return np.array([[real, imaginary], [-imaginary, real]])

    def fastest(*blocks):
        return float(turning_rate(jnp.asarray(block_diag(*blocks), float)))

    np.testing.assert_allclose(fastest(block(0, 3), [[-100.0]]), 3.0, rtol=1e-12)
    np.testing.assert_allclose(fastest(block(0, 3), block(-1, 5)), 26**0.5, rtol=1e-12)
    np.testing.assert_allclose(fastest(block(-7, 1), [[2.0]]), 2.0, rtol=1e-12)
    assert fastest([[-1.0]]) == 0.0
    assert np.isnan(fastest([[np.nan]]))


@pytest.mark.parametrize("rate", [1e-3, 0.05, 1.0, 30.0, 1e4])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_spectral_size_is_about_the_fastest_rate(rate, dtype):
    """In range although its 16th power is not; within the 16th root of the ratio of units."""
    J = jnp.asarray([[0.0, 1.0, 0.0], [-(rate**2), 0.0, 0.0], [0.0, 0.0, 0.0]], dtype)
    assert 0.9 * rate <= spectral_size(J)[0] <= max(rate, 1 / rate) ** (1 / 16) * 1.1 * rate
    assert spectral_size(jnp.zeros((2, 2), dtype))[0] == 0.0
    assert spectral_size(jnp.asarray([[0.0, 1.0], [0.0, 0.0]], dtype))[0] == 0.0
