"""Equations of implicit stages are solved relative to dy/dt."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import jaxlag as jl
from jaxlag.solvers._stage_chord import StageChord
from systems.catalogue import find


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_large_rates_converge_to_their_rounding(dtype):
    """Residuals of 1e6 are rounded by 0.06 in float32, far above an absolute bound of 1e-6."""
    bound = 10 * float(jnp.finfo(dtype).eps)

    def residual(f, _):
        return f - 1e6 * jnp.cos(jnp.array([1.0, 2.0, 3.0], dtype) + 1e-7 * f)

    guess = jnp.full(3, 1e5, dtype)
    found = optimistix.root_find(residual, StageChord(bound, bound), guess, max_steps=16)
    assert found.result == optimistix.RESULTS.successful
    exact = np.array([1.0, 2.0, 3.0])
    f = np.zeros(3)
    for _ in range(60):
        f = 1e6 * np.cos(exact + 1e-7 * f)
    np.testing.assert_allclose(found.value, f, rtol=4 * bound)
    stock = optimistix.Chord(bound, bound, optimistix.rms_norm)
    found = optimistix.root_find(residual, stock, guess, max_steps=16, throw=False)
    assert found.result != optimistix.RESULTS.successful


def test_small_components_are_not_lost_beside_large_ones():
    """10 eps of 1e6 is 1 in float32; the equation of the second component is its own."""

    def residual(f, _):
        return f - jnp.stack([jnp.float32(1e6), jnp.float32(0.9) * jnp.cos(f[1])])

    guess = jnp.array([1e6, 0.0], jnp.float32)
    found = optimistix.root_find(residual, StageChord(1e-6, 1e-6), guess, max_steps=64)
    root = found.value[1]
    np.testing.assert_allclose(root, 0.9 * np.cos(root), rtol=4e-6)


def test_roots_near_zero_are_held_to_the_absolute_bound():
    def residual(f, _):
        return 1e-3 * jnp.sin(f) + f - 2e-5

    finder = StageChord(1e-10, 1e-10)
    found = optimistix.root_find(residual, finder, jnp.array([1.0]), max_steps=16)
    np.testing.assert_allclose(found.value, 2e-5 / 1.001, atol=1e-10)


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "method"),
    [("double_pendulum", "kvaerno4"), ("double_pendulum_cartesian", "kvaerno5")],
)
def test_implicit_methods_save_every_state_in_float32(name, method):
    system, example = find(name).system, find(name).example
    q0, v0 = jnp.asarray(example.q0, jnp.float32), jnp.asarray(example.v0, jnp.float32)
    params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), dict(example.params))
    if system.constraints:
        start = jl.assemble(system, q0, v0, params)
        q0, v0 = start.q, start.v
    ts = np.linspace(0.0, 1.5, 61)
    motion = jl.simulate(system, q0, v0, ts, params, method=method)
    wide = jax.tree.map(lambda x: x.astype(float), (q0, v0, params))
    exact = jl.simulate(system, *wide[:2], ts, wide[2], assemble=True)
    np.testing.assert_allclose(motion.q, exact.q, atol=1e-3)


def test_the_message_names_the_save_time_of_a_failed_step():
    """A force that is NaN within 2e-4 s of a save time, which no accepted step meets."""

    def hole(t, q, v, p):
        return jnp.where(jnp.abs(t - 0.3) < 1e-4, jnp.nan, 0.0) * v

    free = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(jl.GeneralizedForce(hole, "hole"),)
    )
    motion = jl.simulate(free, [0.0], [1.0], [0.0, 0.3, 1.0], dt=1.0, method="heun", throw=False)
    assert motion.status != jl.Status.ok
    assert np.isfinite(motion.q[:, 0]).tolist() == [True, False, True]
    assert "in the step to ts[1] = 0.3" in motion.message()
