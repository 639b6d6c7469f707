"""Predictions of recordings that were not fitted, from fitted starts."""

import jax.numpy as jnp
import numpy as np
import pytest
from _measured import NOISE, OPTIONS, STEPS, TRUE, TS, angles, experiment, pendulum

import jaxlag as jl


def predict(data, params=TRUE, **options):
    return jl.predict(pendulum, data, params, **(OPTIONS | options))


@pytest.mark.full
def test_the_truth_predicts_to_the_noise_and_wrong_params_do_not():
    """Starts are fitted to the first half second of two recordings of unequal length."""
    short = jl.Experiment(TS[:100], {"x": angles(TS[:100], seed=1)}, name="short")
    found = predict((experiment(), short), settle=0.5)
    # 26 samples determine the start to about NOISE/2, which the motion preserves.
    assert 0.8 * NOISE < found.rms("x")[0] < 1.6 * NOISE
    np.testing.assert_allclose(found.starts[0], [1.0, 0.0], atol=8e-3)
    assert [selected.sum() for selected in found.predicted] == [151 - 26, 100 - 26]
    assert found.residuals[1]["x"].shape == (100, 1)
    wrong = predict((experiment(), short), TRUE | {"l": 0.8}, settle=0.5)
    assert wrong.rms("x")[0] > 20 * NOISE
    assert "rms of x: " in str(found)
    assert found.converged
    with pytest.raises(ValueError, match=r"`channel` must be one of \['x'\], but it was 'y'"):
        found.rms("y")


@pytest.mark.full
def test_start_fitted_to_all_samples_is_optimal():
    """It is the start of least squares: no start nearby has a smaller error."""
    found = predict(experiment())
    assert found.predicted[0].all()

    def size(start):
        motion = jl.simulate(pendulum, start[:1], start[1:], TS, TRUE, **STEPS)
        return np.sum((np.asarray(motion["x"]) - angles()) ** 2)

    start = np.asarray(found.starts[0])
    np.testing.assert_allclose(np.sqrt(size(start) / len(TS)), found.rms("x")[0], rtol=1e-9)
    h = 1e-4
    slopes = [(size(start + h * e) - size(start - h * e)) / (2 * h) for e in np.eye(2)]
    # Curvature 2 sum x_start^2 is about 2 * 75: the slope is that of an error of 1e-6.
    np.testing.assert_allclose(slopes, 0.0, atol=1e-6 * 2 * 75)


@pytest.mark.full
def test_predictions_of_a_fit_equal_those_of_its_params():
    found = jl.fit(pendulum, experiment(), TRUE | {"l": 0.6, "c": 0.1}, free=("l", "c"), **OPTIONS)
    other = jl.Experiment(TS, {"x": angles(seed=5, q0=0.6)}, name="other")
    own = found.predict(other, settle=1.0)
    again = predict(other, found.params, settle=1.0, noise=found.noise)
    np.testing.assert_array_equal(own.residuals[0]["x"], again.residuals[0]["x"])
    assert own.rms("x")[0] < 1.5 * NOISE


@pytest.mark.full
def test_search_that_does_not_converge_gives_a_warning():
    with pytest.warns(
        UserWarning, match=r"search for initial states did not converge in 1 iterations: raise"
    ):
        found = predict(experiment(), settle=0.5, max_steps=1)
    assert not found.converged


@pytest.mark.full
def test_failed_motion_gives_a_warning():
    """A force that is NaN beyond x = 1.2, which one of the two motions passes."""

    def stop(t, q, v, p):
        return jnp.where(jnp.abs(q) > 1.2, jnp.nan, 0.0) * v

    system = pendulum.with_forces(jl.GeneralizedForce(stop, "stop"))
    wide = jl.Experiment(TS, {"x": angles(q0=1.5)}, name="wide")
    with pytest.warns(UserWarning, match=r"motion of wide ended with nonfinite: it is ignored"):
        found = jl.predict(system, (experiment(), wide), TRUE, **OPTIONS)
    assert found.failed == ("the motion of wide ended with nonfinite",)
    assert 0.8 * NOISE < found.rms("x")[0] < 1.2 * NOISE


@pytest.mark.full
def test_figures_show_measurements_and_motions(tmp_path):
    many = [experiment(name=f"run {k}") for k in range(6)]
    found = predict(many, settle=0.5)
    figure = found.plot()
    assert len(figure.axes) == 2 * 4
    dots = figure.axes[0].lines[1]
    assert set(dots.get_ydata()) <= set(many[0].channels["x"][:, 0])
    line = figure.axes[0].lines[0]
    motion = many[0].channels["x"] + found.residuals[0]["x"]
    np.testing.assert_array_equal(line.get_ydata(), motion[:, 0])
    figure.savefig(tmp_path / "figure.png")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"settle": 0.0}, r"`settle` must be a positive number of seconds, or None, but it was 0"),
        ({"settle": 5.0}, r"`settle` must leave samples of experiment to be predicted.*5 s of 3 s"),
        (
            {"settle": 1e-3},
            r"`settle` must contain 2 measurements or more.*contain 1.*Raise settle",
        ),
        (
            {"simulate_options": {"save": ("a",)}},
            r"`save` must be left out, since jl\.predict sets",
        ),
    ],
)
def test_invalid_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        predict(experiment(), **options)
