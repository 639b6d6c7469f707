"""Candidate forces ranked by their predictions."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from _measured import OPTIONS, TRUE, TS, angles

import jaxlag as jl
from jaxlag._fit._select_model import Ranked, _estimates, _in_order, _squares
from tests._user import unchecked  # noqa: F401


def lagrangian(t, q, v, p):
    return 0.5 * (p["l"] * v[0]) ** 2 + p["g"] * p["l"] * jnp.cos(q[0])


bare = jl.System(lagrangian, ("x",))
viscous = jl.Candidate(
    jl.Rayleigh(lambda t, q, v, p: 0.5 * p["c"] * v[0] ** 2, "viscous"), params0={"c": 0.02}
)
cubic = jl.Candidate(
    jl.Rayleigh(lambda t, q, v, p: 0.25 * p["k"] * v[0] ** 4, "cubic"), params0={"k": 0.001}
)
START = {"l": 0.65, "g": 9.81}


def measured(q0, seed):
    return jl.Experiment(TS, {"x": angles(q0=q0, seed=seed)}, name=f"from {q0}")


def compare(candidates, **options):
    return jl.select_model(
        bare,
        measured(1.0, 0),
        START,
        candidates,
        held_out=measured(0.4, 1),
        **({"free": ("l",), "fit_options": OPTIONS} | options),
    )


@pytest.mark.full
def test_active_term_ranks_first():
    found = compare({"cubic": cubic, "viscous": viscous}, settle=0.5)
    assert [model.name for model in found.models] == ["viscous", "cubic", "none"]
    best = found.best
    assert best is found["viscous"]
    assert abs(best.fit.params["c"] - TRUE["c"]) < 3.5 * best.fit.std["c"]
    assert found["none"].error > 3 * best.error
    lines = str(found).splitlines()
    assert lines[0].split() == ["model", "params", "error", "rms", "of", "x"]
    assert lines[1].startswith("viscous  2 ")


@pytest.mark.full
def test_combinations_are_no_better_than_the_active_term():
    """Both terms predict no better than the active one, within the noise."""
    found = compare({"cubic": cubic, "viscous": viscous}, most=2)
    both = found["cubic + viscous"]
    assert len(found.models) == 4
    assert set(both.fit.names) == {"l", "c", "k"}
    np.testing.assert_allclose(both.error, found["viscous"].error, rtol=0.05)
    with pytest.raises(ValueError, match=r"`model` must be one of .*'cubic \+ viscous'"):
        found["dry"]


@pytest.mark.full
def test_separate_candidates_may_share_params():
    """The second search starts at the estimates of the first, and ends as from elsewhere."""
    both = jl.Candidate(*viscous.forces, *cubic.forces, params0=viscous.params0 | cubic.params0)
    found = compare({"viscous": viscous, "viscous, cubic": both})["viscous, cubic"].fit
    alone = compare({"viscous, cubic": both})["viscous, cubic"].fit
    for name in ("l", "c", "k"):
        near = 1e-2 * alone.std[name]
        np.testing.assert_allclose(found.params[name], alone.params[name], atol=near)


def test_search_starts_at_estimates_of_the_best_related_model():
    """At the estimates of the best model that shares most of its params; not on a bound."""

    def ranked(error, params, on_bound=(), converged=True, fitted=None):
        data = jl.Experiment([0.0, 1.0], {"x": [0.0, 2.0]})  # ranges over 1
        fit = SimpleNamespace(
            params=params,
            on_bound=on_bound,
            converged=converged,
            failed=(),
            channels=("x",),
            rms=lambda _: np.array([fitted or error]),
            experiments=(data,),
        )
        return Ranked("", error, fit, None, np.zeros(0))

    own = {"l": 1.0, "c": 1.0, "k": np.ones(2)}
    none, unconverged = ranked(3.0, {"l": 2.0}), ranked(1.0, {"l": 9.0, "c": 9.0}, converged=False)
    far = ranked(np.inf, {"l": 8.0, "c": 8.0})
    better, worse = ranked(1.5, {"l": 3.0, "c": 4.0, "x": 1.0}), ranked(2.0, {"l": 5.0, "c": 6.0})
    bound = ranked(1.0, {"l": 7.0, "k": np.zeros(2)}, ("k[1]",))

    def start(*models, transforms=None):
        return _estimates(own, {"l"}, models, transforms or {})

    assert start() == start(none) == start(none, unconverged, far) == {}
    assert start(none, unconverged, worse, far, better) == {"l": 3.0, "c": 4.0}
    assert start(none, bound) == {"l": 7.0}
    # Held-out data have no effect.
    fits = ranked(9.0, {"l": 6.5, "c": 6.6}, fitted=1.0)
    assert start(better, fits) == {"l": 6.5, "c": 6.6}
    # Nor have params of another form, or those that a transform excludes.
    other = ranked(1.0, {"l": 3.0, "c": 4.0, "k": np.ones(3)})
    assert start(other) == {"l": 3.0, "c": 4.0}
    bounds = {"c": jl.transforms.Bounded(0.0, 2.0), "l": jl.transforms.Positive()}
    assert start(better, transforms=bounds) == {"l": 3.0}
    bounds = {"c": jl.transforms.Bounded(0.0, 4.0)}
    assert start(better, transforms=bounds) == {"l": 3.0}


def test_forces_are_added_to_a_system():
    more = bare.with_forces(*viscous.forces)
    params = {"l": 0.5, "g": 0.0, "c": 0.3}
    q, v = jnp.array([0.2]), jnp.array([1.5])
    np.testing.assert_allclose(more.acceleration(q, v, params), [-0.3 * 1.5 / 0.25], rtol=1e-14)
    assert bare.forces == ()
    assert more.constraints == ()
    assert more.lagrangian is bare.lagrangian
    with pytest.raises(ValueError, match="distinct names"):
        more.with_forces(*viscous.forces)


@pytest.mark.parametrize(
    ("candidates", "options", "message"),
    [
        ({}, {}, r"`candidates` must be a dict of jl\.Candidate by name, but it was \{\}"),
        ({"a": 3}, {}, r"`candidates\['a'\]` must be a jl\.Candidate, but it was 3"),
        (
            {"a": viscous, "b": viscous},
            {"most": 2},
            r"other names, but candidate 'a' also has 'c'",
        ),
        ({"a": viscous}, {"free": "l"}, r"`free` must be a sequence of names.*Write free=\('l',\)"),
        ({"a": viscous}, {"transforms": ["c"]}, r"`transforms` must be a dict by name"),
        ({"a": viscous}, {"priors": ["c"]}, r"`priors` must be a dict by name"),
        ({"a": viscous}, {"most": 2}, r"`most` must be an integer from 1 to the 1 candidates"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_invalid_arguments_are_named(candidates, options, message):
    with pytest.raises(ValueError, match=message):
        compare(candidates, **options)


def test_a_candidate_without_a_force_is_named():
    with pytest.raises(
        ValueError, match=r"`forces` must be one force or more.*Write jl\.Candidate"
    ):
        jl.Candidate(params0={"k": 1.0})


def ranked(name, params, squares):
    fit = SimpleNamespace(names=tuple(range(params)))
    return Ranked(name, float(np.sqrt(np.mean(squares))), fit, None, np.array(squares))


def test_the_smaller_of_two_equal_models_is_first():
    """Equal within the standard error of the difference of their blocks, not of each alone."""
    rng = np.random.default_rng(0)
    hard = rng.uniform(0.5, 2.0, 20)  # blocks differ more than models do
    better = 0.9 * hard
    equal = better + np.where(np.arange(20) % 2, 0.011, -0.01)
    failed = ranked("failed", 1, np.full(20, np.inf))
    models = [
        failed,
        ranked("four", 4, better),
        ranked("two", 2, equal),
        ranked("three", 3, equal - 0.0002),
        ranked("one", 1, hard),
    ]
    found = _in_order(models)
    assert [model.name for model in found] == ["two", "three", "four", "one", "failed"]
    assert found[3].std == pytest.approx(
        np.std(hard, ddof=1) / np.sqrt(20) / (2 * np.sqrt(np.mean(hard)))
    )
    assert np.isnan(failed.std)


def test_blocks_of_squares_average_to_the_error():
    """Missing measurements are left out; a motion that failed is infinitely wrong."""
    data = jl.Experiment(TS, {"x": np.where(TS < 0.5, np.nan, np.sin(TS))})
    off = np.full((len(TS), 1), 0.1)
    prediction = jl.Prediction(({"x": off},), (TS > 0.2,), (TS[:2],), (), True, (data,))
    found = _squares(prediction, (data,))
    scale = np.nanstd(data.channels["x"])
    np.testing.assert_allclose(found, (0.1 / scale) ** 2, rtol=1e-14)
    assert 8 <= len(found) <= 10
    prediction.residuals[0]["x"] = np.full_like(off, np.nan)
    assert np.all(np.isinf(_squares(prediction, (data,))))
