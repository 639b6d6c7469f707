"""Stress cases: verdicts, names, exact orbits."""

import math

import numpy as np
import pytest

import jaxlag as jl
from bench import stability
from bench.stability import _cases, _drifts, _long_runs, _reference_motions


def stressed(bound=1.0, statuses=(), figure=0.5, found=("ok",)):
    def run(quick):
        return _cases.Found(figure, found)

    return _cases.Case("row", "figure", bound, statuses, run)


@pytest.mark.parametrize(
    ("case", "verdict"),
    [
        (stressed(), "within"),
        (stressed(figure=1.5), "silent"),
        (stressed(figure=math.nan), "silent"),
        (stressed(figure=math.inf, statuses=("mass_singular",)), "silent"),
        (stressed(figure=math.nan, found=("ok", "nonfinite")), "failed"),
        (stressed(statuses=("mass_singular",), found=("mass_singular",)), "named"),
        (stressed(statuses=("mass_singular",), found=("nonfinite",)), "failed"),
    ],
)
def test_verdicts_follow_from_figures_and_statuses(case, verdict):
    """The worst is a wrong answer that looks right; a status counts only where one is expected."""
    row = stability.judged(case, quick=True)
    assert row["verdict"] == verdict
    targets, named = stability.conclusions([row], 1)
    assert [target.met for target in targets] == [
        verdict == "within",
        verdict != "silent",
        verdict != "failed",
    ]
    assert bool(named) == (verdict in ("silent", "failed"))


def test_stress_case_that_raises_an_error_fails_alone():
    def run(quick):
        raise ValueError("`q0` must be finite")

    row = stability.judged(_cases.Case("row", "figure", 1.0, (), run), quick=True)
    assert row["verdict"] == "failed"
    assert row["statuses"] == "raised ValueError: `q0` must be finite"


def test_stress_cases_have_unique_names_and_quick_ones_exist():
    names = [case.name for case in stability.CASES]
    assert len(set(names)) == len(names)
    assert set(names) >= stability.QUICK
    assert sum(not case.statuses for case in stability.CASES) >= stability.LEAST


def test_a_quick_run_is_judged_by_its_own_bound():
    case = stressed(figure=1.5)._replace(quick_bound=2.0)
    assert stability.judged(case, quick=True)["verdict"] == "within"
    assert stability.judged(case, quick=False)["verdict"] == "silent"


def oscillating(drift, noise):
    """Two incommensurate oscillations of 1e12, in 20 motions of 200 000 steps, a save every 20."""
    steps = np.arange(1, 10_001) * 20
    random = np.random.default_rng(0)
    phases = random.uniform(0, 2 * np.pi, (2, 20, 1))
    a, b = np.cos(0.1 * steps + phases[0]), np.cos(0.1 * np.sqrt(2) * steps + phases[1])
    walk = noise * np.sqrt(20) * np.cumsum(random.normal(size=(20, len(steps))), axis=1)
    return (1e12 * (a + b + a * b) + drift * steps + walk) * _drifts.EPS


@pytest.mark.parametrize("drift", [0.0, 0.03, -0.03])
def test_drift_is_detected_below_oscillations_and_walks(drift):
    """Without one the figure is within that of a random walk of its size, with one it is beyond."""
    length = _drifts.Length(200_000, 5_000, 20)
    found = _drifts.drift(oscillating(drift, 1.0), 20, ("ok",))
    bound = _drifts.walked(3, length)  # of a random walk of 1.04 eps per step
    assert (found.figure <= bound) == (drift == 0.0)
    mean = float(found.details.split()[1])
    assert abs(mean - drift) < 4e-3


def test_undetermined_drift_is_beyond_its_bound():
    """A wide error bar fails the case as a drift does."""
    found = _drifts.drift(oscillating(0.0, 30.0), 20, ("ok",))
    assert found.figure > _drifts.walked(3, _drifts.Length(200_000, 5_000, 20))


def test_derivative_by_the_imaginary_part_equals_that_of_the_motion():
    """Of motions written by hand, compared with a difference."""
    direction = np.array([0.3, -1.0])
    ends = [
        _reference_motions.double_pendulum([1.0, 0.5] + h * direction, 1.0, 2.0)[0]
        for h in (1e-4, -1e-4)
    ]
    slope = _reference_motions.double_pendulum(np.array([1.0, 0.5]), 1.0, 2.0, direction)[1]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-4, rtol=0, atol=1e-6)


@pytest.mark.full
def test_orbits_of_the_stress_cases_are_exact():
    """Kepler's solution against a tight solve, at two eccentricities."""
    q0, v0, e = _long_runs.kepler_starts(3)
    ts = np.linspace(0.0, 20.0, 5)
    exact = _long_runs.kepler(q0, v0, e, ts)
    for i in range(3):
        options = {"rtol": 1e-13, "atol": 1e-13}
        motion = jl.simulate(_long_runs.ORBIT, q0[i], v0[i], ts, {}, **options)
        np.testing.assert_allclose(motion.q, exact[i], rtol=0, atol=1e-10)
