"""Noise in fits: its estimate, degrees of freedom, outliers, intervals."""

import numpy as np
import pytest
from _measured import NOISE, OPTIONS, TRUE, TS, angles, experiment, fit, pendulum, tight
from _silence import no_warning

import jaxlag as jl


@pytest.mark.full
@pytest.mark.parametrize("loss", ["soft_l1", "huber", "cauchy"])
def test_robust_losses_reduce_the_effect_of_outliers(loss):
    y = angles()
    y[::10] += 0.3
    data = jl.Experiment(TS, {"x": y}, sigma={"x": NOISE})
    robust, plain = fit(data, loss=loss), fit(data)
    off = [abs(found.params["l"] - TRUE["l"]) for found in (robust, plain)]
    assert off[0] < 0.1 * off[1]


@pytest.mark.full
@pytest.mark.parametrize("noise", [1e-4, 1e-7])
def test_segments_agree_with_one_motion_for_any_precision(noise):
    """A spring; agreement to a hundredth of the standard deviation."""
    spring = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2, ("x",))
    ts = np.linspace(0.0, 10.0, 101)
    x = 0.3 * np.cos(2.0 * ts) + noise * np.random.default_rng(1).normal(size=len(ts))
    options = {"free": ("k",), "rtol": 1e-8, "atol": 1e-8, "simulate_options": tight(1e-11)}
    data = jl.Experiment(ts, {"x": x})
    one, many = (jl.fit(spring, data, {"k": 3.9}, segments=n, **options) for n in (1, 10))
    assert abs(one.params["k"] - many.params["k"]) < 1e-2 * one.std["k"]
    np.testing.assert_allclose(one.std["k"], many.std["k"], rtol=1e-3)
    assert many.gap < 1e-2 * noise
    np.testing.assert_allclose(one.freedom, many.freedom, atol=1e-6)


@pytest.mark.full
def test_parameter_of_value_zero_has_its_standard_deviation():
    """An offset with true value 0: relative changes of it have no effect, absolute ones have."""
    spring = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p["k"] * (q[0] - p["x0"]) ** 2, ("x",)
    )
    ts = np.linspace(0.0, 30.0, 301)
    options = {"free": ("k", "x0"), "simulate_options": tight(1e-9)}
    start = {"k": 3.9, "x0": 0.01}
    with no_warning():
        found = jl.fit(spring, jl.Experiment(ts, {"x": 0.3 * np.cos(2 * ts)}), start, **options)
    assert found.unidentifiable == found.unused == ()
    assert abs(found.params["x0"]) < 1e-9
    assert found.std["x0"] < 1e-9
    noise = 1e-4
    x = 0.3 * np.cos(2 * ts) + noise * np.random.default_rng(1).normal(size=len(ts))
    found = jl.fit(spring, jl.Experiment(ts, {"x": x}), start, **options)
    # As for the mean of independent measurements: k and the start oscillate, with little overlap.
    np.testing.assert_allclose(found.std["x0"], noise / np.sqrt(len(ts)), rtol=0.1)
    assert abs(found.params["x0"]) < 3.5 * found.std["x0"]


@pytest.mark.full
def test_known_starts_take_no_degrees_of_freedom():
    rng = np.random.default_rng(0)
    ts = np.linspace(0.0, 1.0, 3)
    data = [
        jl.Experiment(
            ts,
            {"x": angles(ts, a, noise=0.0) + 0.01 * rng.normal(size=3)},
            q0=[a],
            v0=[0.0],
            start_sigma=0.0,
        )
        for a in 0.5 + 0.02 * np.arange(40)
    ]
    found = fit(data, ("l",))
    np.testing.assert_allclose(found.freedom, 119.0, atol=1e-6)
    residuals = np.concatenate([each["x"] for each in found.residuals])
    np.testing.assert_allclose(found.noise["x"], np.sqrt(np.sum(residuals**2) / 119), rtol=1e-3)


@pytest.mark.full
def test_starts_on_a_rod_take_two_degrees_of_freedom_each():
    rng = np.random.default_rng(0)
    rod = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - p["g"] * q[1],
        {"r": (2,)},
        constraints=(jl.Holonomic(lambda t, q, p: q @ q - p["l"] ** 2, "rod"),),
    )
    ts = np.linspace(0.0, 0.3, 4)
    data = []
    for a in 0.5 + 0.05 * np.arange(10):
        motion = jl.simulate(pendulum, [a], [0.0], ts, TRUE | {"c": 0.0})
        x = np.asarray(motion["x"])
        r = TRUE["l"] * np.stack([np.sin(x), -np.cos(x)], axis=1)
        data.append(jl.Experiment(ts, {"r": r + 5e-3 * rng.normal(size=r.shape)}))
    found = jl.fit(rod, data, TRUE | {"l": 0.72}, free=("l",), simulate_options=tight(1e-7))
    np.testing.assert_allclose(found.freedom, 80 - 21, atol=1e-4)
    # 59 numbers determine it to 9 %.
    np.testing.assert_allclose(found.noise["r"], 5e-3, rtol=0.25)


@pytest.mark.full
def test_degrees_of_freedom_account_for_priors():
    """A nearly exact prior leaves nothing to estimate."""
    data = experiment(sigma={"x": NOISE})
    free, known = (fit(data, ("l",), priors={"l": jl.Prior(0.7, s)}) for s in (1e3, 1e-9))
    np.testing.assert_allclose(free.freedom, 151 - 3, atol=1e-3)
    np.testing.assert_allclose(known.freedom, 151 - 2, atol=1e-3)


@pytest.mark.full
@pytest.mark.parametrize("loss", ["soft_l1", "huber", "cauchy"])
def test_estimate_of_the_noise_excludes_outliers(loss):
    y = angles()
    y[::10] += 0.3
    found = fit(jl.Experiment(TS, {"x": y}), loss=loss)
    np.testing.assert_allclose(found.noise["x"], NOISE, rtol=0.4)
    assert abs(found.params["l"] - TRUE["l"]) < 4 * found.std["l"]


@pytest.mark.full
def test_intervals_of_few_measurements_follow_students_distribution():
    found = fit(experiment().part(slice(0, 150, 30)), ("l",))
    np.testing.assert_allclose(found.freedom, 2.0, atol=1e-6)
    low, high = found.interval()["l"]
    # The quantile 0.975 of Student's t with 2 degrees of freedom, from a table.
    np.testing.assert_allclose(high - low, 2 * 4.3027 * found.std["l"], rtol=1e-4)
    with pytest.raises(ValueError, match=r"`level` must be between 0 and 1, but it was 95.*0\.95"):
        found.interval(95)


@pytest.mark.full
def test_columns_measured_alternately_are_fitted():
    two = jl.System(lambda t, q, v, p: 0.5 * v @ v - 0.5 * p["k"] @ q**2, {"q": (2,)})
    noise = 1e-4 * np.random.default_rng(0).normal(size=(151, 2))
    q = 0.3 * np.cos(np.outer(TS, [2.0, 1.5])) + noise
    q[::2, 0] = q[1::2, 1] = np.nan
    data = jl.Experiment(TS, {"q": q})
    found = jl.fit(two, data, {"k": np.full(2, 3.0)}, free=("k",), **OPTIONS)
    np.testing.assert_allclose(found.params["k"], [4.0, 2.25], rtol=1e-3)
