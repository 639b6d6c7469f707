"""Statistics of sweeps: those of numpy on all trajectories; failed ones are counted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import Status
from jaxlag._sweep._statistics import Moments

EPS = np.finfo(float).eps
TS = np.linspace(0.0, 1.0, 4)
N = 2500
EDGES = np.array([-1.0, -0.2, 0.0, 0.5, 1.2])


def lagrangian(t, q, v, p):
    """Two springs; the second mass is a point of the plane."""
    return 0.5 * (v @ v) - 0.5 * p["k"] * (q @ q)


PLANE = jl.System(
    lagrangian,
    {"x": (), "r": (2,)},
    forces=(jl.GeneralizedForce(lambda t, q, v, p: -0.1 * v, "drag"),),
)


def draw(key, index):
    """Every hundredth one needs more than max_steps, from its first step on."""
    stiff = jnp.where(index % 100 == 7, 1e9, 1.0)
    return jl.Case([1.0, 0.5, 0.0], [0.0, 0.0, 1.0], {"k": stiff * jnp.exp(jax.random.normal(key))})


NAMES = ("x", "r", "energy", "power drag")


def swept(statistics=None, **changed):
    given = {
        "system": PLANE,
        "cases": draw,
        "n": N,
        "ts": TS,
        "keep": ("x", "r", "energy", "power"),
        "statistics": statistics,
        "simulate_options": {"max_steps": 200},
    }
    return jl.sweep(**(given | changed))


@pytest.fixture(scope="module")
def run():
    every = jl.Statistics(NAMES, covariance=True, quantiles=True, histograms={"r": EDGES})
    return swept(every)


def test_moments_and_extremes_are_those_of_numpy(run):
    """Of trajectories that reached a time."""
    assert run.report.statuses == {"ok": 2475, "max_steps": 25}
    for name in NAMES:
        x, found = run[name], run.statistics[name]
        assert found.mean.shape == x.shape[1:]
        np.testing.assert_array_equal(found.count, np.isfinite(x).sum(0))
        np.testing.assert_array_equal(found.count[1:], 2475)
        scale, sums = np.nanmax(np.abs(x)), np.sqrt(N) * EPS
        np.testing.assert_allclose(found.mean, np.nanmean(x, 0), rtol=0, atol=sums * scale)
        variance = np.nanvar(x, 0)
        np.testing.assert_allclose(found.variance, variance, rtol=0, atol=sums * scale**2)
        np.testing.assert_array_equal(found.std, np.sqrt(found.variance))
        np.testing.assert_array_equal(found.min, np.nanmin(x, 0))
        np.testing.assert_array_equal(found.max, np.nanmax(x, 0))
        np.testing.assert_array_equal(found.argmin, np.nanargmin(x, 0))
        np.testing.assert_array_equal(found.argmax, np.nanargmax(x, 0))


def test_covariances_are_those_of_numpy(run):
    ok = run.ok
    for one, other in (("x", "x"), ("x", "energy"), ("r", "x"), ("r", "r")):
        found = run.statistics.covariance(one, other)
        a, b = (run[name][ok].reshape(ok.sum(), len(TS), -1) for name in (one, other))
        for s in range(1, len(TS)):
            expected = np.cov(a[:, s].T, b[:, s].T, ddof=0)[: a.shape[2], a.shape[2] :]
            np.testing.assert_allclose(np.reshape(found[s], expected.shape), expected, atol=1e-13)
    assert run.statistics.covariance("r", "x").shape == (4, 2)


def test_histograms_are_those_of_numpy(run):
    found, x = run.statistics["r"].histogram, run["r"]
    for s, c in np.ndindex(4, 2):
        values = x[np.isfinite(x[:, s, c]), s, c]
        np.testing.assert_array_equal(found.counts[s, c], np.histogram(values, EDGES)[0])
        assert found.below[s, c] == (values < EDGES[0]).sum()
        assert found.above[s, c] == (values > EDGES[-1]).sum()
    assert run.statistics["x"].histogram is None


def test_quantiles_are_close_in_rank(run):
    x = run["x"][run.ok]
    for p in (0.0, 0.01, 0.3, 0.5, 0.9, 1.0):
        found = run.statistics["x"].quantile(p)
        assert found.shape == (4,)
        for s in range(1, 4):
            assert abs(np.mean(x[:, s] <= found[s]) - p) <= 0.0044
    np.testing.assert_array_equal(run.statistics["x"].quantile(0.0)[1:], x[:, 1:].min(0))


def test_nothing_else_is_kept(run):
    alone = swept(NAMES, keep=())
    assert set(alone.values) == set()
    for name in NAMES:
        np.testing.assert_array_equal(alone.statistics[name].mean, run.statistics[name].mean)
        np.testing.assert_array_equal(alone.statistics[name].argmax, run.statistics[name].argmax)
    assert list(alone.statistics) == list(NAMES)
    assert alone.report.statuses == run.report.statuses


def test_statistics_of_a_store_do_not_depend_on_where_it_ended(run, tmp_path):
    """Blocks that were computed before are read."""
    path = tmp_path / "runs.zarr"
    swept(store=path)
    for block in (0, 2):
        (path / "checksum" / "c" / str(block) / "0").unlink()
    again = swept(NAMES, store=path)
    assert again.report.computed == N - 1024
    for name in NAMES:
        np.testing.assert_array_equal(again.statistics[name].mean, run.statistics[name].mean)
        np.testing.assert_array_equal(again.statistics[name].max, run.statistics[name].max)


def test_any_reduction(run, tmp_path):
    """The index of trajectories by energy, and a number; also of a store that is complete."""

    def add(value, rows):
        high = rows["energy"][:, 0] > 3.0
        assert len(rows["index"]) == len(rows["status"]) <= 1024
        return value[0] + list(rows["index"][high]), value[1] + int(rows["accepted"].sum())

    def merge(value, later):
        return value[0] + later[0], value[1] + later[1]

    reduction = jl.Reduction(lambda: ([], 0), add, merge)
    expected = np.flatnonzero(run["energy"][:, 0] > 3.0).tolist(), run.report.accepted
    assert swept(reduce=reduction).reduced == expected
    path = tmp_path / "runs.zarr"
    swept(store=path)
    complete = swept(store=path, reduce=reduction)
    assert complete.report.computed == 0
    assert complete.reduced == expected
    assert run.reduced is None


def test_moments_far_from_zero():
    """Of 10^8 with a deviation of 1, in blocks; one of them has no finite value."""
    rng = np.random.default_rng(0)
    blocks = [1e8 + rng.normal(size=(k, 2)) for k in (100, 1, 1000, 37)]
    blocks.insert(2, np.full((5, 2), np.nan))
    whole, merged, first = np.concatenate(blocks), None, 0
    for x in blocks:
        part = Moments.of(first, x)
        merged = part if merged is None else merged.merged(part)
        first += len(x)
    assert merged is not None
    np.testing.assert_allclose(merged.squares, 1138 * np.nanvar(whole, 0), rtol=1e-8)
    np.testing.assert_allclose(merged.mean, np.nanmean(whole, 0), rtol=4 * EPS)
    np.testing.assert_array_equal(merged.at_least, np.nanargmin(whole, 0))
    nothing = Moments.of(0, np.full((5, 2), np.nan)).merged(Moments.of(5, np.full((1, 2), np.inf)))
    np.testing.assert_array_equal(nothing.at_greatest, -1)
    large = jl.Statistics(("x",), covariance=True).of_block(0, {"x": np.full((5, 2), 1e200)})
    np.testing.assert_array_equal(large.merged(large)["x"].max, 1e200)
    np.testing.assert_array_equal(nothing.least, np.nan)


def test_failed_trajectories_have_no_statistics_after_their_end():
    found = swept(("x",), cases=lambda key, i: jl.Case([1.0, 0, 0], [0.0, 0, 0], {"k": 1e9}), n=3)
    assert (found.status == Status.max_steps).all()
    np.testing.assert_array_equal(found.statistics["x"].count, [3, 0, 0, 0])
    np.testing.assert_array_equal(found.statistics["x"].mean, [1.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(found.statistics["x"].variance, [0.0, np.nan, np.nan, np.nan])


@pytest.mark.parametrize(
    ("statistics", "message"),
    [
        (("y",), r"`statistics` must name some of .* but one was 'y'"),
        (("power push",), r"`statistics` must name some of .* but one was 'power push'"),
        ("x", "`names` must be a sequence of names"),
        ((), "`names` must name something"),
        ((1,), "`names` must be a sequence of names, but one was 1"),
        (("multipliers",), "`statistics` must name what the system has, but it has no 'multi"),
    ],
)
def test_bad_names_are_named(statistics, message):
    with pytest.raises(ValueError, match=message):
        swept(statistics)


def test_bad_requests_are_named(run):
    with pytest.raises(ValueError, match="`covariance` must be True or False, but it was 1"):
        jl.Statistics(("x",), covariance=1)
    with pytest.raises(ValueError, match=r"`histograms` must have keys among \['x'\], .* 'y'"):
        jl.Statistics(("x",), histograms={"y": [0.0, 1.0]})
    for edges in ([0.0], [0.0, 0.0], [[0.0, 1.0]]):
        with pytest.raises(ValueError, match=r"histograms\['x'\]` must be at least 2 increasing"):
            jl.Statistics(("x",), histograms={"x": edges})
    with pytest.raises(ValueError, match=r"`reduce` must be a jl.Reduction, but it was 3"):
        swept(reduce=3)
    with pytest.raises(ValueError, match="`add` must be a function, but it was 3"):
        jl.Reduction(list, 3, list)
    plain = swept(("x", "r"))
    with pytest.raises(ValueError, match=r"`covariance` is not supported: they were not asked for"):
        plain.statistics.covariance("x", "r")
    with pytest.raises(ValueError, match=r"`quantile` is not supported: they were not asked for"):
        plain.statistics["x"].quantile(0.5)
    for p in (2, "0.5", None, [0.1, 0.5], True, np.array([0.1, 0.5])):
        with pytest.raises(ValueError, match="`p` must be a number between 0 and 1, but it was"):
            run.statistics["x"].quantile(p)
    for histograms in (None, 5, [0.0, 1.0]):
        with pytest.raises(ValueError, match="`histograms` must be edges by name, but it was"):
            jl.Statistics(("x",), histograms=histograms)
    edges = np.array([0.0, 1.0])
    asked = jl.Statistics(("x",), histograms={"x": edges})
    edges[1] = -1.0
    np.testing.assert_array_equal(asked.histograms["x"], [0.0, 1.0])
    with pytest.raises(KeyError, match=r"must be one of \['x', 'r', 'energy', 'power drag'\]"):
        run.statistics["y"]


def test_statistics_of_a_store_are_of_what_it_keeps(tmp_path):
    message = r"`keep` must have the names of the statistics, \['x'\], but it was \('energy',\)"
    with pytest.raises(ValueError, match=message):
        swept(("x",), keep=("energy",), store=tmp_path / "runs.zarr")
