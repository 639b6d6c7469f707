"""Lines of work over error: swept, timed and interpolated; every library reaches the end."""

import math
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

from bench import work_precision
from bench._harness import timing
from bench._problems import exact_ends
from bench._problems.motions import MOTIONS
from bench.work_precision import _jax, _peers, _sweep
from bench.work_precision._sweep import Line, Solved, swept, time_at

motion_of = cache(lambda name: MOTIONS[name]())


# ---- Sweeps and times ----------------------------------------------------------------------------


class Result:
    """A result that exists only after it has been waited for."""

    def __init__(self, q):
        self.q, self.waited = q, False

    def block_until_ready(self):
        self.waited = True
        return self


def made_up_line(errors, results=None):
    """A line with the given errors, knob by knob."""

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
    assert len(results) == 4  # one to warm up and one to time, for each knob
    assert all(result.waited for result in results)
    assert list(calls) == ["0.01", "0.001"]
    assert [point["error"] for point in points] == [1e-3, 1e-4]
    assert all(point["compile_s"] >= 2.0 and len(point["swept_s"]) == 2 for point in points)


def test_a_deliberately_long_computation_shows_its_full_time(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(_sweep, "perf_counter", lambda: now[0])
    monkeypatch.setattr(timing, "perf_counter", lambda: now[0])

    class Long(Result):
        def block_until_ready(self):
            now[0] += 5.0
            return super().block_until_ready()

    line = made_up_line({1e-2: 1e-3})._replace(make=lambda knob: lambda: Long(1e-3))
    _, points = swept(line, float, patience_s=10.0)
    assert points[0]["swept_s"] == [5.0, 5.0]


def test_sweeps_end_at_rounding_or_without_patience():
    errors = {10.0**-k: max(10.0**-k, 1e-9) for k in range(2, 16)}
    _, points = swept(made_up_line(errors), float, patience_s=10.0)
    assert len(points) == 8 + _sweep.PATIENCE
    plateau = {10.0**-k: 1e-6 if k < 10 else 1e-14 for k in range(2, 16)}
    _, points = swept(made_up_line(plateau), float, patience_s=10.0)
    assert points[-1]["error"] == 1e-14  # stability, not rounding, limited the error
    _, points = swept(made_up_line(errors), float, patience_s=-1.0)
    assert points == []  # its first run exceeded any patience


def test_failed_runs_give_no_points():
    errors = {1e-1: math.nan, 1e-2: 2.0 * _sweep.WRONG, 1e-3: 1e-4}
    calls, points = swept(made_up_line(errors), float, patience_s=10.0)
    assert (len(calls), len(points)) == (1, 1)


def test_line_without_a_point_gives_the_reason():
    line = made_up_line({1e-1: math.nan})
    assert swept(line, float, patience_s=0.5)[1] == []
    assert line.why_none(0.5) == "no run of at most 2 s ended with an error below 0.1"
    assert line._replace(messages=["first", "too much work"]).why_none(0.5) == "too much work"


def points(*pairs):
    return [{"error": error, "min_us": us} for error, us in pairs]


def test_times_at_equal_error_are_interpolated_but_not_extrapolated():
    line = points((1e-4, 10.0), (1e-6, 40.0), (1e-8, 160.0))
    assert math.isclose(time_at(line, 1e-5, "min_us"), 20.0)
    assert math.isclose(time_at(line, 1e-6, "min_us"), 40.0)
    assert math.isclose(time_at(line, 1e-7, "min_us"), 80.0)
    assert time_at(line, 1e-9, "min_us") is None
    assert time_at(line, 1e-2, "min_us") == 10.0  # its loosest one suffices
    assert time_at([], 1e-2, "min_us") is None


def test_cheapest_time_to_an_error_counts():
    line = points((1e-4, 10.0), (1e-7, 20.0), (1e-5, 30.0), (1e-9, 90.0))
    assert 10.0 < time_at(line, 1e-6, "min_us") < 20.0


def test_tolerances_and_steps_decrease():
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


def test_every_solver_of_jaxlag_has_a_line():
    from jaxlag._simulation._methods import METHODS
    from jaxlag.solvers import AbstractFixedStep

    single = _jax.methods(MOTIONS["double pendulum, regular"]())
    ours = {name for name, make in METHODS.items() if type(make()).__module__.startswith("jaxlag")}
    assert ours <= set(single)
    assert {"tsit5", "dopri8"} <= set(single)
    assert "kvaerno5" in _jax.methods(MOTIONS["elastic pendulum, k = 1e6"]())
    lanes = _jax.methods(MOTIONS["16 double pendulums"]())
    assert "dopri8" in lanes
    assert not any(isinstance(METHODS[name](), AbstractFixedStep) for name in lanes)


@pytest.mark.full
@pytest.mark.parametrize("method", ["gauss8", "variational4"])
def test_canonical_methods_have_a_line_for_quasi_velocities(method):
    motion = motion_of("heavy top")._replace(t1=0.1)
    line = _jax.with_jaxlag(motion, method)
    assert line.read(line.make(0.1 / 64)()).steps == 64


@pytest.mark.parametrize("lanes", mostly_full([False, True], False))
def test_lines_in_jax_reach_the_end(lanes):
    motion = MOTIONS["16 double pendulums" if lanes else "double pendulum, regular"]()
    if lanes:
        motion = motion._replace(q0=motion.q0[:2], v0=motion.v0[:2])
    motion = motion._replace(t1=0.5)
    ends = []
    for line in (
        _jax.with_jaxlag(motion, "tsit5"),
        _jax.with_diffrax(motion, _jax.by_hand(motion), "Tsit5", jnp.asarray(motion.start())),
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


def test_scipy_reaches_the_stored_end():
    pytest.importorskip("scipy")
    motion = MOTIONS["Cartesian double pendulum"]()
    line = _peers.lines(motion)["scipy DOP853"][1](motion)
    solved = line.read(line.make(1e-10)())
    # The global error of a motion of 10 s at this tolerance, about 30 times as large.
    assert motion.error(solved.q, exact_ends.exact_end("Cartesian double pendulum")) < 1e-8


@pytest.mark.full
@pytest.mark.parametrize("name", ["heavy top", "chain of 8 links"])
def test_every_library_reaches_the_stored_end(name):
    motion = motion_of(name)
    missing = _peers.missing()
    for label, (library, make) in _peers.lines(motion).items():
        if library in missing:
            continue
        line = make(motion)
        error = math.inf
        for knob in line.knobs[::4]:
            error = min(error, motion.error(line.read(line.make(knob)()).q, exact(name)))
            if error < 1e-5:
                break
        assert error < 1e-5, label


def exact(name):
    return exact_ends.exact_end(name)


@pytest.mark.full
def test_dop853_in_numba_takes_the_steps_of_scipy():
    pytest.importorskip("numba")
    integrate = pytest.importorskip("scipy.integrate")
    from bench.work_precision import _numba_dop853

    motion = MOTIONS["double pendulum, regular"]()
    y, accepted, attempts = _numba_dop853.build(motion).run(motion.start(), 10.0, 1e-8, 1e-8)
    rates = lambda t, y: motion.evaluate(y)  # noqa: E731
    other = integrate.solve_ivp(rates, (0, 10), motion.start(), "DOP853", rtol=1e-8, atol=1e-8)
    assert abs(accepted - (len(other.t) - 1)) <= 2
    assert attempts > accepted
    # Steps that differ by rounding of the controller end within the error of either.
    assert np.max(np.abs(y - other.y[:, -1])) < 1e-7
