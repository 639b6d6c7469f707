"""Fits of motions with known parameters; every warning and error by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _measured import (
    NOISE,
    OPTIONS,
    STEPS,
    TRUE,
    TS,
    angles,
    driven,
    experiment,
    fit,
    pendulum,
    tight,
    within,
)
from _silence import no_warning

import jaxlag as jl
from tests._user import unchecked  # noqa: F401


@pytest.mark.full
@pytest.mark.parametrize("segments", [1, 5])
def test_parameters_start_and_noise_are_found(segments):
    found = fit(experiment(), segments=segments)
    assert found.converged
    within(found, ("l", "c"))
    np.testing.assert_allclose(found.starts[0], [1.0, 0.0], atol=5e-3)
    # A standard deviation of 151 samples is known to 6 %.
    np.testing.assert_allclose(found.noise["x"], NOISE, rtol=0.2)
    np.testing.assert_allclose(found.rms("x"), NOISE, rtol=0.2)
    low, high = found.interval()["l"]
    assert low < TRUE["l"] < high
    assert found.gap < 1e-4
    assert "95 % in" in str(found)


@pytest.mark.full
def test_segments_give_the_estimates_of_one_motion():
    """Joined ever more tightly they are one motion: the estimates are equal.

    The tolerance is a hundredth of their standard deviations.
    """
    one, many = (fit(experiment(), segments=k, rtol=1e-7, atol=1e-7) for k in (1, 5))
    for name in ("l", "c"):
        assert abs(one.params[name] - many.params[name]) < 1e-2 * one.std[name]
        np.testing.assert_allclose(one.std[name], many.std[name], rtol=1e-2)


@pytest.mark.full
def test_covariance_equals_that_of_dense_derivatives():
    """(J^T J)^-1 of params and starts, from central differences of simulations."""
    data = experiment(sigma={"x": NOISE})
    found = fit(data)

    def residuals(x):
        params = TRUE | {"l": x[0], "c": x[1]}
        motion = jl.simulate(pendulum, x[2:3], x[3:4], TS, params, **STEPS)
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
def test_gaps_and_sampling_rates_do_not_affect_estimates():
    """Padding and gaps have no effect: the fit equals that of the present samples."""
    short = np.linspace(0.0, 1.0, 23)
    y = angles()
    with_gap = y.copy()
    with_gap[40:70] = np.nan
    second = {"x": angles(short, 0.6, seed=1)}
    selected = np.isfinite(with_gap)
    one = fit((jl.Experiment(TS, {"x": with_gap}), jl.Experiment(short, second)))
    same = jl.Experiment(TS[selected], {"x": y[selected]}), jl.Experiment(short, second)
    # Fixed steps do not depend on the save times.
    other = fit(same)
    within(one, ("l", "c"))
    np.testing.assert_allclose(one.values, other.values, rtol=1e-6)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-4)
    assert np.isnan(one.residuals[0]["x"][40:70]).all()
    assert np.isfinite(one.residuals[1]["x"]).all()


@pytest.mark.full
def test_driven_motion_is_fitted_by_its_rate_and_a_channel():
    """Torque from a table, in segments; a measured rate and a user-defined channel."""
    times = np.linspace(0.0, 3.0, 61)
    torque = jl.LinearInterpolation(times, 0.8 * np.sin(3.0 * times))
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


@pytest.mark.full
def test_unidentifiable_parameters_are_named():
    """L is m times a function of l and g/l: a free swing determines g/l and c/(m l^2)."""
    found = fit(experiment(), ("m", "l", "g"), TRUE | {"c": 0.05})
    assert len(found.unidentifiable) == 1
    assert np.isinf(found.std["g"])
    assert any(text in found.determined for text in ("l/g", "g/l"))
    ratio = found.params["g"] / found.params["l"]
    np.testing.assert_allclose(ratio, TRUE["g"] / TRUE["l"], rtol=3e-3)


def test_priors_determine_unidentifiable_parameters():
    prior = {"g": jl.Prior(9.81, 0.01)}
    found = fit(experiment(), ("l", "g", "m"), TRUE | {"l": 0.6}, priors=prior)
    assert not found.unidentifiable
    np.testing.assert_allclose(found.std["g"], 0.01, rtol=1e-2)
    within(found, ("l",))


@pytest.mark.full
def test_search_stopped_by_errors_of_the_solver_gives_a_warning():
    """Dry friction with a steep change of sign, which steps at 1e-5 sometimes skip."""
    dry = jl.GeneralizedForce(lambda t, q, v, p: -p["f"] * jnp.tanh(v / 0.02), "dry")
    system, ts = pendulum.with_forces(dry), np.linspace(0.0, 8.0, 401)
    true = TRUE | {"f": 0.1}
    motion = jl.simulate(system, [1.0], [0.0], ts, true, rtol=1e-10, atol=1e-10)
    noise = 1e-4 * np.random.default_rng(0).normal(size=len(ts))
    data = jl.Experiment(ts, {"x": np.asarray(motion["x"]) + noise}, sigma={"x": 1e-4})
    free = ("l", "c", "f")
    start = true | {"l": 0.69, "c": 0.02, "f": 0.15}
    with pytest.warns(UserWarning, match=r"the Newton step is .* standard deviations long: lower"):
        found = jl.fit(system, data, start, free=free, simulate_options=tight(1e-5, method="tsit5"))
    assert found.distance > 0.3
    with no_warning():
        found = jl.fit(
            system, data, start, free=free, simulate_options=tight(1e-10, method="tsit5")
        )
    assert found.distance < 0.05
    for name in ("l", "c", "f"):
        assert abs(found.params[name] - true[name]) < 3.5 * found.std[name]


@pytest.mark.full
def test_motions_are_counted():
    data = experiment(sigma={"x": NOISE})
    found = fit(data.windows(1.0))
    assert found.solves == 3 * found.iterations


@pytest.mark.full
def test_known_start_is_fixed_and_uncertain_one_is_weighted():
    exact = fit(experiment(q0=[1.0], v0=[0.0], start_sigma=0.0))
    assert exact.starts[0].tolist() == [1.0, 0.0]
    free = fit(experiment())
    assert exact.std["l"] < free.std["l"]
    rough = fit(experiment(q0=[1.1], v0=[0.0], start_sigma=1e-6))
    np.testing.assert_allclose(rough.starts[0], [1.1, 0.0], atol=1e-4)


@pytest.mark.full
def test_failed_segment_is_named_and_omitted():
    """A spring that breaks at x = 2: beyond, the force is NaN."""

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
    """A force of zero that is NaN for a while."""
    return jnp.where((t > 1.3) & (t < 1.5), jnp.nan, 0.0) * v


@pytest.mark.full
@pytest.mark.parametrize("sigma", [{"x": NOISE}, None])
def test_failed_segment_within_a_chain_does_not_change_the_fit(sigma):
    """The gap at this segment is not closed: the next segment has a separate start."""
    system = pendulum.with_forces(jl.GeneralizedForce(pulse, "pulse"))
    with pytest.warns(
        UserWarning, match=r"starts at t = 1\.2 s ended with nonfinite: it is ignored"
    ):
        found = fit(experiment(sigma=sigma), system=system, segments=5)
    assert found.converged
    assert len(found.failed) == 1
    assert found.gap < 1e-6
    within(found, ("l",))
    # As two consecutive motions.
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
def test_warnings_name_parameters_and_channels():
    with pytest.warns(UserWarning, match=r"c starts on its bound"):
        fit(
            experiment(),
            params0=TRUE | {"c": 0.0},
            transforms={"c": jl.transforms.Bounded(0.0, 1.0)},
        )
    with pytest.warns(UserWarning, match=r"nothing measured depends on spare"):
        found = fit(experiment(), ("l", "spare"), TRUE | {"spare": 1.0})
    assert found.params["spare"] == 1.0
    spare = {
        "transforms": {"spare": jl.transforms.Bounded(0.0, 1.0)}
    }  # on its bound, but not fixed there
    with pytest.warns(UserWarning, match=r"nothing measured depends on spare"):
        found = fit(experiment(), ("l", "spare"), TRUE | {"spare": 1.0}, **spare)
    assert found.on_bound == ()
    flat = jl.Experiment(TS, {"x": angles(), "x'": 0.0 * TS}, sigma={"x": NOISE, "x'": 1e3})
    with pytest.warns(UserWarning, match=r"channel \"x'\" of experiment is constant"):
        fit(flat)


def test_no_warning_without_reason():
    with no_warning():
        fit(experiment())


@pytest.mark.parametrize(
    ("mean", "sigma", "message"),
    [
        (np.nan, 1.0, r"`mean` must be finite, but it was nan"),
        (1.0, 0.0, r"`sigma` must be positive and finite, but it was 0"),
        (1.0, np.inf, r"`sigma` must be positive and finite, .* Leave the prior out"),
    ],
)
def test_invalid_priors_are_named(mean, sigma, message):
    with pytest.raises(ValueError, match=message):
        jl.Prior(mean, sigma)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"free": ("k",)},
            r"`free` must name parameters among \['c', 'g', 'l', 'm'\], but one was",
        ),
        ({"free": "l"}, r"Write free=\('l',\)"),
        ({"segments": 0}, r"`segments` must be a positive integer"),
        ({"segments": 100}, r"leave two samples or more in each segment"),
        ({"loss": "abs"}, r"`loss` must be one of"),
        ({"optimizer": "adam"}, r"`optimizer` must be None or a jl\.Descent, .*optax"),
        (
            {"simulate_options": {"rtol": np.ones(2)}},
            r"`rtol` must be one number, a name or an object without arrays",
        ),
        (
            {"transforms": {"m": jl.transforms.Positive()}},
            r"`transforms` must be of free parameters",
        ),
        ({"transforms": {"l": 3}}, r"`transforms\['l'\]` must be a transform"),
        ({"priors": {"m": jl.Prior(1.0, 1.0)}}, r"`priors` must be of free parameters"),
        ({"params0": TRUE | {"l": 1}}, r"hold floating-point numbers if it is free, but it was 1"),
        ({"priors": {"l": (1.0, 1.0)}}, r"`priors\['l'\]` must be a jl\.Prior, .* Write jl\.Prior"),
        (
            {"priors": {"l": jl.Prior(1.0, [1.0, 2.0])}},
            r"shape \(\), but its mean had \(\), its sigma \(2,\)",
        ),
        ({"params0": TRUE | {"l": np.nan}}, r"`params0\['l'\]` must be finite, but it was nan"),
        ({"params0": TRUE | {"m": np.inf}}, r"`params0\['m'\]` must be finite, but it was inf"),
        ({"transforms": ["l"]}, r"`transforms` must be a dict by name, .* jl\.transforms\.Pos"),
        ({"priors": ["l"]}, r"`priors` must be a dict by name, .* Write priors=\{'name': jl\.Pr"),
        ({"channels": ["x"]}, r"`channels` must be a dict by name, but it was \['x'\]"),
        ({"params0": [0.5, 0.1]}, r"`free` must name parameters among \['\[0\]', '\[1\]'\]"),
        ({"rtol": -1.0}, r"`rtol` must be a number between 0 and 1"),
        ({"atol": 1.0}, r"`atol` must be a number between 0 and 1"),
        ({"max_steps": 0}, r"`max_steps` must be a positive integer, but it was 0"),
        ({"simulate_options": {"save": ("a",)}}, r"`save` must be left out, since jl\.fit sets"),
        (
            {"data": None},
            r"`experiments` must be a jl\.Experiment or a sequence of them, but it was N",
        ),
        (
            {"data": jl.Experiment(TS, {"x": np.stack([TS, TS], axis=1)})},
            r"`channels\['x'\]` must have 1 columns.* but it had 2\. Fill columns",
        ),
        (
            {
                "data": jl.Experiment(TS, {"x": TS, "r": TS}),
                "channels": {"r": lambda motion: motion.q[:, [0, 0]]},
            },
            r"`channels\['r'\]` must have as many columns as were .* its shape was \(151, 2\)",
        ),
        (
            {"data": experiment(q0=[1.0], v0=[0.0], start_sigma=np.ones(3))},
            r"`start_sigma` must be one number or 2, one for each coordinate and each of the free",
        ),
        ({"data": ()}, r"`experiments` must be a jl\.Experiment or a sequence"),
        ({"data": jl.Experiment(TS, {"y": TS})}, r"be named as one of .*, but one was 'y'"),
        ({"data": jl.Experiment(TS, {"energy": TS})}, r"be among the channels or in q0"),
        ({"data": jl.Experiment(TS[:2], {"x": TS[:2]})}, r"at least as many numbers as there are"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_invalid_arguments_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        fit(changes.pop("data", experiment()), **changes)


def test_a_fit_inside_jit_is_refused():
    data = experiment()
    with pytest.raises(ValueError, match=r"`fit` inside jit, .* is not supported: its search runs"):
        jax.jit(lambda x: fit(data, params0=TRUE | {"l": x}).params["l"])(0.5)
    with pytest.raises(ValueError, match=r"An Experiment inside jit.* is not supported: its meas"):
        jax.jit(lambda x: jl.Experiment(TS, {"x": x}).ts)(TS)
