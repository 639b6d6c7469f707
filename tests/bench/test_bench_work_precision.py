"""Work over error: the fastest lines are reported and judged correctly, and a run is measured."""

import json
import math

import numpy as np
import pytest

from bench import __main__ as command
from bench import work_precision
from bench._harness import results
from bench.work_precision import _plot, _ranking

COLUMNS = {"system", "line", "knob", "value", "error", "steps"} | {
    "min_us",
    "median_us",
    "repeats",
    "compile_s",
}


def rows_of(system, line, *pairs, steps=100):
    return [
        {"system": system, "line": line, "error": error, "min_us": us, "steps": steps}
        for error, us in pairs
    ]


def made_up_rows(ours=1.0):
    across = (1e-4, 1e-13)
    flat = lambda us: [(error, us) for error in across]  # noqa: E731
    rows = []
    for system in (_ranking.REGULAR, "Kepler, e = 0.6"):
        rows += rows_of(system, "jaxlag dopri8", *flat(100.0 * ours))
        rows += rows_of(system, "jaxlag dopri8, jax 0.12.0", *flat(1.0))
        rows += rows_of(system, "heyoka", *flat(80.0))
        rows += rows_of(system, "numba DOP853", (1e-4, 60.0), (1e-8, 120.0))
        rows += rows_of(system, "diffrax Tsit5, by hand", *flat(400.0))
        rows += rows_of(system, "diffrax Tsit5, naive, no setting", *flat(3000.0))
    return rows


# ---- Reports of the rows -------------------------------------------------------------------------


def test_fastest_lines_at_equal_error_are_reported():
    table = _ranking.fastest(made_up_rows())
    at = {(row["system"], row["error"]): row for row in table}
    regular = at[_ranking.REGULAR, "1e-06"]
    assert (regular["jaxlag_us"], regular["peer_us"]) == (100.0, 80.0)
    assert (regular["peer"], regular["naive_us"]) == ("heyoka", 3000.0)
    figures = {
        reference.what: reference.figure
        for reference in _ranking.fastest_references(made_up_rows())
    }
    text = f"{_ranking.REGULAR}: fastest at 1e-09; jaxlag dopri8 100 us"
    assert figures[text] == "jaxlag dopri8, jax 0.12.0 1 us"


TIMES = "times as long: jaxlag "
SYSTEMS = (_ranking.REGULAR, "Kepler, e = 0.6")


def test_targets_are_judged_and_misses_are_explained():
    targets, profiles = _ranking.judged(made_up_rows(), SYSTEMS)
    found = {target.claim: (round(target.figure, 6), target.met) for target in targets}
    best = "times as long: jaxlag as the best of heyoka and numba, double pendulum, regular"
    assert found[f"{best} at 1e-06"] == (1.25, False)
    assert found[f"{best} at 1e-12"] == (1.25, True)
    hand = "times as long: jaxlag as diffrax by hand with the setting, double pendulum, regular"
    assert found[f"{hand} at 1e-09"] == (0.25, True)
    assert found["times as long: jaxlag as heyoka, Kepler, e = 0.6 at 1e-09"] == (1.25, True)
    gain = "times faster: jaxlag than naive autodiff with diffrax as found, worst "
    assert found[f"{gain}(double pendulum, regular at 1e-06)"] == (30.0, True)
    slowest = "times as long: jaxlag as the best peer at 1e-09, worst (double pendulum, regular)"
    assert found[slowest] == (1.25, True)
    missed = {reference.what: reference.figure for reference in profiles}
    assert missed[f"missed: {best.removeprefix(TIMES)} at 1e-06"] == (
        "jaxlag dopri8 100 us in 100 steps of 1 us (about 0 us however few, and 1 us each)"
        " against heyoka 80 us in 100 steps of 0.8 us"
    )
    slow = _ranking.judged(made_up_rows(ours=3.0), SYSTEMS)[1]
    assert any(reference.what.startswith("3.75 times the best peer") for reference in slow)
    assert not any("times diffrax by hand" in reference.what for reference in slow)
    slower = {reference.what for reference in _ranking.judged(made_up_rows(ours=5.0), SYSTEMS)[1]}
    text = "1.25 times diffrax by hand with the setting: Kepler, e = 0.6 at 1e-09"
    assert text in slower


@pytest.mark.parametrize(("fixed", "expected"), [(70.0, (70.0, 0.6)), (0.0, (0.0, 0.6))])
def test_time_besides_the_steps_is_fitted(fixed, expected):
    points = [{"steps": n, "min_us": fixed + 0.6 * n} for n in (50, 90, 200, 400)]
    assert np.allclose(_ranking.fixed_and_each(points), expected, atol=1e-9)


def test_the_time_besides_the_steps_is_not_negative():
    points = [{"steps": n, "min_us": 0.01 * n**2} for n in (50, 100, 200)]
    fixed, each = _ranking.fixed_and_each(points)
    assert fixed == 0.0
    assert each > 0.0


def test_a_system_that_failed_misses_its_targets():
    targets, _ = _ranking.judged(made_up_rows(), [*SYSTEMS, _ranking.LANES])
    lost = [target for target in targets if _ranking.LANES in target.claim]
    assert len(lost) == 4  # two of its own, and twice it is the worst of all
    assert not any(target.met for target in lost)


def test_unreached_errors_miss_targets_and_unmatched_ones_meet_them():
    rows = rows_of("a", "jaxlag x", (1e-3, 1.0), (1e-7, 2.0)) + rows_of(
        "a", "heyoka", (1e-3, 1.0), (1e-10, 2.0)
    )
    assert math.isnan(_ranking.ratio(rows, "a", 1e-9, _ranking.is_peer))
    claim = _ranking.overall(rows, ["a"])[-1]
    assert math.isnan(claim.figure)
    assert not claim.met
    swapped = [
        {**row, "line": {"jaxlag x": "heyoka", "heyoka": "jaxlag x"}[row["line"]]} for row in rows
    ]
    assert _ranking.ratio(swapped, "a", 1e-9, _ranking.is_peer) == 0.0


def test_a_target_without_the_peer_is_not_met():
    rows = [row for row in made_up_rows() if not row["line"].startswith(("heyoka", "numba"))]
    targets, _ = _ranking.judged(rows, SYSTEMS)
    against = [target for target in targets if "heyoka" in target.claim]
    assert against
    assert not any(target.met for target in against)


def test_worst_is_the_largest_or_an_unknown():
    assert _ranking.worst({"a": 1.0, "b": 3.0}, smallest=False) == ("b", 3.0)
    assert _ranking.worst({"a": 1.0, "b": 3.0}, smallest=True) == ("a", 1.0)
    assert _ranking.worst({"a": 1.0, "b": math.nan}, smallest=True)[0] == "b"


# ---- Diagrams and the command --------------------------------------------------------------------


def test_diagrams_group_lines_and_highlight_the_fastest_of_jaxlag(tmp_path):
    pytest.importorskip("matplotlib")
    rows = made_up_rows()
    regular = [row for row in rows if row["system"] == _ranking.REGULAR]
    found = _plot.curves(regular)
    assert set(found) == {
        *("jaxlag dopri8", "jaxlag dopri8, jax 0.12.0", "heyoka", "numba"),
        *("diffrax by hand", "diffrax naive, no setting"),
    }
    assert _plot.leaders(found) == {"jaxlag dopri8"}
    errors, us = found["numba"]
    assert errors.min() >= 1e-8
    assert np.all(np.diff(us) > 0)
    name = _plot.save(_ranking.REGULAR, regular, tmp_path / "new")
    assert name == "work-precision-double-pendulum-regular.png"
    path = tmp_path / "new" / name
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size < 100_000


def test_options_of_another_benchmark_are_refused(capsys):
    assert command.main(["solve", "--system", "heavy top"]) == 2
    assert "solve has no option --system" in capsys.readouterr().err


def test_failed_process_is_named_and_the_others_continue(tmp_path, monkeypatch):
    def contest(name, quick, python):
        if name == "heavy top":
            raise RuntimeError("a worker ended early with status -11")
        return [row | {"system": name} for row in made_up_rows()[:2]], []

    monkeypatch.setattr(results, "FOLDER", tmp_path)
    monkeypatch.setattr(work_precision, "contest", contest)
    report = work_precision.run(False, system=["heavy top", "rolling disk"])
    assert ("failed", "heavy top: a worker ended early with status -11") in report.references
    assert {row["system"] for row in report.rows} == {"rolling disk"}
    assert any("heavy top" in target.claim and not target.met for target in report.targets)


def test_results_have_a_line_for_every_row():
    rows = [{"a": 1.5, "b": "row 0"}, {"a": None, "b": "x"}]
    content = {"benchmark": "b", "runs": [{"rows": rows[:1]}, {"rows": rows}]}
    text = results._compact(content)
    assert json.loads(text) == content
    assert sum('"b": "' in line for line in text.splitlines()) == 3


def test_an_unknown_system_is_refused():
    with pytest.raises(ValueError, match=r"--system must be one of .*but it was 'hevy top'"):
        work_precision.run(True, system=["hevy top"])


class FakeWorker:
    """A process with one fast and one slow point."""

    def __init__(self, benchmark, quick, settings, **options):
        self.kind = settings[work_precision.KIND]
        line = {"on": "jaxlag dopri8", "off": "diffrax Tsit5, naive"}.get(self.kind, "heyoka")
        known = {"knob": "tolerance", "compile_s": 1.0, "steps": 5}
        self.asked = []
        self.facts = {
            "missing": {},
            "none": {},
            "versions": {"heyoka": "7.0"} if self.kind == "peers" else {},
            "jax": "0.12.0",
            "points": {
                line: [
                    {"case": "fast", "value": 1e-3, "error": 1e-5, "swept_s": [1e-3, 1e-3]} | known,
                    {"case": "slow", "value": 1e-9, "error": 1e-9, "swept_s": [0.4, 0.3]} | known,
                ]
            },
        }

    def seconds(self, cases):
        assert set(cases) <= {"fast"}
        return {case: [30e-3, 10e-3] for case in cases}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def test_processes_alternate_and_long_runs_are_skipped(monkeypatch):
    monkeypatch.setattr(work_precision, "Worker", FakeWorker)
    rows, notes = work_precision.contest("heavy top", False, "another/python")
    assert {row["line"] for row in rows} == {
        *("jaxlag dopri8", "diffrax Tsit5, naive, no setting", "heyoka, jax 0.12.0", "heyoka"),
    }
    assert all(set(row) == COLUMNS for row in rows)
    fast, slow = rows[:2]
    assert fast["repeats"] == 6  # three rounds, then its time is up
    assert math.isclose(fast["min_us"], 10e3)
    assert (slow["repeats"], slow["min_us"]) == (2, 0.3e6)
    assert notes == [("7.0", "version of heyoka")]
    without, _ = work_precision.contest("heavy top", False, None)
    assert not any(", jax " in row["line"] for row in without)


class AbsentWorker(FakeWorker):
    """A worker whose other interpreter has no jax."""

    def __init__(self, benchmark, quick, settings, **options):
        if "interpreter" in options:
            raise RuntimeError("a worker ended early with status 1")
        super().__init__(benchmark, quick, settings, **options)


def test_failing_interpreter_is_named(monkeypatch):
    monkeypatch.setattr(work_precision, "Worker", AbsentWorker)
    rows, notes = work_precision.contest("heavy top", False, "another/python")
    assert len(rows) == 6
    text = "another jax: another/python: a worker ended early with status 1"
    assert ("left out", text) in notes


@pytest.mark.full
def test_quick_run_is_measured_and_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(results, "FOLDER", tmp_path)
    command.main(["work-precision", "--quick"])
    assert "times as long: jaxlag as the best peer" in capsys.readouterr().out
    (run,) = json.loads((tmp_path / "quick" / "work-precision.json").read_text())["runs"]
    assert {"jaxlag dopri8", "diffrax Dopri8, by hand"} <= {row["line"] for row in run["rows"]}
    assert all(set(row) == COLUMNS for row in run["rows"])
