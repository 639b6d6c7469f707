"""Fits of motions whose parameters are known; every warning and error by name."""

import jax.numpy as jnp
import numpy as np
import pytest
from _measured import NOISE, OPTIONS, TRUE, TS, angles, driven, experiment, pendulum
from _silence import no_warning

import jaxlag as jl
from jaxlag import _shooting


def fit(data, free=("l", "c"), params0=None, system=pendulum, **options):
    start = TRUE | {"l": 0.5, "c": 0.02} if params0 is None else params0
    return jl.fit(system, data, start, free=free, **(OPTIONS | options))


def within(found, names, deviations=3.5):
    """Estimates within so many of their own standard deviations of the truth."""
    for name in names:
        assert found.std[name] < 0.05 * TRUE[name]
        assert abs(found.params[name] - TRUE[name]) < deviations * found.std[name], name


@pytest.mark.full
@pytest.mark.parametrize("segments", [1, 5])
def test_parameters_start_and_noise_are_found(segments):
    found = fit(experiment(), segments=segments)
    assert found.converged
    within(found, ("l", "c"))
    np.testing.assert_allclose(found.starts[0], [1.0, 0.0], atol=5e-3)
    # Of 151 samples the standard deviation is known to 6 %.
    np.testing.assert_allclose(found.noise["x"], NOISE, rtol=0.2)
    np.testing.assert_allclose(found.rms("x"), NOISE, rtol=0.2)
    low, high = found.interval()["l"]
    assert low < TRUE["l"] < high
    assert found.gap < 1e-4
    assert "95 % in" in str(found)


@pytest.mark.full
def test_segments_find_what_one_motion_does():
    """Joined ever more tightly they are one motion: the same estimates, within a hundredth of
    their standard deviations."""
    one, many = (fit(experiment(), segments=k, tolerance=1e-7) for k in (1, 5))
    for name in ("l", "c"):
        assert abs(one.params[name] - many.params[name]) < 1e-2 * one.std[name]
        np.testing.assert_allclose(one.std[name], many.std[name], rtol=1e-2)


@pytest.mark.full
def test_the_covariance_is_that_of_the_dense_derivatives():
    """(J^T J)^-1 of params and starts, from central differences of simulations."""
    data = experiment(sigma={"x": NOISE})
    found = fit(data)

    def residuals(x):
        params = TRUE | {"l": x[0], "c": x[1]}
        motion = jl.simulate(pendulum, x[2:3], x[3:4], TS, params, **OPTIONS)
        return np.asarray(motion["x"]) / NOISE

    x = np.concatenate([[found.params["l"], found.params["c"]], found.starts[0]])
    h = 1e-5
    columns = [(residuals(x + h * e) - residuals(x - h * e)) / (2 * h) for e in np.eye(4)]
    jacobian = np.stack(columns, axis=1)
    covariance = np.linalg.inv(jacobian.T @ jacobian)[:2, :2]
    order = [found.names.index(name) for name in ("l", "c")]
    own = found.covariance[np.ix_(order, order)]
    np.testing.assert_allclose(own, covariance, rtol=1e-5, atol=1e-6 * np.max(np.abs(own)))


@pytest.mark.full
def test_several_experiments_with_gaps_and_other_rates():
    """Padding and gaps count nothing: as a fit of the rows that are there."""
    short = np.linspace(0.0, 1.0, 23)
    y = angles()
    with_gap = y.copy()
    with_gap[40:70] = np.nan
    second = {"x": angles(short, 0.6, seed=1)}
    kept = np.isfinite(with_gap)
    one = fit((jl.Experiment(TS, {"x": with_gap}), jl.Experiment(short, second)))
    same = jl.Experiment(TS[kept], {"x": y[kept]}), jl.Experiment(short, second)
    # Fixed steps do not depend on which rows are saved.
    other = fit(same)
    within(one, ("l", "c"))
    np.testing.assert_allclose(one.values, other.values, rtol=1e-6)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-4)
    assert np.isnan(one.residuals[0]["x"][40:70]).all()
    assert np.isfinite(one.residuals[1]["x"]).all()


@pytest.mark.full
def test_a_driven_motion_and_its_rate():
    """Torque from a table, in segments; a measured rate and a channel of one's own."""
    times = np.linspace(0.0, 3.0, 61)
    torque = jl.Linear(times, 0.8 * np.sin(3.0 * times))
    motion = jl.simulate(driven, [0.2], [0.0], TS, TRUE, inputs={"torque": torque})
    rng = np.random.default_rng(3)
    rate = np.asarray(motion.v[:, 0]) + 0.02 * rng.normal(size=len(TS))
    height = -TRUE["l"] * np.cos(np.asarray(motion["x"])) + 1e-3 * rng.normal(size=len(TS))
    data = jl.Experiment(
        TS,
        {"x'": rate, "height": height},
        inputs={"torque": torque},
        sigma={"x'": 0.02, "height": 1e-3},
        q0=[0.15],
        v0=[0.1],
    )

    def shown(motion):
        return -motion.params["l"] * jnp.cos(motion["x"])

    found = fit(
        data,
        ("l", "c", "m"),
        TRUE | {"l": 0.6, "m": 1.3},
        driven,
        channels={"height": shown},
        segments=3,
    )
    assert found.converged
    within(found, ("l", "m"))


def test_what_cannot_be_known_is_named():
    """L is m times a function of l and g/l: a free swing tells g/l and c/(m l^2)."""
    found = fit(experiment(), ("m", "l", "g"), TRUE | {"c": 0.05})
    assert len(found.unidentifiable) == 1
    assert np.isinf(found.std["g"])
    assert any(text in found.determined for text in ("l/g", "g/l"))
    ratio = found.params["g"] / found.params["l"]
    np.testing.assert_allclose(ratio, TRUE["g"] / TRUE["l"], rtol=3e-3)


def test_priors_decide_what_measurements_do_not():
    prior = {"g": jl.Prior(9.81, 0.01)}
    found = fit(experiment(), ("l", "g", "m"), TRUE | {"l": 0.6}, priors=prior)
    assert not found.unidentifiable
    np.testing.assert_allclose(found.std["g"], 0.01, rtol=1e-2)
    within(found, ("l",))


@pytest.mark.full
def test_transforms_hold_and_their_errors_are_in_the_parameter_s_unit():
    plain = fit(experiment())
    held = fit(experiment(), transforms={"l": jl.Positive(), "c": jl.Bounded(0.0, 1.0)})
    np.testing.assert_allclose(held.values, plain.values, rtol=1e-4)
    np.testing.assert_allclose(held.covariance, plain.covariance, rtol=1e-3)


@pytest.mark.full
@pytest.mark.parametrize("start", [1e-6, 1e-12, 1e-18])
def test_a_search_does_not_depend_on_the_size_that_a_number_starts_at(start):
    plain = fit(experiment())
    with no_warning():
        found = fit(experiment(), ("l", "c"), TRUE | {"l": 0.69, "c": start})
    np.testing.assert_allclose(found.values, plain.values, atol=1e-3 * plain.std["c"])
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-3)


@pytest.mark.full
def test_a_number_that_ends_on_its_bound_is_the_bound_to_the_last_digit():
    """From a third, so that rounding would show; and a search that begins there leaves it again."""
    bound = jl.Bounded(0.1 + 0.2, 1.0)
    with pytest.warns(UserWarning, match="c ended on its bound"):
        found = fit(
            experiment(), params0=TRUE | {"l": 0.5, "c": 0.7 / 0.9}, transforms={"c": bound}
        )
    assert float(found.params["c"]) == 0.1 + 0.2
    with pytest.warns(UserWarning, match="c starts on its bound"):
        again = fit(
            experiment(), params0=found.params, transforms={"c": jl.Bounded(0.0, 0.1 + 0.2)}
        )
    within(again, ("l", "c"))


@pytest.mark.full
def test_a_search_that_errors_of_the_solver_stop_is_said():
    """Dry friction, whose steep change of sign steps at 1e-5 pass over now and then."""
    dry = jl.GeneralizedForce(lambda t, q, v, p: -p["f"] * jnp.tanh(v / 0.02), "dry")
    system, ts = pendulum.with_forces(dry), np.linspace(0.0, 8.0, 401)
    true = TRUE | {"f": 0.1}
    motion = jl.simulate(system, [1.0], [0.0], ts, true, rtol=1e-10, atol=1e-10)
    noise = 1e-4 * np.random.default_rng(0).normal(size=len(ts))
    data = jl.Experiment(ts, {"x": np.asarray(motion["x"]) + noise}, sigma={"x": 1e-4})
    options = {"free": ("l", "c", "f"), "method": "tsit5"}
    start = true | {"l": 0.69, "c": 0.02, "f": 0.15}
    with pytest.warns(UserWarning, match=r"standard deviations from where derivatives lead: lower"):
        found = jl.fit(system, data, start, rtol=1e-5, atol=1e-5, **options)
    assert found.distance > 0.3
    with no_warning():
        found = jl.fit(system, data, start, rtol=1e-10, atol=1e-10, **options)
    assert found.distance < 0.05
    for name in ("l", "c", "f"):
        assert abs(found.params[name] - true[name]) < 3.5 * found.std[name]


@pytest.mark.full
def test_without_bounds_no_box_is_compiled(monkeypatch):
    """Numbers that may go anywhere take plain steps of least squares."""

    def box(*_):
        raise AssertionError("a box")

    monkeypatch.setattr(_shooting, "box_least_squares", box)
    data = experiment().part(slice(0, 77))  # of a shape that no other test has compiled
    fit(data)
    with pytest.raises(AssertionError, match="a box"):
        fit(data, transforms={"l": jl.Positive()})


BOUNDS = [jl.Bounded(0.1, 1.0), jl.Bounded(0.1, np.inf)]


@pytest.mark.parametrize(
    "bounds", [BOUNDS[0], pytest.param(BOUNDS[1], marks=pytest.mark.full)], ids=["both", "one"]
)
def test_a_parameter_that_ends_on_its_bound_is_named_and_the_others_are_known(bounds):
    """As where it is held there; the truth is below."""
    data, start = experiment(sigma={"x": NOISE}), TRUE | {"l": 0.5, "c": 0.3}
    with pytest.warns(UserWarning, match=r"c ended on its bound, 0\.1: widen the bound, or leave"):
        found = fit(data, params0=start, transforms={"c": bounds})
    held = fit(data, ("l",), TRUE | {"l": 0.5, "c": 0.1})
    assert found.converged
    assert found.on_bound == ("c",)
    assert held.on_bound == found.unused == found.unidentifiable == ()
    np.testing.assert_allclose(found.params["c"], 0.1, rtol=1e-15)
    np.testing.assert_allclose(found.params["l"], held.params["l"], atol=1e-4 * held.std["l"])
    np.testing.assert_allclose(found.std["l"], held.std["l"], rtol=1e-4)
    assert np.isnan(found.std["c"])
    assert "on its bound" in str(found)


@pytest.mark.full
def test_a_parameter_comes_back_from_its_bound():
    """It starts there, or is driven there by a length that is far off."""
    bounds = {"c": jl.Bounded(0.0, np.inf)}
    with pytest.warns(UserWarning, match=r"c starts on its bound\."):
        found = fit(experiment(), params0=TRUE | {"l": 0.5, "c": 0.0}, transforms=bounds)
    within(found, ("l", "c"))
    plain = fit(experiment())
    np.testing.assert_allclose(found.values, plain.values, rtol=1e-5)
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-4)


@pytest.mark.full
def test_friction_that_is_not_there_ends_at_zero():
    """Data of a pendulum without any: c goes to 0, the end of what is positive."""
    motion = jl.simulate(pendulum, [1.0], [0.0], TS, TRUE | {"c": 0.0}, rtol=1e-11, atol=1e-11)
    # Noise that would have it negative.
    y = np.asarray(motion["x"]) * (1.0 + 2e-3 * TS)
    start = TRUE | {"l": 0.5, "c": 0.3}
    with pytest.warns(UserWarning, match=r"c ended on its bound, .*e-\d+: widen the bound"):
        found = fit(jl.Experiment(TS, {"x": y}), params0=start, transforms={"c": jl.Positive()})
    assert found.converged
    assert 0.0 < found.params["c"] < 1e-5
    np.testing.assert_allclose(found.params["l"], TRUE["l"], rtol=1e-2)


def test_motions_are_counted():
    data = experiment(sigma={"x": NOISE})
    found = fit(data.windows(1.0))
    assert found.solves == 3 * found.iterations


def test_a_known_start_is_kept_and_a_rough_one_is_weighed():
    exact = fit(experiment(q0=[1.0], v0=[0.0], start_sigma=0.0))
    assert exact.starts[0].tolist() == [1.0, 0.0]
    free = fit(experiment())
    assert exact.std["l"] < free.std["l"]
    rough = fit(experiment(q0=[1.1], v0=[0.0], start_sigma=1e-6))
    np.testing.assert_allclose(rough.starts[0], [1.1, 0.0], atol=1e-4)


@pytest.mark.full
@pytest.mark.parametrize("loss", ["soft_l1", "huber", "cauchy"])
def test_outliers_count_for_less(loss):
    y = angles()
    y[::10] += 0.3
    data = jl.Experiment(TS, {"x": y}, sigma={"x": NOISE})
    robust, plain = fit(data, loss=loss), fit(data)
    off = [abs(found.params["l"] - TRUE["l"]) for found in (robust, plain)]
    assert off[0] < 0.1 * off[1]


@pytest.mark.full
def test_a_segment_that_fails_is_named_and_does_not_count():
    """A spring that breaks at x = 2: beyond, the force is not a number."""

    def force(t, q, v, p):
        return -p["k"] * q + 1e-15 * jnp.sqrt(2.0 - q)

    spring = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(jl.GeneralizedForce(force, "spring"),)
    )
    ts = np.linspace(0.0, 2.0, 41)
    good = jl.Experiment(ts, {"x": np.cos(1.5 * ts)}, name="good")
    broken = jl.Experiment(ts, {"x": 3.0 + 0.0 * ts + 1e-3 * ts}, name="broken")
    with pytest.warns(UserWarning, match=r"segment of broken that starts at t = 0 s ended with"):
        found = jl.fit(spring, (good, broken), {"k": 2.0}, free=("k",), **OPTIONS)
    np.testing.assert_allclose(found.params["k"], 2.25, rtol=1e-6)
    assert len(found.failed) == 1
    assert np.isnan(found.residuals[1]["x"]).all()
    alone = jl.fit(spring, good, {"k": 2.0}, free=("k",), **OPTIONS)
    np.testing.assert_allclose(found.params["k"], alone.params["k"], rtol=1e-9)


def pulse(t, q, v, p):
    """Nothing, but for a while not a number."""
    return jnp.where((t > 1.3) & (t < 1.5), jnp.nan, 0.0) * v


@pytest.mark.full
@pytest.mark.parametrize("sigma", [{"x": NOISE}, None])
def test_a_segment_that_fails_within_a_chain_moves_nothing(sigma):
    """The gap that it leaves is not closed: what follows has a start of its own."""
    system = pendulum.with_forces(jl.GeneralizedForce(pulse, "pulse"))
    with pytest.warns(UserWarning, match=r"starts at t = 1\.2 s ended with nonfinite: it does not"):
        found = fit(experiment(sigma=sigma), system=system, segments=5)
    assert found.converged
    assert len(found.failed) == 1
    assert found.gap < 1e-6
    within(found, ("l",))
    # As two motions, one after the other.
    data = experiment(sigma=sigma)
    parts = fit((data.part(slice(0, 61)), data.part(slice(91, None))), system=system)
    np.testing.assert_allclose(found.params["l"], parts.params["l"], atol=0.5 * parts.std["l"])
    np.testing.assert_allclose(found.std["l"], parts.std["l"], rtol=0.2)


@pytest.mark.full
def test_a_channel_that_is_not_finite_is_named():
    data = jl.Experiment(TS, {"root": np.sqrt(np.abs(angles()))}, q0=[1.0], v0=[0.0])
    with pytest.warns(UserWarning, match="No segment has a solution at the estimates"):
        found = fit(data, channels={"root": lambda motion: jnp.sqrt(motion["x"])})
    assert not found.converged
    assert "a channel that is not finite: 'root'" in found.failed[0]
    assert np.isfinite(found.noise["root"])
    assert found.freedom == 0


@pytest.mark.full
@pytest.mark.parametrize("noise", [1e-4, 1e-7])
def test_segments_are_one_motion_however_precise_measurements_are(noise):
    """A spring; to a hundredth of the standard deviation."""
    spring = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2, ("x",))
    ts = np.linspace(0.0, 10.0, 101)
    x = 0.3 * np.cos(2.0 * ts) + noise * np.random.default_rng(1).normal(size=len(ts))
    options = {"free": ("k",), "rtol": 1e-11, "atol": 1e-11, "tolerance": 1e-8}
    data = jl.Experiment(ts, {"x": x})
    one, many = (jl.fit(spring, data, {"k": 3.9}, segments=n, **options) for n in (1, 10))
    assert abs(one.params["k"] - many.params["k"]) < 1e-2 * one.std["k"]
    np.testing.assert_allclose(one.std["k"], many.std["k"], rtol=1e-3)
    assert many.gap < 1e-2 * noise
    np.testing.assert_allclose(one.freedom, many.freedom, atol=1e-6)


@pytest.mark.full
def test_a_number_that_is_zero_is_known_as_well_as_any():
    """An offset whose truth is 0: its relative changes move nothing, it does."""
    spring = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p["k"] * (q[0] - p["x0"]) ** 2, ("x",)
    )
    ts = np.linspace(0.0, 30.0, 301)
    options = {"free": ("k", "x0"), "rtol": 1e-9, "atol": 1e-9}
    start = {"k": 3.9, "x0": 0.01}
    with no_warning():
        found = jl.fit(spring, jl.Experiment(ts, {"x": 0.3 * np.cos(2 * ts)}), start, **options)
    assert found.unidentifiable == found.unused == ()
    assert abs(found.params["x0"]) < 1e-9
    assert found.std["x0"] < 1e-9
    noise = 1e-4
    x = 0.3 * np.cos(2 * ts) + noise * np.random.default_rng(1).normal(size=len(ts))
    found = jl.fit(spring, jl.Experiment(ts, {"x": x}), start, **options)
    # Of the mean of independent measurements: k and the start swing, and share little of it.
    np.testing.assert_allclose(found.std["x0"], noise / np.sqrt(len(ts)), rtol=0.1)
    assert abs(found.params["x0"]) < 3.5 * found.std["x0"]


@pytest.mark.full
def test_starts_that_are_known_take_nothing_from_the_noise():
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
    rows = np.concatenate([each["x"] for each in found.residuals])
    np.testing.assert_allclose(found.noise["x"], np.sqrt(np.sum(rows**2) / 119), rtol=1e-3)


@pytest.mark.full
def test_starts_on_a_rod_are_two_numbers_each():
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
    found = jl.fit(rod, data, TRUE | {"l": 0.72}, free=("l",), rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(found.freedom, 80 - 21, atol=1e-4)
    # 59 numbers tell it to 9 %.
    np.testing.assert_allclose(found.noise["r"], 5e-3, rtol=0.25)


def test_a_prior_takes_part_of_what_it_tells():
    """One that is as good as exact leaves nothing to be told."""
    data = experiment(sigma={"x": NOISE})
    free, known = (fit(data, ("l",), priors={"l": jl.Prior(0.7, s)}) for s in (1e3, 1e-9))
    np.testing.assert_allclose(free.freedom, 151 - 3, atol=1e-3)
    np.testing.assert_allclose(known.freedom, 151 - 2, atol=1e-3)


@pytest.mark.full
@pytest.mark.parametrize("loss", ["soft_l1", "huber", "cauchy"])
def test_outliers_are_not_noise(loss):
    y = angles()
    y[::10] += 0.3
    found = fit(jl.Experiment(TS, {"x": y}), loss=loss)
    np.testing.assert_allclose(found.noise["x"], NOISE, rtol=0.4)
    assert abs(found.params["l"] - TRUE["l"]) < 4 * found.std["l"]


def test_intervals_of_few_measurements_are_those_of_student():
    found = fit(experiment().part(slice(0, 150, 30)), ("l",))
    np.testing.assert_allclose(found.freedom, 2.0, atol=1e-6)
    low, high = found.interval()["l"]
    # The quantile 0.975 of Student's t with 2 degrees of freedom, from a table.
    np.testing.assert_allclose(high - low, 2 * 4.3027 * found.std["l"], rtol=1e-4)
    with pytest.raises(ValueError, match=r"level must be between 0 and 1, but it was 95.*0\.95"):
        found.interval(95)


@pytest.mark.full
def test_columns_measured_by_turns():
    two = jl.System(lambda t, q, v, p: 0.5 * v @ v - 0.5 * p["k"] @ q**2, {"q": (2,)})
    noise = 1e-4 * np.random.default_rng(0).normal(size=(151, 2))
    q = 0.3 * np.cos(np.outer(TS, [2.0, 1.5])) + noise
    q[::2, 0] = q[1::2, 1] = np.nan
    data = jl.Experiment(TS, {"q": q})
    found = jl.fit(two, data, {"k": np.full(2, 3.0)}, free=("k",), **OPTIONS)
    np.testing.assert_allclose(found.params["k"], [4.0, 2.25], rtol=1e-3)


@pytest.mark.full
def test_warnings_name_what_they_are_about():
    with pytest.warns(UserWarning, match=r"c starts on its bound"):
        fit(experiment(), params0=TRUE | {"c": 0.0}, transforms={"c": jl.Bounded(0.0, 1.0)})
    with pytest.warns(UserWarning, match=r"nothing measured depends on spare"):
        found = fit(experiment(), ("l", "spare"), TRUE | {"spare": 1.0})
    assert found.params["spare"] == 1.0
    spare = {"transforms": {"spare": jl.Bounded(0.0, 1.0)}}  # on its bound, but not held there
    with pytest.warns(UserWarning, match=r"nothing measured depends on spare"):
        found = fit(experiment(), ("l", "spare"), TRUE | {"spare": 1.0}, **spare)
    assert found.on_bound == ()
    flat = jl.Experiment(TS, {"x": angles(), "x'": 0.0 * TS}, sigma={"x": NOISE, "x'": 1e3})
    with pytest.warns(UserWarning, match=r"channel \"x'\" of experiment is constant"):
        fit(flat)


def test_no_warning_without_reason():
    with no_warning():
        fit(experiment())


@pytest.mark.full
def test_windows_and_parts():
    pieces = experiment().windows(1.0)
    assert [len(piece.ts) for piece in pieces] == [50, 50, 50]
    assert pieces[1].ts[0] == TS[50]
    np.testing.assert_array_equal(pieces[2].channels["x"][:, 0], angles()[100:150])
    found = fit(pieces)
    within(found, ("l",))
    assert len(found.starts) == 3
    gap = jl.Experiment(np.concatenate([TS, TS + 10.0]), {"x": np.tile(angles(), 2)})
    assert [piece.ts[0] for piece in gap.windows(1.5)] == [0.0, 1.5, 10.0, 10.5]


@pytest.mark.parametrize(
    ("seconds", "message"),
    [
        (0, r"seconds must be a positive number, but it was 0"),
        (np.nan, r"seconds must be a positive number, but it was nan"),
        (-1, r"seconds must be a positive number, but it was -1"),
        (4.0, r"at most the 3\.02 s of experiment, but it was 4"),
        (0.03, r"seconds must be two samples or more, but it was 0\.03"),
    ],
)
def test_bad_windows_are_named(seconds, message):
    with pytest.raises(ValueError, match=message):
        experiment().windows(seconds)


@pytest.mark.parametrize(
    ("mean", "sigma", "message"),
    [
        (np.nan, 1.0, r"mean must be finite, but it was nan"),
        (1.0, 0.0, r"sigma must be positive and finite, but it was 0"),
        (1.0, np.inf, r"sigma must be positive and finite, .* Leave the prior out"),
    ],
)
def test_bad_priors_are_named(mean, sigma, message):
    with pytest.raises(ValueError, match=message):
        jl.Prior(mean, sigma)


NAN = np.full(len(TS), np.nan)


@pytest.mark.parametrize(
    ("ts", "channels", "options", "message"),
    [
        (TS[::-1], {"x": TS}, {}, r"ts must increase strictly, but ts\[0\] = 3 and"),
        (TS[:1], {"x": TS[:1]}, {}, r"one row of two times or more"),
        (TS, {"x": TS[:-1]}, {}, r"channels\['x'\] must have one row per time, 151"),
        (TS, {"x": NAN}, {}, r"channels\['x'\] must hold some numbers, but all were NaN"),
        (TS, {}, {}, r"one channel or more"),
        (TS, {"x": np.where(TS > 1, np.inf, TS)}, {}, r"finite, or NaN where nothing was measured"),
        (TS, {"x": TS}, {"sigma": {"x": 0.0}}, r"sigma\['x'\] must be positive"),
        (TS, {"x": TS}, {"sigma": {"x": np.inf}}, r"positive and finite, .* Write NaN into the"),
        (
            TS,
            {"x": TS},
            {"sigma": {"x": np.ones(3)}},
            r"a number, 151 of them, or of shape \(151, 1",
        ),
        (TS, {"x": TS}, {"sigma": {"y": 1.0}}, r"name channels among \['x'\], but one was 'y'"),
        (TS, {"x": TS}, {"q0": np.ones((3, 1))}, r"q0 must be \(n,\) numbers at ts\[0\]"),
        (TS, {"x": TS}, {"start_sigma": 0.0}, r"come with the start it is about"),
    ],
)
def test_a_bad_experiment_is_named(ts, channels, options, message):
    with pytest.raises(ValueError, match=message):
        jl.Experiment(ts, channels, **options)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"free": ("k",)}, r"free must name parameters among \['c', 'g', 'l', 'm'\], but one was"),
        ({"free": "l"}, r"Write free=\('l',\)"),
        ({"segments": 0}, r"segments must be a positive integer"),
        ({"segments": 100}, r"leave two rows or more to each"),
        ({"loss": "abs"}, r"loss must be one of"),
        ({"optimiser": "adam"}, r"optimiser must be None or a jl\.Descent, .*optax"),
        ({"rtol": np.ones(2)}, r"rtol must be one number, a name or an object without arrays"),
        ({"transforms": {"m": jl.Positive()}}, r"transforms must be of free parameters"),
        ({"transforms": {"l": 3}}, r"transforms\['l'\] must be a transform"),
        ({"priors": {"m": jl.Prior(1.0, 1.0)}}, r"priors must be of free parameters"),
        ({"params0": TRUE | {"l": 1}}, r"hold real numbers to be found, but it was 1"),
        ({"priors": {"l": (1.0, 1.0)}}, r"priors\['l'\] must be a jl\.Prior, .* Write jl\.Prior"),
        (
            {"priors": {"l": jl.Prior(1.0, [1.0, 2.0])}},
            r"shape \(\), but its mean had \(\), its sigma \(2,\)",
        ),
        ({"tolerance": -1.0}, r"tolerance must be a number between 0 and 1"),
        ({"max_iterations": 0}, r"max_iterations must be a positive integer, but it was 0"),
        ({"save": ("a",)}, r"save must be left to jl\.fit"),
        (
            {"data": None},
            r"experiments must be a jl\.Experiment or a sequence of them, but it was N",
        ),
        (
            {"data": jl.Experiment(TS, {"x": np.stack([TS, TS], axis=1)})},
            r"channels\['x'\] must have 1 columns.* but it had 2\. Fill columns",
        ),
        (
            {
                "data": jl.Experiment(TS, {"x": TS, "r": TS}),
                "channels": {"r": lambda motion: motion.q[:, [0, 0]]},
            },
            r"channels\['r'\] must have as many columns as were measured, 1, .* shows \(151, 2\)",
        ),
        (
            {"data": experiment(q0=[1.0], v0=[0.0], start_sigma=np.ones(3))},
            r"start_sigma must be one number or 2, of all coordinates and velocities that are free",
        ),
        ({"data": ()}, r"experiments must be a jl\.Experiment or a sequence"),
        ({"data": jl.Experiment(TS, {"y": TS})}, r"be named as one of .*, but one was 'y'"),
        ({"data": jl.Experiment(TS, {"energy": TS})}, r"be among the channels or in q0"),
        ({"data": jl.Experiment(TS[:2], {"x": TS[:2]})}, r"at least as many numbers as there are"),
    ],
)
def test_bad_arguments_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        fit(changes.pop("data", experiment()), **changes)
