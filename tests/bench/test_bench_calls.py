"""The benchmark of fixed costs: the intercept over steps, and what it is compared with."""

import math

import pytest

from bench import calls

STEPS = [2, 10, 40]
FACTS = {"steps": STEPS, "trace_s": 1.0, "compile_s": 2.0}


def samples(form, name, fixed, slope, trivial):
    """Seconds of runs of which the shortest are on a line."""
    lengths = zip(calls.LENGTHS, STEPS, strict=True)
    found = {(form, f"{name} {x}"): [1e-6 * (fixed + slope * n), 1.0] for x, n in lengths}
    return found | {(form, f"{name} {calls.TRIVIAL}"): [1e-6 * trivial, 1.0]}


def test_fixed_costs_are_intercepts_beyond_a_trivial_program():
    rows = []
    for name in calls.NAMES:
        for form, fixed in (("one function", 25.0), ("tasks", 50.0)):
            rows.append(calls._row(form, name, FACTS, samples(form, name, fixed, 0.5, 22.0)))
    for row in rows:
        fixed = 25.0 if row["form"] == "one function" else 50.0
        expected = {"fixed_us": fixed, "step_us": 0.5, "beyond_us": fixed - 22.0}
        for column, value in expected.items():
            assert math.isclose(row[column], value, rel_tol=1e-9)
        assert math.isclose(row["min_us"], fixed + 1.0, rel_tol=1e-9)
    targets, references = calls._judged(rows)
    assert [target.met for target in targets] == [False, True, True]
    assert [reference.figure for reference in references] == ["0.5"] * len(calls.NAMES)


@pytest.mark.full
def test_a_quick_run_measures_both_forms():
    report = calls.run(quick=True)
    assert [row["form"] for row in report.rows] == list(calls.FORMS)
    for row in report.rows:
        assert row["steps"] > 0
        assert row["min_us"] > row["trivial_us"] > 0
