"""Fits by gradients of a few segments at a time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from _measured import NOISE, OPTIONS, STEPS, TRUE, angles, experiment, pendulum
from _silence import no_warning

import jaxlag as jl
from jaxlag._fit._descent import cost_of
from jaxlag._fit._free_parameters import NO_PRIOR, unknowns
from jaxlag._fit._multiple_shooting import FitVariables
from jaxlag._fit._residuals import squares
from jaxlag._fit._segments import layout
from jaxlag._fit._setup import build_shooting, readers_of


@pytest.mark.full
def test_descent_agrees_with_least_squares():
    pieces = experiment(sigma={"x": NOISE}).windows(1.0)
    start = TRUE | {"l": 0.68, "c": 0.08}
    descent = jl.Descent(optax.adam(3e-3), epochs=400, batch=2)
    down = jl.fit(pendulum, pieces, start, free=("l", "c"), optimizer=descent, **OPTIONS)
    squares = jl.fit(pendulum, pieces, start, free=("l", "c"), **OPTIONS)
    assert down.converged
    assert down.costs.shape == (400,)
    assert down.costs[-1] < down.costs[0]
    for name in ("l", "c"):
        assert abs(down.params[name] - squares.params[name]) < 0.3 * squares.std[name]
        np.testing.assert_allclose(down.std[name], squares.std[name], rtol=0.05)
    assert down.cost < 1.02 * squares.cost


@pytest.mark.full
@pytest.mark.parametrize("segments", [1, 5])
def test_estimate_of_the_cost_is_unbiased(segments):
    """The mean over all parts of equal size is the cost of least squares, including gaps."""
    data = experiment(sigma={"x": NOISE})
    data = (data, jl.Experiment(data.ts, {"x": angles(seed=1)}, sigma={"x": NOISE}))
    free = unknowns(TRUE, ("l",), {})
    where = layout(data, segments)
    shown = readers_of(pendulum, data, {}, TRUE)
    problem, _ = build_shooting(pendulum, data, where, free, shown, NO_PRIOR, squares, STEPS)
    rng = np.random.default_rng(0)
    x = jnp.asarray(0.01 * rng.normal(size=problem.segments.guess.shape))
    guess = FitVariables(jnp.asarray([0.02]), x)
    join = jnp.asarray(1e-2)
    residuals, _ = problem(guess, join)
    whole = 0.5 * sum(float(jnp.sum(r**2)) for r in jax.tree.leaves(residuals))
    order = rng.permutation(len(x)).reshape(2, -1)
    parts = [float(cost_of(guess, problem, jnp.asarray(which), join)) for which in order]
    # Solved in other batches: equal to rounding of terms of 1e-16 * (angle/NOISE)^2 * samples.
    np.testing.assert_allclose(np.mean(parts), whole, rtol=1e-9)


@pytest.mark.full
def test_network_in_the_potential_is_fitted():
    """A hardening spring, fitted by a linear spring and a network.

    It predicts better than the linear spring alone, and the energy is conserved.
    """

    def true(t, q, v, params):
        return 0.5 * v[0] ** 2 - 2.0 * q[0] ** 2 - 1.5 * q[0] ** 4

    def physics(t, q, v, params):
        return 0.5 * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2

    def both(t, q, v, params):
        return physics(t, q, v, params) - params["net"](q)

    ts = np.linspace(0.0, 2.0, 81)
    rng = np.random.default_rng(0)

    def measured(q0):
        motion = jl.simulate(jl.System(true, ("x",)), [q0], [0.0], ts, {})
        noisy = np.asarray(motion["x"]) + 1e-3 * rng.normal(size=len(ts))
        return jl.Experiment(ts, {"x": noisy}, sigma={"x": 1e-3}, name=f"from {q0}")

    training, held_out = [measured(q0) for q0 in (0.3, 0.6, 1.0)], measured(0.8)
    network = eqx.nn.MLP(1, "scalar", 8, 1, jnp.tanh, key=jax.random.key(0))
    plain = jl.fit(jl.System(physics, ("x",)), training, {"k": 4.0}, free=("k",))
    found = jl.fit(
        jl.System(both, ("x",)),
        training,
        {"k": plain.params["k"], "net": network},
        free=("net",),
        optimizer=jl.Descent(optax.lbfgs(memory_size=20), epochs=100, batch=3),
    )
    assert len(found.names) == 8 + 8 + 8 + 1
    worse, better = (x.predict(held_out, settle=0.3).rms("x")[0] for x in (plain, found))
    assert better < 0.2 * worse  # measured 0.12; after more epochs it overfits
    motion = jl.simulate(jl.System(both, ("x",)), [0.8], [0.0], ts, found.params, rtol=1e-10)
    energy = np.asarray(motion.energy)
    np.testing.assert_allclose(energy, energy[0], atol=1e-7)


@pytest.mark.full
def test_failed_segment_does_not_change_the_fit():
    """A spring that breaks at x = 2, where one recording starts."""

    def force(t, q, v, p):
        return -p["k"] * q + 1e-15 * jnp.sqrt(2.0 - q)

    spring = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(jl.GeneralizedForce(force, "spring"),)
    )
    ts = np.linspace(0.0, 2.0, 41)
    good = jl.Experiment(ts, {"x": np.cos(1.5 * ts)}, name="good")
    broken = jl.Experiment(ts, {"x": 3.0 + 1e-3 * ts}, name="broken")
    descent = jl.Descent(optax.adam(1e-2), epochs=300, batch=1)
    with pytest.warns(UserWarning, match="segment of broken that starts at t = 0 s ended with"):
        found = jl.fit(
            spring, (good, broken), {"k": 2.0}, free=("k",), optimizer=descent, **OPTIONS
        )
    np.testing.assert_allclose(found.params["k"], 2.25, rtol=1e-5)


@pytest.mark.full
def test_derivatives_that_are_not_finite_are_counted():
    """sqrt(k) has none at k = 0."""
    spring = jl.System(lambda t, q, v, p: 0.5 * v @ v - jnp.sqrt(p["k"]) * q @ q, ("x",))
    ts = np.linspace(0.0, 1.0, 21)
    data = jl.Experiment(ts, {"x": np.cos(1.5 * ts)})
    descent = jl.Descent(optax.adam(1e-2), epochs=3)
    no_covariance = r"Derivatives at the estimates are not finite: there is no covariance"
    with (
        pytest.warns(UserWarning, match=r"3 steps of the descent had derivatives that are not"),
        pytest.warns(UserWarning, match=no_covariance),
    ):
        found = jl.fit(spring, data, {"k": 0.0}, free=("k",), optimizer=descent, **OPTIONS)
    assert np.isnan(found.covariance).all()
    assert np.isfinite(found.cost)
    with pytest.warns(UserWarning, match=no_covariance):
        jl.fit(spring, data, {"k": 0.0}, free=("k",), **OPTIONS)


@pytest.mark.full
def test_covariance_is_omitted_for_more_than_200_parameters():
    def lagrangian(t, q, v, p):
        return 0.5 * v[0] ** 2 - 2.0 * q[0] ** 2 - p["net"](q)

    network = eqx.nn.MLP(1, "scalar", 16, 2, jnp.tanh, key=jax.random.key(0))
    ts = np.linspace(0.0, 1.0, 21)
    data = jl.Experiment(ts, {"x": np.cos(2.0 * ts)})
    descent = jl.Descent(optax.adam(1e-3), epochs=5)
    system = jl.System(lagrangian, ("x",))
    with no_warning():
        found = jl.fit(system, data, {"net": network}, free=("net",), optimizer=descent, **OPTIONS)
    assert len(found.names) == 2 * 16 + 16 * 17 + 17
    assert np.isnan(found.covariance).all()
    assert "no covariance" in str(found)
    assert f"and {len(found.names) - 40} more" in str(found)


def test_motions_of_a_descent_are_counted():
    """Parts of equal size: each epoch omits one segment of five."""
    descent = jl.Descent(optax.sgd(1.0), epochs=3, batch=2)
    assert descent.steps(5) == (2, 2)
    assert descent.solves(5) == 3 * 2 * 2
    assert descent.solves(1) == 3


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (("adam",), {}, r"`optimizer` must have init and update.*'adam'.*Try optax\.adam"),
        ((optax.sgd(1.0),), {"epochs": 0}, r"`epochs` must be a positive integer, but it was 0"),
        ((optax.sgd(1.0),), {"batch": 1.5}, r"`batch` must be a positive integer, but it was 1\.5"),
        ((optax.sgd(1.0),), {"gap": 0.0}, r"`gap` must be positive, but it was 0"),
    ],
)
def test_invalid_arguments_are_named(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        jl.Descent(*arguments, **options)
