"""Stress rows: verdicts, names, exact orbits."""

import math

import numpy as np
import pytest

import jaxlag as jl
from bench import (
    _long_runs,
    _stress,
    stability,
)


def stressed(bound=1.0, statuses=(), figure=0.5, found=("ok",)):
    def run(quick):
        return _stress.Found(figure, found)

    return _stress.Case("row", "figure", bound, statuses, run)


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
def test_verdicts_on_stress(case, verdict):
    """A wrong answer that looks right is the worst; a status counts only where one is due."""
    row = stability.judged(case, quick=True)
    assert row["verdict"] == verdict
    targets, named = stability.conclusions([row], 1)
    assert [target.met for target in targets] == [
        verdict == "within",
        verdict != "silent",
        verdict != "failed",
    ]
    assert bool(named) == (verdict in ("silent", "failed"))


def test_a_stress_row_that_breaks_off_fails_alone():
    def run(quick):
        raise ValueError("q0 must be finite")

    row = stability.judged(_stress.Case("row", "figure", 1.0, (), run), quick=True)
    assert row["verdict"] == "failed"
    assert row["statuses"] == "raised ValueError: q0 must be finite"


def test_stress_rows_are_named_once_and_quick_ones_exist():
    names = [case.name for case in stability.CASES]
    assert len(set(names)) == len(names)
    assert set(names) >= stability.QUICK
    assert sum(not case.statuses for case in stability.CASES) >= stability.LEAST


@pytest.mark.full
def test_orbits_of_the_stress_rows_are_exact():
    """Kepler's solution against a tight solve, at two eccentricities."""
    q0, v0, e = _long_runs.kepler_starts(3)
    ts = np.linspace(0.0, 20.0, 5)
    exact = _long_runs.kepler(q0, v0, e, ts)
    for row in range(3):
        options = {"rtol": 1e-13, "atol": 1e-13}
        motion = jl.simulate(_long_runs.ORBIT, q0[row], v0[row], ts, {}, **options)
        np.testing.assert_allclose(motion.q, exact[row], rtol=0, atol=1e-10)
