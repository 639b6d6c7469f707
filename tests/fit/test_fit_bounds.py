"""Fits with transforms: bounds that end a search, are left again, or have no effect."""

import numpy as np
import pytest
from _measured import NOISE, TRUE, TS, experiment, fit, pendulum, within
from _silence import no_warning

import jaxlag as jl
from jaxlag._fit import _multiple_shooting


@pytest.mark.full
def test_transforms_do_not_change_estimates_and_covariances():
    plain = fit(experiment())
    held = fit(
        experiment(),
        transforms={"l": jl.transforms.Positive(), "c": jl.transforms.Bounded(0.0, 1.0)},
    )
    np.testing.assert_allclose(held.values, plain.values, rtol=1e-4)
    np.testing.assert_allclose(held.covariance, plain.covariance, rtol=1e-3)


@pytest.mark.full
@pytest.mark.parametrize("start", [1e-6, 1e-12, 1e-18])
def test_search_does_not_depend_on_the_size_of_the_start(start):
    plain = fit(experiment())
    with no_warning():
        found = fit(experiment(), ("l", "c"), TRUE | {"l": 0.69, "c": start})
    np.testing.assert_allclose(found.values, plain.values, atol=1e-3 * plain.std["c"])
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-3)


@pytest.mark.full
def test_parameter_on_its_bound_equals_it_exactly():
    """The bound is 0.1 + 0.2, so that rounding would show; a search may leave its first bound."""
    bound = jl.transforms.Bounded(0.1 + 0.2, 1.0)
    with pytest.warns(UserWarning, match="c ended on its bound"):
        found = fit(
            experiment(), params0=TRUE | {"l": 0.5, "c": 0.7 / 0.9}, transforms={"c": bound}
        )
    assert float(found.params["c"]) == 0.1 + 0.2
    with pytest.warns(UserWarning, match="c starts on its bound"):
        again = fit(
            experiment(),
            params0=found.params,
            transforms={"c": jl.transforms.Bounded(0.0, 0.1 + 0.2)},
        )
    within(again, ("l", "c"))


@pytest.mark.full
def test_bounded_least_squares_are_compiled_only_for_bounds(monkeypatch):
    """Unbounded parameters take plain steps of least squares."""

    def box(*_):
        raise AssertionError("a box")

    monkeypatch.setattr(_multiple_shooting, "box_least_squares", box)
    data = experiment().part(slice(0, 77))  # a shape that no other test has compiled
    fit(data)
    with pytest.raises(AssertionError, match="a box"):
        fit(data, transforms={"l": jl.transforms.Positive()})


BOUNDS = [jl.transforms.Bounded(0.1, 1.0), jl.transforms.Bounded(0.1, np.inf)]


@pytest.mark.full
@pytest.mark.parametrize(
    "bounds", [BOUNDS[0], pytest.param(BOUNDS[1], marks=pytest.mark.full)], ids=["both", "one"]
)
def test_parameter_on_its_bound_is_named_and_others_are_estimated(bounds):
    """As if it were fixed there; the truth is below the bound."""
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
def test_parameter_leaves_its_bound_again():
    """It starts there, or is moved there by a length that is far off."""
    bounds = {"c": jl.transforms.Bounded(0.0, np.inf)}
    with pytest.warns(UserWarning, match=r"c starts on its bound\."):
        found = fit(experiment(), params0=TRUE | {"l": 0.5, "c": 0.0}, transforms=bounds)
    within(found, ("l", "c"))
    plain = fit(experiment())
    np.testing.assert_allclose(found.values, plain.values, rtol=1e-5)
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-4)


@pytest.mark.full
def test_absent_friction_ends_at_zero():
    """Data of a pendulum without friction: c goes to 0, the limit of positive values."""
    motion = jl.simulate(pendulum, [1.0], [0.0], TS, TRUE | {"c": 0.0}, rtol=1e-11, atol=1e-11)
    # Noise that would make it negative.
    y = np.asarray(motion["x"]) * (1.0 + 2e-3 * TS)
    start = TRUE | {"l": 0.5, "c": 0.3}
    with pytest.warns(UserWarning, match=r"c ended on its bound, .*e-\d+: widen the bound"):
        found = fit(
            jl.Experiment(TS, {"x": y}), params0=start, transforms={"c": jl.transforms.Positive()}
        )
    assert found.converged
    assert 0.0 < found.params["c"] < 1e-5
    np.testing.assert_allclose(found.params["l"], TRUE["l"], rtol=1e-2)
