"""Work over error: the motions are the systems', times are of finished work, the table is right."""

import json
import math
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

from bench import __main__ as command
from bench import (
    _contest,
    _contest_plot,
    _exact_ends,
    _harness,
    _jax_lines,
    _peers,
    _results,
    _straight_line,
    _sweep,
    work_precision,
)
from bench._motions import MOTIONS
from bench._sweep import Line, Solved, swept, time_at

EPS = np.finfo(float).eps
motion_of = cache(lambda name: MOTIONS[name]())
SINGLE = [name for name in MOTIONS if name != "16 double pendulums"]
COLUMNS = {"system", "line", "knob", "value", "error", "steps"} | {
    "min_us",
    "median_us",
    "repeats",
    "compile_s",
}


def state_near_the_start(motion, seed):
    """A consistent y away from the start."""
    rng = np.random.default_rng(seed)
    y = motion.start()
    if motion.rates.__name__ != "cartesian_pendulum":
        return y + rng.uniform(-0.2, 0.2, y.size) * np.maximum(0.5, np.abs(y)) ** 0.5
    angles, rates = jnp.asarray(rng.uniform(-2, 2, 2)), jnp.asarray(rng.uniform(-2, 2, 2))

    def bobs(q):
        ends = jnp.cumsum(jnp.stack([jnp.sin(q), -jnp.cos(q)], 1), 0)
        return ends.ravel()

    return np.concatenate(jax.jvp(bobs, (angles,), (rates,)))


def acceleration(motion, y):
    """(q, v, a): velocities by the explicit kinematics, accelerations by jaxlag."""
    n = len(motion.q0)
    q, v = jnp.asarray(y[:n]), jnp.asarray(motion.evaluate(y)[:n])
    return q, v, jnp.asarray(motion.system.acceleration(motion.params, q, v))


@pytest.mark.parametrize("name", mostly_full(SINGLE, "heavy top"))
def test_explicit_equations_are_those_of_the_system(name):
    """And so are all forms they are given to solvers in."""
    motion = motion_of(name)
    y = state_near_the_start(motion, 1)
    n = len(motion.q0)
    q, v, a = acceleration(motion, y)
    if motion.speeds is None:
        speeds, rates = v, a
    else:
        along = lambda q, v: motion.speeds(0.0, q, v, motion.params)  # noqa: E731
        speeds, rates = jax.jvp(along, (q, v), (v, a))
    assert np.allclose(speeds, y[n:], rtol=1e-13, atol=1e-13)
    # Rounding of the terms that cancel: k r of the spring, M of the chain (condition about 1e3).
    cancelling = motion.params.get("k", 1e2 if n == 8 else 1.0)
    bound = 300 * EPS * max(float(jnp.max(jnp.abs(rates))), cancelling)
    expected = np.array(motion.evaluate(y))
    assert np.max(np.abs(expected[n:] - rates)) < bound

    out = [0.0] * len(y)
    assert np.max(np.abs(np.array(_peers.plain(motion)(0.0, y.tolist(), out)) - expected)) < bound
    params = {key: jnp.asarray(value) for key, value in motion.params.items()}
    by_hand = jax.jit(_jax_lines.by_hand(motion))(0.0, jnp.asarray(y), params)
    assert np.max(np.abs(by_hand - expected)) < bound
    naive = jax.jit(_jax_lines.naive(motion))(0.0, jnp.concatenate([q, v]), params)
    assert (
        np.max(np.abs(naive - jnp.concatenate([v, a]))) < 10 * bound
    )  # its solve knows no structure


def test_no_operation_is_written_twice():
    motion = MOTIONS["heavy top"]()
    lines = _straight_line.source(motion.rates, motion.params, 6).splitlines()
    right = [line.split(" = ")[1] for line in lines if " = x" in line or " = (" in line]
    operations = [text for text in right if len(text.split()) == 3]
    assert operations
    assert len(set(operations)) == len(operations)


def test_ends_are_kept_for_every_motion_to_20_digits():
    ends = json.loads(_exact_ends.PATH.read_text())["ends"]
    assert list(ends) == list(MOTIONS)
    for name, make in MOTIONS.items():
        motion = make()
        assert _exact_ends.exact_end(name).shape == motion.q0.shape
        words = np.ravel(ends[name])
        assert all(len(word.lstrip("-0.").split("E")[0].replace(".", "")) >= 17 for word in words)


@pytest.mark.parametrize(("name", "e"), [("Kepler, e = 0.6", 0.6), ("Kepler, e = 0.9", 0.9)])
def test_orbits_close(name, e):
    """After 100 periods: where they began, but for the rounding of the span and of the start."""
    motion = motion_of(name)
    off = np.abs(_exact_ends.exact_end(name) - motion.q0)
    # Starts to one rounding: the period is off by as much, times its growth with 1 / (1 - e).
    late = motion.t1 * EPS * 4.0 / (1.0 - e)
    assert off[0] < EPS
    assert off[1] < motion.v0[1] * late


@pytest.mark.full
@pytest.mark.parametrize("name", ["rigid aircraft", "rolling disk", "16 double pendulums"])
def test_ends_are_those_of_a_tight_solve(name):
    motion = motion_of(name)
    line = _jax_lines.with_jaxlag(motion, "dopri8")
    solved = line.read(line.make(1e-13)())
    assert motion.error(solved.q, _exact_ends.exact_end(name)) < 1e-9


# ---- Sweeps and times ----------------------------------------------------------------------------


class Result:
    """An answer that is there only after it has been waited for."""

    def __init__(self, q):
        self.q, self.waited = q, False

    def block_until_ready(self):
        self.waited = True
        return self


def made_up_line(errors, results=None):
    """One that ends off by what is given, knob by knob."""

    def make(knob):
        def call():
            result = Result(errors[knob])
            if results is not None:
                results.append(result)
            return result

        return call

    def read(result):
        assert result.waited, "read before it was finished"
        return Solved(result.q, 7)

    return Line("tolerance", list(errors), make, read, build_s=2.0)


def test_sweeps_wait_for_every_result():
    results = []
    line = made_up_line({1e-2: 1e-3, 1e-3: 1e-4}, results)
    calls, points = swept(line, float, patience_s=10.0)
    assert len(results) == 4  # one to warm up and one to time, for each
    assert all(result.waited for result in results)
    assert list(calls) == ["0.01", "0.001"]
    assert [point["error"] for point in points] == [1e-3, 1e-4]
    assert all(point["compile_s"] >= 2.0 and len(point["swept_s"]) == 2 for point in points)


def test_a_deliberately_long_computation_shows_its_full_time(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(_sweep, "perf_counter", lambda: now[0])
    monkeypatch.setattr(_harness, "perf_counter", lambda: now[0])

    class Long(Result):
        def block_until_ready(self):
            now[0] += 5.0
            return super().block_until_ready()

    line = made_up_line({1e-2: 1e-3})._replace(make=lambda knob: lambda: Long(1e-3))
    _, points = swept(line, float, patience_s=10.0)
    assert points[0]["swept_s"] == [5.0, 5.0]


def test_sweeps_end_where_rounding_takes_over_and_where_patience_does():
    errors = {10.0**-k: max(10.0**-k, 1e-9) for k in range(2, 16)}
    _, points = swept(made_up_line(errors), float, patience_s=10.0)
    assert len(points) == 8 + _sweep.PATIENCE
    plateau = {10.0**-k: 1e-6 if k < 10 else 1e-14 for k in range(2, 16)}
    _, points = swept(made_up_line(plateau), float, patience_s=10.0)
    assert points[-1]["error"] == 1e-14  # stability, not rounding, held the error up
    _, points = swept(made_up_line(errors), float, patience_s=-1.0)
    assert points == []  # its first run was longer than any patience


def test_failed_runs_are_no_points():
    errors = {1e-1: math.nan, 1e-2: 2.0 * _sweep.WRONG, 1e-3: 1e-4}
    calls, points = swept(made_up_line(errors), float, patience_s=10.0)
    assert (len(calls), len(points)) == (1, 1)


def points(*pairs):
    return [{"error": error, "min_us": us} for error, us in pairs]


def test_times_at_equal_error_are_interpolated_and_never_beyond_the_line():
    line = points((1e-4, 10.0), (1e-6, 40.0), (1e-8, 160.0))
    assert math.isclose(time_at(line, 1e-5, "min_us"), 20.0)
    assert math.isclose(time_at(line, 1e-6, "min_us"), 40.0)
    assert math.isclose(time_at(line, 1e-7, "min_us"), 80.0)
    assert time_at(line, 1e-9, "min_us") is None
    assert time_at(line, 1e-2, "min_us") == 10.0  # its loosest suffices
    assert time_at([], 1e-2, "min_us") is None


def test_the_cheapest_way_to_an_error_counts():
    line = points((1e-4, 10.0), (1e-7, 20.0), (1e-5, 30.0), (1e-9, 90.0))
    assert 10.0 < time_at(line, 1e-6, "min_us") < 20.0


def test_tolerances_and_steps_go_from_loose_to_tight():
    found = _sweep.tolerances(2.5, 14.0)
    assert len(found) == 24
    assert math.isclose(found[0], 10**-2.5)
    assert math.isclose(found[-1], 1e-14)
    assert np.all(np.diff(found) < 0)
    lengths = np.array(_sweep.steps(10.0, 32, 1000))
    assert lengths[0] == 10.0 / 32
    assert np.all(np.diff(lengths) < 0)
    assert np.allclose(10.0 / lengths, np.round(10.0 / lengths), rtol=1e-14)


# ---- Lines ---------------------------------------------------------------------------------------


def test_every_solver_of_ours_has_a_line():
    from jaxlag._methods import METHODS
    from jaxlag.solvers import AbstractFixedStep

    single = _jax_lines.methods(MOTIONS["double pendulum, regular"]())
    ours = {name for name, make in METHODS.items() if type(make()).__module__.startswith("jaxlag")}
    assert ours <= set(single)
    assert {"tsit5", "dopri8"} <= set(single)
    assert "kvaerno5" in _jax_lines.methods(MOTIONS["elastic pendulum, k = 1e6"]())
    lanes = _jax_lines.methods(MOTIONS["16 double pendulums"]())
    assert "dopri8" in lanes
    assert not any(isinstance(METHODS[name](), AbstractFixedStep) for name in lanes)


@pytest.mark.parametrize("lanes", mostly_full([False, True], False))
def test_lines_in_jax_get_to_the_end(lanes):
    motion = MOTIONS["16 double pendulums" if lanes else "double pendulum, regular"]()
    if lanes:
        motion = motion._replace(q0=motion.q0[:2], v0=motion.v0[:2])
    motion = motion._replace(t1=0.5)
    ends = []
    for line in (
        _jax_lines.with_jaxlag(motion, "tsit5"),
        _jax_lines.with_diffrax(
            motion, _jax_lines.by_hand(motion), "Tsit5", jnp.asarray(motion.start())
        ),
    ):
        solved = line.read(line.make(1e-10)())
        assert solved.steps > 3
        ends.append(np.asarray(solved.q))
    assert ends[0].shape == motion.q0.shape
    assert np.max(np.abs(ends[0] - ends[1])) < 1e-8


def test_a_library_that_cannot_be_imported_is_named_with_its_error(monkeypatch):
    monkeypatch.setattr(_peers, "MODULES", {"heyoka": "no_such_module", "scipy": "scipy"})
    missing = _peers.missing()
    assert missing == {"heyoka": "ModuleNotFoundError: No module named 'no_such_module'"}
    monkeypatch.setattr(work_precision, "_silence", lambda: None)
    lines, found = work_precision._lines(MOTIONS["heavy top"](), "peers")
    assert found == missing
    assert "heyoka" not in lines
    assert "scipy DOP853" in lines
    facts = {"missing": missing, "none": {"jaxlag x": "ValueError: no"}, "jax": "0.12"}
    facts["versions"] = {}
    notes = work_precision._notes("Kepler, e = 0.6", "newest", facts)
    assert notes[0] == ("left out", "heyoka: " + missing["heyoka"])
    assert notes[1] == ("no line", "Kepler, e = 0.6, jaxlag x, jax 0.12: ValueError: no")


def test_scipy_reaches_the_end_kept_here():
    pytest.importorskip("scipy")
    motion = MOTIONS["Cartesian double pendulum"]()
    line = _peers.lines(motion)["scipy DOP853"][1](motion)
    solved = line.read(line.make(1e-10)())
    # The global error of a motion of 10 s at this tolerance, about 30 times as large.
    assert motion.error(solved.q, _exact_ends.exact_end("Cartesian double pendulum")) < 1e-8


@pytest.mark.full
@pytest.mark.parametrize("name", ["heavy top", "chain of 8 links"])
def test_every_library_gets_to_the_end_kept_here(name):
    motion = motion_of(name)
    missing = _peers.missing()
    for words, (library, make) in _peers.lines(motion).items():
        if library in missing:
            continue
        line = make(motion)
        error = math.inf
        for knob in line.knobs[::4]:
            error = min(error, motion.error(line.read(line.make(knob)()).q, exact(name)))
            if error < 1e-5:
                break
        assert error < 1e-5, words


def exact(name):
    return _exact_ends.exact_end(name)


@pytest.mark.full
def test_dop853_in_numba_takes_the_steps_of_scipy():
    pytest.importorskip("numba")
    integrate = pytest.importorskip("scipy.integrate")
    from bench import _numba_dop853

    motion = MOTIONS["double pendulum, regular"]()
    y, accepted, attempts = _numba_dop853.build(motion).run(motion.start(), 10.0, 1e-8, 1e-8)
    rates = lambda t, y: motion.evaluate(y)  # noqa: E731
    other = integrate.solve_ivp(rates, (0, 10), motion.start(), "DOP853", rtol=1e-8, atol=1e-8)
    assert abs(accepted - (len(other.t) - 1)) <= 2
    assert attempts > accepted
    # Steps that differ by a rounding of the controller end within the error of either.
    assert np.max(np.abs(y - other.y[:, -1])) < 1e-7


# ---- What is said of the rows --------------------------------------------------------------------


def rows_of(system, line, *pairs, steps=100):
    return [
        {"system": system, "line": line, "error": error, "min_us": us, "steps": steps}
        for error, us in pairs
    ]


def made_up_rows(ours=1.0):
    across = (1e-4, 1e-13)
    flat = lambda us: [(error, us) for error in across]  # noqa: E731
    rows = []
    for system in (_contest.REGULAR, "Kepler, e = 0.6"):
        rows += rows_of(system, "jaxlag dopri8", *flat(100.0 * ours))
        rows += rows_of(system, "jaxlag dopri8, jax 0.12.0", *flat(1.0))
        rows += rows_of(system, "heyoka", *flat(80.0))
        rows += rows_of(system, "numba DOP853", (1e-4, 60.0), (1e-8, 120.0))
        rows += rows_of(system, "diffrax Tsit5, by hand", *flat(400.0))
        rows += rows_of(system, "diffrax Tsit5, naive, no setting", *flat(3000.0))
    return rows


def test_the_fastest_are_told_at_equal_error():
    table = _contest.fastest(made_up_rows())
    at = {(row["system"], row["error"]): row for row in table}
    regular = at[_contest.REGULAR, "1e-06"]
    assert (regular["jaxlag_us"], regular["peer_us"]) == (100.0, 80.0)
    assert (regular["peer"], regular["naive_us"]) == ("heyoka", 3000.0)
    told = {reference.what: reference.figure for reference in _contest.told(made_up_rows())}
    words = f"{_contest.REGULAR}: fastest at 1e-09; jaxlag dopri8 100 us"
    assert told[words] == "jaxlag dopri8, jax 0.12.0 1 us"


TIMES = "times as long: jaxlag "
SYSTEMS = (_contest.REGULAR, "Kepler, e = 0.6")


def test_targets_are_judged_and_what_misses_is_explained():
    targets, profiles = _contest.judged(made_up_rows(), SYSTEMS)
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
    slow = _contest.judged(made_up_rows(ours=3.0), SYSTEMS)[1]
    assert any(reference.what.startswith("3.75 times the best peer") for reference in slow)


@pytest.mark.parametrize(("fixed", "expected"), [(70.0, (70.0, 0.6)), (0.0, (0.0, 0.6))])
def test_the_time_besides_the_steps_is_told(fixed, expected):
    points = [{"steps": n, "min_us": fixed + 0.6 * n} for n in (50, 90, 200, 400)]
    assert np.allclose(_contest.fixed_and_each(points), expected, atol=1e-9)


def test_the_time_besides_the_steps_is_not_negative():
    points = [{"steps": n, "min_us": 0.01 * n**2} for n in (50, 100, 200)]
    fixed, each = _contest.fixed_and_each(points)
    assert fixed == 0.0
    assert each > 0.0


def test_a_system_that_failed_misses_its_targets():
    targets, _ = _contest.judged(made_up_rows(), [*SYSTEMS, _contest.LANES])
    lost = [target for target in targets if _contest.LANES in target.claim]
    assert len(lost) == 4  # two of its own, and it is the worst of all twice
    assert not any(target.met for target in lost)


def test_an_error_we_never_reach_is_missed_and_one_only_we_reach_is_met():
    rows = rows_of("a", "jaxlag x", (1e-3, 1.0), (1e-7, 2.0)) + rows_of(
        "a", "heyoka", (1e-3, 1.0), (1e-10, 2.0)
    )
    assert math.isnan(_contest.ratio(rows, "a", 1e-9, _contest.is_peer))
    claim = _contest.overall(rows, ["a"])[-1]
    assert math.isnan(claim.figure)
    assert not claim.met
    swapped = [
        {**row, "line": {"jaxlag x": "heyoka", "heyoka": "jaxlag x"}[row["line"]]} for row in rows
    ]
    assert _contest.ratio(swapped, "a", 1e-9, _contest.is_peer) == 0.0


def test_a_target_without_the_peer_is_not_met():
    rows = [row for row in made_up_rows() if not row["line"].startswith(("heyoka", "numba"))]
    targets, _ = _contest.judged(rows, SYSTEMS)
    against = [target for target in targets if "heyoka" in target.claim]
    assert against
    assert not any(target.met for target in against)


def test_the_worst_is_the_largest_or_what_is_unknown():
    assert _contest.worst({"a": 1.0, "b": 3.0}, smallest=False) == ("b", 3.0)
    assert _contest.worst({"a": 1.0, "b": 3.0}, smallest=True) == ("a", 1.0)
    assert _contest.worst({"a": 1.0, "b": math.nan}, smallest=True)[0] == "b"


# ---- Diagrams and the command --------------------------------------------------------------------


def test_diagrams_group_lines_and_lead_with_our_fastest(tmp_path):
    pytest.importorskip("matplotlib")
    rows = made_up_rows()
    regular = [row for row in rows if row["system"] == _contest.REGULAR]
    found = _contest_plot.curves(regular)
    assert set(found) == {
        *("jaxlag dopri8", "jaxlag dopri8, jax 0.12.0", "heyoka", "numba"),
        *("diffrax by hand", "diffrax naive, no setting"),
    }
    assert _contest_plot.leaders(found) == {"jaxlag dopri8"}
    errors, us = found["numba"]
    assert errors.min() >= 1e-8
    assert np.all(np.diff(us) > 0)
    name = _contest_plot.save(_contest.REGULAR, regular, tmp_path / "new")
    assert name == "work-precision-double-pendulum-regular.png"
    path = tmp_path / "new" / name
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size < 100_000


def test_options_of_another_benchmark_are_refused(capsys):
    assert command.main(["solve", "--system", "heavy top"]) == 2
    assert "solve has no option --system" in capsys.readouterr().err


def test_a_system_whose_process_dies_is_named_and_the_others_go_on(tmp_path, monkeypatch):
    def contest(name, quick, python):
        if name == "heavy top":
            raise RuntimeError("a worker ended early with status -11")
        return [row | {"system": name} for row in made_up_rows()[:2]], []

    monkeypatch.setattr(_results, "FOLDER", tmp_path)
    monkeypatch.setattr(work_precision, "contest", contest)
    report = work_precision.run(False, system=["heavy top", "rolling disk"])
    assert ("failed", "heavy top: a worker ended early with status -11") in report.references
    assert {row["system"] for row in report.rows} == {"rolling disk"}
    assert any("heavy top" in target.claim and not target.met for target in report.targets)


def test_results_have_a_line_for_every_row():
    rows = [{"a": 1.5, "b": "row 0"}, {"a": None, "b": "x"}]
    content = {"benchmark": "b", "runs": [{"rows": rows[:1]}, {"rows": rows}]}
    text = _results._compact(content)
    assert json.loads(text) == content
    assert sum('"b": "' in line for line in text.splitlines()) == 3


def test_an_unknown_system_is_refused():
    with pytest.raises(ValueError, match=r"--system must be one of .*but it was 'hevy top'"):
        work_precision.run(True, system=["hevy top"])


class FakeWorker:
    """A process that knows one fast and one slow point."""

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


def test_processes_take_turns_and_long_runs_sit_out(monkeypatch):
    monkeypatch.setattr(work_precision, "Worker", FakeWorker)
    rows, notes = work_precision.contest("heavy top", False, "another/python")
    assert {row["line"] for row in rows} == {
        *("jaxlag dopri8", "diffrax Tsit5, naive, no setting", "heyoka, jax 0.12.0", "heyoka"),
    }
    assert all(set(row) == COLUMNS for row in rows)
    fast, slow = rows[:2]
    assert fast["repeats"] == 6  # three turns, then its time is up
    assert math.isclose(fast["min_us"], 10e3)
    assert (slow["repeats"], slow["min_us"]) == (2, 0.3e6)
    assert notes == [("7.0", "version of heyoka")]
    without, _ = work_precision.contest("heavy top", False, None)
    assert not any(", jax " in row["line"] for row in without)


class AbsentWorker(FakeWorker):
    """One whose other interpreter has no jax."""

    def __init__(self, benchmark, quick, settings, **options):
        if "interpreter" in options:
            raise RuntimeError("a worker ended early with status 1")
        super().__init__(benchmark, quick, settings, **options)


def test_another_interpreter_that_cannot_do_it_is_named(monkeypatch):
    monkeypatch.setattr(work_precision, "Worker", AbsentWorker)
    rows, notes = work_precision.contest("heavy top", False, "another/python")
    assert len(rows) == 6
    words = "another jax: another/python: a worker ended early with status 1"
    assert ("left out", words) in notes


@pytest.mark.full
def test_a_quick_run_is_measured_and_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(_results, "FOLDER", tmp_path)
    command.main(["work-precision", "--quick"])
    assert "times as long: jaxlag as the best peer" in capsys.readouterr().out
    (run,) = json.loads((tmp_path / "quick" / "work-precision.json").read_text())["runs"]
    assert {"jaxlag dopri8", "diffrax Dopri8, by hand"} <= {row["line"] for row in run["rows"]}
    assert all(set(row) == COLUMNS for row in run["rows"])
