"""Batches by vmap: 256 lanes with all values traced; one of them fails intentionally."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.problems import driven

import jaxlag as jl
from jaxlag import Status

LANES = 256
FAILED = 77


@pytest.fixture(scope="module")
def lanes():
    """Random params, q0, v0 and values of a torque table; lane `FAILED` has no inertia."""
    rng = np.random.default_rng(3)
    draw = lambda low, high, *shape: jnp.asarray(rng.uniform(low, high, (LANES, *shape)))  # noqa: E731
    params = {
        "J": draw(0.1, 0.2).at[FAILED].set(0.0),
        "mgl": draw(2.0, 4.0),
        "c": draw(0.0, 0.1),
        "F": draw(0.0, 0.2),
    }
    return params, draw(-1.0, 1.0, 1), draw(-1.0, 1.0, 1), draw(-1.0, 1.0, 5)


def one(params, q0, v0, torques):
    inputs = {"tau": jl.ZeroOrderHold(jnp.array([0.0, 0.2, 0.5, 0.7, 1.0]), torques)}
    ts = jnp.linspace(0.0, 1.0, 4)
    return jl.simulate(driven, q0, v0, ts, params, inputs=inputs, dt=0.02, throw=False)


def test_lanes_equal_single_runs(lanes):
    """Fixed steps: every lane equals its single run to rounding, independently of others."""
    batch = jax.jit(jax.vmap(one))(*lanes)
    single = jax.jit(one)
    for i in [*range(0, LANES, 17), FAILED - 1, FAILED, FAILED + 1]:
        alone = single(*jax.tree.map(lambda x, i=i: x[i], lanes))
        assert batch.status[i] == alone.status
        np.testing.assert_allclose(batch.q[i], alone.q, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(batch.v[i], alone.v, rtol=1e-13, atol=1e-12)
    assert batch.status[FAILED] == Status.mass_singular
    assert batch.where[FAILED] == 0
    assert (np.delete(np.asarray(batch.status), FAILED) == Status.ok).all()


@pytest.mark.full
def test_failed_lane_does_not_change_others(lanes):
    """Bit for bit: the same program with that lane corrected."""
    run = jax.jit(jax.vmap(one))
    broken = run(*lanes)
    params, *rest = lanes
    corrected = run(params | {"J": params["J"].at[FAILED].set(0.15)}, *rest)
    others = np.arange(LANES) != FAILED
    np.testing.assert_array_equal(broken.q[others], corrected.q[others])
    assert np.isnan(broken.q[FAILED, 1:]).all()
    assert np.isfinite(corrected.q[FAILED]).all()


@pytest.mark.full
def test_lanes_have_independent_steps(lanes):
    """Adaptive: step counts differ from lane to lane; results agree to the tolerance."""
    params, q0, v0, torques = jax.tree.map(lambda x: x[:8], lanes)

    def adaptive(params, q0, v0, torques):
        inputs = {"tau": jl.ZeroOrderHold(jnp.array([0.0, 0.2, 0.5, 0.7, 1.0]), torques)}
        return jl.simulate(driven, q0, v0, [0.0, 0.5, 1.0], params, inputs=inputs, throw=False)

    batch = jax.jit(jax.vmap(adaptive))(params, q0, v0, torques)
    single = jax.jit(adaptive)
    assert len(set(np.asarray(batch.stats["accepted"]).tolist())) > 1
    for i in range(8):
        alone = single(*jax.tree.map(lambda x, i=i: x[i], (params, q0, v0, torques)))
        np.testing.assert_allclose(batch.q[i], alone.q, rtol=0, atol=1e-7)


@pytest.mark.full
def test_gradient_of_a_batch_with_a_failed_lane_is_finite(lanes):
    lanes = jax.tree.map(lambda x: x[FAILED - 2 : FAILED + 2], lanes)

    def loss(lanes):
        motions = jax.vmap(one)(*lanes)
        return jnp.sum(jnp.where(jnp.isnan(motions.q), 0.0, motions.q) ** 2)

    gradient = jax.jit(jax.grad(loss))(lanes)
    for leaf in jax.tree.leaves(gradient):
        assert np.isfinite(leaf).all()
    healthy = [0, 1, 3]
    assert (np.abs(np.asarray(gradient[0]["J"])[healthy]) > 1e-3).all()
    alone = jax.jit(jax.grad(loss))(jax.tree.map(lambda x: x[:1], lanes))
    np.testing.assert_allclose(gradient[0]["J"][0], alone[0]["J"][0], rtol=1e-11)
