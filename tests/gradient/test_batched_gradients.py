"""Gradients of many trajectories in a vectorized loop equal those of each alone."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._core import _batching, _xla
from jaxlag._integration._vector_loop import _lane_call, _lane_loop

pytestmark = pytest.mark.skipif(not _xla.vectorizes(), reason="only on tested versions of jaxlib")
EPS = np.finfo(float).eps
COUNT = 37  # of more than one part of 32 lanes


def pendulum(t, q, v, p):
    return 0.5 * p["J"] * v[0] ** 2 + p["mgl"] * jnp.cos(q[0])


def torque(t, q, v, p, inputs):
    return inputs["tau"] - 0.1 * v


SYSTEM = jl.System(pendulum, ("theta",))
DRIVEN = jl.System(pendulum, ("theta",), forces=(jl.GeneralizedForce(torque, "motor"),))


@pytest.fixture
def chosen(monkeypatch):
    """A function that chooses between vectorized loops for all batches, or for none."""

    def choose(vectorized):
        monkeypatch.setattr(_batching, "VECTORIZED_FROM", 1 if vectorized else 10**9)
        monkeypatch.setattr(_batching, "TURNS", 1)
        jax.clear_caches()

    yield choose
    jax.clear_caches()


def lanes(count=COUNT):
    """Starts, params, tables of torques and ends."""
    rng = np.random.default_rng(4)

    def random(low, high, *shape):
        return jnp.asarray(rng.uniform(low, high, (count, *shape)))

    params = {"J": random(0.1, 0.3), "mgl": random(1.0, 4.0)}
    params["mgl"] = params["mgl"].at[-1].set(30.0)  # adaptive steps: the last takes most of them
    return random(-2.0, 2.0, 1), params, random(-0.1, 0.1, 6), random(0.7, 1.0)


def run(x, saves=5, **options):
    q0, params, *driven = x
    options = {"method": "tsit5", "throw": False} | options
    ts = jnp.linspace(0.0, 1.0, saves)
    if not driven:
        return jl.simulate(SYSTEM, q0, [0.3], ts, params, **options)
    torques, end = driven
    table = jl.LinearInterpolation(jnp.linspace(0.0, 1.2, 6), torques)
    return jl.simulate(DRIVEN, q0, [0.3], ts * end, params, inputs={"tau": table}, **options)


def loss(x, **options):
    motion = run(x, **options)
    return jnp.sum(motion.q**2) + 0.3 * jnp.sum(motion.v[-1])


def entry(x, i):
    return jax.tree.map(lambda leaf: leaf[i], x)


def close(found, right, factor):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(right), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=factor * EPS * np.max(np.abs(b), initial=1.0))


def compiled(function, x):
    """The compiled program, and the number of its maps over lanes."""
    lowered = jax.jit(function).lower(x)
    return lowered.compile(), lowered.as_text().count("stablehlo.reduce_window")


@pytest.mark.parametrize(
    "options",
    [
        {"dt": 0.02},
        pytest.param({"dt": 0.02, "driven": True}, marks=pytest.mark.full),
        pytest.param({"dt": 0.02, "saves": 2}, marks=pytest.mark.full),
        # More steps than there is room for: states between are computed again.
        pytest.param({"dt": 0.002, "gradient": "checkpoints"}, marks=pytest.mark.full),
        pytest.param({"dt": 0.002, "gradient": "checkpoints", "saves": 2}, marks=pytest.mark.full),
        pytest.param({"dt": 0.1, "method": "dopri8"}, marks=pytest.mark.full),
    ],
)
def test_gradients_equal_those_of_single_runs_and_do_not_depend_on_neighbours(chosen, options):
    """In the start, params, a table and the times; in another order the same bits."""
    x, options = lanes(), dict(options)
    x = x if options.pop("driven", False) else x[:2]
    each, some = jax.grad(partial(loss, **options)), (0, 17, 36)
    alone = jax.jit(each)
    singles = [alone(entry(x, i)) for i in some]
    chosen(True)
    batch, maps = compiled(jax.vmap(each), x)
    assert maps >= 2  # steps, and steps back
    found = batch(x)
    for i, right in zip(some, singles, strict=True):
        close(entry(found, i), right, 400)
    order = np.random.default_rng(0).permutation(COUNT)
    jax.tree.map(np.testing.assert_array_equal, batch(entry(x, order)), entry(found, order))


def test_records_of_the_last_trajectories_are_their_own(chosen, monkeypatch):
    """Adaptive steps, many save times: lanes that have none left do not write into records.

    Records are written where they stay.
    """
    kept = []

    def counted(programs, turn, real=_lane_loop._kept):
        kept.append(real(programs, turn))
        return kept[-1]

    monkeypatch.setattr(_lane_loop, "_kept", counted)
    x, options = lanes()[:2], {"rtol": 1e-8, "atol": 1e-8, "saves": 30, "max_steps": 512}
    each = jax.grad(partial(loss, **options))
    chosen(True)
    batch = jax.jit(jax.vmap(each))
    found = batch(x)
    assert len(kept[0]) == 3  # times, states, and the steps before save times
    for shift in (1, 20):
        order = np.roll(np.arange(COUNT), shift)
        jax.tree.map(np.testing.assert_array_equal, batch(entry(x, order)), entry(found, order))


@pytest.mark.full
def test_failed_trajectories_do_not_affect_the_gradients_of_others(chosen):
    """One is refused, one ends early; adaptive steps, whose number differs."""
    q0, params = lanes()[:2]
    params["J"] = params["J"].at[5].set(0.0)
    params["mgl"] = params["mgl"].at[6].set(1e5)  # fast beyond `max_steps`
    each = jax.grad(partial(loss, rtol=1e-8, atol=1e-8, max_steps=300))
    alone = jax.jit(each)
    singles = {i: alone(entry((q0, params), i)) for i in (5, 6, 36)}
    chosen(True)
    found = jax.jit(jax.vmap(each))((q0, params))
    # Error estimates round differently: steps differ, and states by a part of the tolerance.
    for i, right in singles.items():
        for a, b in zip(jax.tree.leaves(entry(found, i)), jax.tree.leaves(right), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-7)


@pytest.mark.full
def test_a_sweep_without_a_form_on_numbers_is_one_of_fewer_lanes(chosen, monkeypatch):
    """The steps themselves are vectorized."""
    x, each = lanes()[:2], jax.grad(partial(loss, dt=0.05))
    monkeypatch.setattr(_lane_call, "is_supported", lambda *_: False)
    chosen(True)
    batch, maps = compiled(jax.vmap(each), x)
    assert maps == 1
    found, right = batch(x), jax.jit(each)(entry(x, 17))
    close(entry(found, 17), right, 400)


@pytest.mark.full
def test_second_derivatives_of_a_mean_equal_differences(chosen):
    """Forward over reverse, outside and inside of the map."""
    q0, params = entry(lanes()[:2], slice(8))

    def one(scale, q0, params):
        return loss((q0, {"J": params["J"], "mgl": scale * params["mgl"]}), dt=0.05)

    def mean(scale):
        return jnp.mean(jax.vmap(partial(one, scale))(q0, params))

    chosen(True)
    slope, scale, step = jax.jit(jax.grad(mean)), jnp.array(1.1), 1e-4
    curvature = jax.jit(jax.hessian(mean))(scale)
    differences = (slope(scale + step) - slope(scale - step)) / (2 * step)
    np.testing.assert_allclose(curvature, differences, rtol=1e-6)
    inside = jax.jit(jax.vmap(jax.hessian(one), (None, 0, 0)))(scale, q0, params)
    np.testing.assert_allclose(jnp.mean(inside), curvature, rtol=1e-12)
    reverse = jax.jit(jax.jacrev(jax.grad(mean)))(scale)
    np.testing.assert_allclose(reverse, curvature, rtol=1e-12)
