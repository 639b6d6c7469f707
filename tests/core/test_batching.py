"""Vmapped solves in chunks of lanes, compared with the same trajectories one by one."""

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _jaxprs import operations

import jaxlag as jl
from jaxlag._core import _batching, _xla
from systems import double_pendulum

EPS = np.finfo(float).eps
PARAMS = {"m1": 1.0, "m2": 0.6, "h1": 0.9, "h2": 0.7, "g": 9.81}
TS = np.linspace(0.0, 0.5, 4)


def run(q0, params=PARAMS, system=double_pendulum.system, method="dopri8"):
    """Fixed steps, so that rounding does not change the steps."""
    return jl.simulate(system, q0, [0.3, -0.4], TS, params, dt=0.01, method=method, throw=False)


def starts(*shape):
    return jnp.asarray(np.random.default_rng(1).uniform(-1.0, 1.0, (*shape, 2)))


@pytest.fixture(scope="module")
def single(lowering):
    return jax.jit(lambda q0, params: run(q0, params).q)


@pytest.mark.full
@pytest.mark.parametrize("count", [1, 5, 16, 37])
def test_lanes_equal_single_solves(single, count):
    """Agreement to 1e3 eps below, at and above one chunk; the last chunk is not full."""
    q0 = starts(count)
    batch = jax.jit(jax.vmap(lambda q0: run(q0).q))(q0)
    assert batch.shape == (count, 4, 2)
    for i in {0, count // 2, count - 1}:
        np.testing.assert_allclose(batch[i], single(q0[i], PARAMS), rtol=0, atol=1e3 * EPS)


@pytest.mark.full
def test_batch_of_params_equals_single_solves(single):
    """One start, a batch of params."""
    lengths = jnp.linspace(0.8, 1.2, 20)
    batch = jax.jit(jax.vmap(lambda h1: run(jnp.array([0.5, 0.2]), PARAMS | {"h1": h1}).q))(lengths)
    for i in (0, 19):
        alone = single(jnp.array([0.5, 0.2]), PARAMS | {"h1": lengths[i]})
        np.testing.assert_allclose(batch[i], alone, rtol=0, atol=1e3 * EPS)


@pytest.mark.full
def test_nested_vmaps_equal_one_batch():
    """3 x 7 lanes with params constant along the inner axis; also with other batch axes."""
    q0, lengths = starts(3, 7), jnp.linspace(0.8, 1.2, 3)

    def one(q0, h1):
        return run(q0, PARAMS | {"h1": h1}).q

    nested = jax.jit(jax.vmap(jax.vmap(one, (0, None))))(q0, lengths)
    flat = jax.jit(jax.vmap(one))(q0.reshape(21, 2), jnp.repeat(lengths, 7))
    np.testing.assert_allclose(nested.reshape(flat.shape), flat, rtol=0, atol=1e3 * EPS)
    columns = jax.jit(jax.vmap(jax.vmap(one), (1, None), 1))(q0, lengths)
    np.testing.assert_allclose(columns, nested, rtol=0, atol=1e3 * EPS)


@pytest.mark.full
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev, jax.hessian])
def test_derivatives_of_batches_equal_single_ones(derivative):
    """Forward, reverse and second derivatives: vmap of the derivative, derivative of the vmap."""
    q0 = starts(3)

    def last(q0):
        return run(q0, method="tsit5").q[-1]

    alone = jax.jit(derivative(last))
    mapped = jax.jit(jax.vmap(derivative(last)))(q0)
    inside = jax.jit(derivative(lambda q0: jax.vmap(last)(q0)))(q0)
    scale = np.max(np.abs(mapped))
    for i in range(3):
        np.testing.assert_allclose(mapped[i], alone(q0[i]), rtol=0, atol=1e5 * EPS * scale)
        own = inside[i][(slice(None), i) + ((slice(None), i) if inside.ndim == 6 else ())]
        np.testing.assert_allclose(own, mapped[i], rtol=0, atol=1e5 * EPS * scale)


@pytest.mark.full
def test_failed_lanes_do_not_affect_others():
    """Lanes that diverge, in a full chunk and in the padded last one, do not affect others."""

    def lagrangian(t, q, v, params):
        return 0.5 * v @ v + 0.25 * params * jnp.sum(q**4)

    system = jl.System(lagrangian, ("x", "y"))
    ts, q0 = [0.0, 1.0, 2.0], jnp.array([0.5, 0.1])

    def one(k):
        return jl.simulate(system, q0, [0.1, 0.2], ts, k, throw=False)

    stiffness = jnp.full(33, -1.0).at[jnp.array([3, 32])].set(200.0)
    motion = jax.jit(jax.vmap(one))(stiffness)
    alone = jax.jit(one)(-1.0)
    failed = np.isin(np.arange(33), [3, 32])
    assert (np.asarray(motion.status) != 0).tolist() == failed.tolist()
    assert np.isnan(motion.q[failed, -1]).all()
    np.testing.assert_allclose(motion.q[~failed], np.broadcast_to(alone.q, (31, 3, 2)), atol=1e-9)


@pytest.mark.full
def test_compiled_program_loops_over_chunks(lowering):
    """37 trajectories: a loop over 3 chunks of 16 lanes; on arrays one loop of 37."""
    program = operations(jax.vmap(lambda q0: run(q0).q), starts(37), iterations=1)
    shapes = {s for o in program if "while" in o.inside and o.name == "div" for s in o.shapes}
    if lowering == "auto":
        assert any(o.inside[-2:] and "scan" in o.inside and "while" in o.inside for o in program)
        assert shapes
        assert all(shape[0] == _batching.LANES for shape in shapes)
        # Each lane writes saves at an index of its own.
        assert not [o for o in program if "while" in o.inside and "scatter" in o.name]
    else:
        assert shapes
        assert all(shape[0] == 37 for shape in shapes)


def test_implicit_methods_run_in_larger_chunks():
    """130 trajectories in 3 loops of 44, independently of the lowering."""
    many = jax.vmap(lambda q0: run(q0, method="gauss2").q)
    program = operations(many, starts(130), iterations=1)
    shapes = {s for o in program if "while" in o.inside and o.name == "lu" for s in o.shapes}
    assert shapes
    assert all(shape[0] == 44 for shape in shapes if len(shape) > 2)


@pytest.mark.parametrize(("count", "even"), [(3, True), (7, True), (7, False)])
def test_lanes_run_in_a_given_order_and_keep_their_places(count, even):
    """Each part has consecutive lanes of the order; what runs together shares the maximum."""
    x = jnp.asarray(np.random.default_rng(0).permutation(count))

    def together(x):
        return x, eqxi.unvmap_max(x)

    same, largest = _batching.in_batches(together, x, count, 4, even, order=jnp.argsort(x))
    np.testing.assert_array_equal(same, x)
    most = 2 if count == 3 else np.where(x < 4, 3, 6)
    np.testing.assert_array_equal(largest, most)


def test_explain_states_the_chunk_size():
    line = "batches       by jax.vmap: 16 trajectories at a time in one loop"
    vectorized = ", from 64 on in the lanes of a vectorized loop"
    assert line + vectorized * _xla.vectorizes() in double_pendulum.system.explain(PARAMS)
    arrays = jl.System(double_pendulum.system.lagrangian, ("a", "b"), lowering="array")
    assert "batches       by jax.vmap: all trajectories in one loop" in arrays.explain(PARAMS)


@pytest.mark.full
def test_batch_with_many_saves_of_costly_equations_equals_single_solves():
    """XLA splits costly operations over threads, which is impossible in a native loop."""

    def rubbing(t, q, v, params):
        speeds = v[0], v[1] - v[0]
        return 0.01 * sum(jnp.logaddexp(10.0 * x, -10.0 * x) for x in speeds)

    forces = (jl.Rayleigh(rubbing, "hinges"),)
    system = jl.System(double_pendulum.system.lagrangian, ("a", "b"), forces=forces)
    ts = np.linspace(0.0, 1.0, 200)

    def run(q0):
        motion = jl.simulate(system, q0, [0.3, -0.4], ts, PARAMS, dt=0.02, throw=False)
        return motion.q

    q0 = starts(16)
    together = jax.jit(jax.vmap(run))(q0)
    np.testing.assert_allclose(together[3], jax.jit(run)(q0[3]), rtol=0, atol=1e3 * EPS)
