"""The benchmarks measure finished work, store their results and judge them."""

import io
import json
import math
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest
from _kept_runs import check_fields

from bench import __main__ as command
from bench._harness import results, timing, workers
from bench._harness.timing import BENCHMARKS, RUNS_PER_ROUND, Reference, Report, Target
from bench._problems import double_pendulum as pendulum
from systems.catalogue.chapter3.double_pendulum import system


class Clock:
    """A clock that only waiting for work advances."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(timing, "perf_counter", lambda: self.now)

    def pending(self, seconds):
        return Pending(self, seconds)


class Pending:
    """An output that takes time only if it is waited for."""

    def __init__(self, clock, seconds):
        self.clock, self.seconds = clock, seconds

    def block_until_ready(self):
        self.clock.now += self.seconds
        return self


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def test_the_timer_waits_for_every_output(clock):
    assert timing.seconds(lambda: {"q": clock.pending(5.0), "v": [clock.pending(2.0)]}) == 7.0


def test_timer_misses_outputs_that_are_not_waited_for(clock, monkeypatch):
    monkeypatch.setattr(jax, "block_until_ready", lambda x: x)
    assert timing.seconds(lambda: clock.pending(5.0)) == 0.0


def test_timer_measures_a_slow_program():
    runs = []

    def sleep(x):
        runs.append(x)
        time.sleep(0.2)
        return x

    def slow(x):
        return jax.pure_callback(sleep, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    program = timing.build(slow, jnp.zeros(()))
    assert not runs  # compilation is measured separately
    assert timing.seconds(lambda: program.call(jnp.zeros(()))) >= 0.2
    assert len(runs) == 1


def test_calls_are_interleaved_after_a_warm_up(clock):
    order = []
    calls = {name: lambda name=name: order.append(name) or clock.pending(1.0) for name in "ab"}
    samples = timing.interleaved(calls, rounds=2)
    assert "".join(order) == "ab" + "aaabbb" * 2
    assert samples == {"a": [1.0] * 6, "b": [1.0] * 6}


def test_call_over_its_budget_is_skipped(clock):
    calls = {"slow": lambda: clock.pending(9.0), "fast": lambda: clock.pending(0.1)}
    samples = timing.interleaved(calls, rounds=6, budget_s=2.0)
    assert len(samples["slow"]) == RUNS_PER_ROUND
    assert len(samples["fast"]) == 6 * RUNS_PER_ROUND


def test_times_are_per_lane_in_the_given_unit():
    columns = timing.spread([3e-3, 1e-3, 2e-3], "us", lanes=10)
    assert columns["repeats"] == 3
    assert math.isclose(columns["min_us"], 100.0)
    assert math.isclose(columns["median_us"], 200.0)


@pytest.mark.parametrize(
    ("figure", "relation", "met"),
    [
        (10.0, ">=", True),
        (9.9, ">=", False),
        (math.nan, ">=", False),
        (10.0, "<=", True),
        (10.1, "<=", False),
        (math.nan, "<=", False),
    ],
)
def test_targets_are_met_up_to_their_bound_and_never_by_nan(figure, relation, met):
    assert Target("of something", figure, relation, 10.0).met is met


def report(figure=12.0):
    target = Target("times faster", figure, ">=", 10.0)
    return Report([{"case": "a", "min_ms": 0.123456789}], [target], [Reference("1 ms", "peer")])


def test_results_have_all_fields(tmp_path):
    path = results.save("solve", "Headline.", report(), results.circumstances(), False, tmp_path)
    assert path == tmp_path / "solve.json"
    content = json.loads(path.read_text())
    assert (content["benchmark"], content["measures"]) == ("solve", "Headline.")
    (run,) = content["runs"]
    check_fields(run)
    assert run["rows"] == [{"case": "a", "min_ms": 0.12346}]
    assert run["targets"][0]["met"] is True
    assert run["versions"]["jax"] == jax.__version__


def test_run_replaces_only_the_last_one_of_its_jax_version(tmp_path):
    def save(jax_version, quick=False):
        circumstances = {**results.circumstances(), "versions": {"jax": jax_version}}
        return results.save("solve", "Headline.", report(), circumstances, quick, tmp_path)

    for jax_version in ("0.12.0.1", "0.10.2", "0.9.1", "0.10.2"):
        path = save(jax_version)
    assert save("0.10.2", quick=True) == tmp_path / "quick" / "solve.json"
    versions = [run["versions"]["jax"] for run in json.loads(path.read_text())["runs"]]
    assert versions == ["0.9.1", "0.10.2", "0.12.0.1"]


@pytest.mark.parametrize(("figure", "status", "verdict"), [(12.0, 0, "met"), (9.0, 1, "MISSED")])
def test_a_missed_target_makes_the_exit_status_1(
    figure, status, verdict, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(results, "FOLDER", tmp_path)
    monkeypatch.setattr("bench.solve.run", lambda quick: report(figure))
    assert command.main(["solve"]) == status
    assert f"target {verdict:<6}  {figure:g} >= 10" in capsys.readouterr().out


def test_unknown_name_gets_the_nearest_known_one(capsys):
    assert command.main(["gradeint"]) == 2
    assert "'gradeint'. Did you mean gradient?" in capsys.readouterr().err
    assert command.main(["xyz"]) == 2
    assert f"Known: {', '.join(BENCHMARKS)}." in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seconds", "-1"], "--seconds must be a positive number of seconds, but it was -1.0."),
        (["--seconds", "0"], "--seconds must be a positive number of seconds, but it was 0.0."),
        (["--seconds", "inf"], "--seconds must be a positive number of seconds, but it was inf."),
        (["--first", "-3"], "--first must be a seed, 0 or more, but it was -3."),
    ],
)
def test_options_out_of_bounds_are_refused_before_the_run(arguments, message, capsys):
    assert command.main(["fuzz", *arguments]) == 2
    assert capsys.readouterr().err == message + "\n"


@pytest.mark.parametrize(
    ("rows", "arguments", "kept"),
    [([], [], "no file"), ([{"x": 1}], ["--seconds", "3"], "quick/fuzz.json")],
)
def test_a_kept_result_is_not_replaced_by_nothing_or_by_a_part(
    rows, arguments, kept, tmp_path, monkeypatch, capsys
):
    def run(quick, seconds=None, first=0):
        return Report(rows, [], [])

    monkeypatch.setattr(command, "_module", lambda name: SimpleNamespace(run=run, __doc__="Fuzz."))
    monkeypatch.setattr(command.results, "FOLDER", tmp_path)
    status = command.main(["fuzz", *arguments])
    written = [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.json")]
    if kept == "no file":
        assert (status, written) == (2, [])
        assert "measured nothing" in capsys.readouterr().err
    else:
        assert (status, written) == (0, [kept])


def test_list_names_and_describes_every_benchmark(capsys):
    assert command.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(BENCHMARKS)
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize("name", BENCHMARKS)
def test_results_of_full_runs_are_stored(name):
    content = json.loads((results.FOLDER / f"{name}.json").read_text())
    assert content["benchmark"] == name
    for run in content["runs"]:
        check_fields(run)
        assert not run["quick"]


def test_workers_start_with_their_own_settings_only(monkeypatch):
    started = []

    class Process:
        def __init__(self, command, env, **_):
            started.append(env)
            self.stdin, self.stdout = io.StringIO(), io.StringIO('{"a": 1}\n{"b": [2.0]}\n')

        def wait(self):
            return 7

    monkeypatch.setenv("XLA_FLAGS", "--from_importing_jaxlag_here")
    monkeypatch.setattr(workers.subprocess, "Popen", Process)
    worker = workers.Worker("solve", True, {"JAXLAG_XLA_FLAGS": "0"})
    assert worker.facts == {"a": 1}
    assert worker.seconds() == {"b": [2.0]}
    with pytest.raises(RuntimeError, match="ended early with status 7"):
        worker.seconds()
    assert "XLA_FLAGS" not in started[0]
    assert started[0]["JAXLAG_XLA_FLAGS"] == "0"


@pytest.mark.full
@pytest.mark.parametrize("field", [pendulum.by_hand, pendulum.naive])
def test_compared_equations_equal_those_of_the_system(field):
    y = jnp.array([0.7, -1.1, 0.4, 1.3])
    params = {name: value * (1.0 + 0.1 * i) for i, (name, value) in enumerate(params_of_bench())}
    expected = jnp.concatenate([y[2:], system.acceleration(y[:2], y[2:], params)])
    # Rounding of an acceleration of about 10 rad/s^2 by a 2 x 2 solve.
    assert jnp.max(jnp.abs(field(0.0, y, params) - expected)) < 1e-13


def params_of_bench():
    return pendulum.params().items()
