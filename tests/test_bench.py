"""The benchmarks measure finished work, keep what they found, and judge it."""

import io
import json
import math
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

import jaxlag as jl
from bench import __main__ as command
from bench import (
    _chains,
    _drift_plot,
    _harness,
    _long_runs,
    _results,
    _rk4,
    _stress,
    _workers,
    constraints,
    lowering,
    stability,
)
from bench import _double_pendulum as pendulum
from bench._by_hand import BY_HAND
from bench._harness import BENCHMARKS, RUNS_PER_TURN, Reference, Report, Target
from bench._mechanisms import BOBS, LINKAGES, ROLLING, double_pendulum
from bench._scenes import SCENES, links
from bench._verdict import NEIGHBOURS, OPERATIONS, verdict
from systems.double_pendulum import system

RUN_FIELDS = {"date", "commit", "machine", "versions", "native_loops", "quick"} | {
    "rows",
    "targets",
    "references",
}


class Clock:
    """A clock that stands still but for the work that is waited for."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(_harness, "perf_counter", lambda: self.now)

    def pending(self, seconds):
        return Pending(self, seconds)


class Pending:
    """An output that takes time, but only of those who wait for it."""

    def __init__(self, clock, seconds):
        self.clock, self.seconds = clock, seconds

    def block_until_ready(self):
        self.clock.now += self.seconds
        return self


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def test_the_timer_waits_for_every_output(clock):
    assert _harness.seconds(lambda: {"q": clock.pending(5.0), "v": [clock.pending(2.0)]}) == 7.0


def test_the_timer_sees_nothing_of_outputs_not_waited_for(clock, monkeypatch):
    monkeypatch.setattr(jax, "block_until_ready", lambda x: x)
    assert _harness.seconds(lambda: clock.pending(5.0)) == 0.0


def test_a_program_known_to_be_slow_takes_long():
    runs = []

    def sleep(x):
        runs.append(x)
        time.sleep(0.2)
        return x

    def slow(x):
        return jax.pure_callback(sleep, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    program = _harness.build(slow, jnp.zeros(()))
    assert not runs  # compilation is measured apart
    assert _harness.seconds(lambda: program.call(jnp.zeros(()))) >= 0.2
    assert len(runs) == 1


def test_calls_take_turns_after_one_to_warm_up(clock):
    order = []
    calls = {name: lambda name=name: order.append(name) or clock.pending(1.0) for name in "ab"}
    samples = _harness.interleaved(calls, rounds=2)
    assert "".join(order) == "ab" + "aaabbb" * 2
    assert samples == {"a": [1.0] * 6, "b": [1.0] * 6}


def test_a_call_over_its_budget_sits_out(clock):
    calls = {"slow": lambda: clock.pending(9.0), "fast": lambda: clock.pending(0.1)}
    samples = _harness.interleaved(calls, rounds=6, budget_s=2.0)
    assert len(samples["slow"]) == RUNS_PER_TURN
    assert len(samples["fast"]) == 6 * RUNS_PER_TURN


def test_times_are_per_lane_in_the_unit_named():
    columns = _harness.spread([3e-3, 1e-3, 2e-3], "us", lanes=10)
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


def test_results_hold_all_fields(tmp_path):
    path = _results.save("solve", "Headline.", report(), _results.circumstances(), False, tmp_path)
    assert path == tmp_path / "solve.json"
    content = json.loads(path.read_text())
    assert (content["benchmark"], content["measures"]) == ("solve", "Headline.")
    (run,) = content["runs"]
    check_fields(run)
    assert run["rows"] == [{"case": "a", "min_ms": 0.12346}]
    assert run["targets"][0]["met"] is True
    assert run["versions"]["jax"] == jax.__version__


def check_fields(run):
    assert set(run) == RUN_FIELDS
    assert set(run["machine"]) == {"cpu", "cores", "platform", "load"}
    assert set(run["versions"]) == {"python", *_results.PACKAGES}
    for target in run["targets"]:
        assert set(target) == {"claim", "figure", "relation", "bound", "met"}
    for reference in run["references"]:
        assert set(reference) == {"figure", "what"}
    assert len({tuple(row) for row in run["rows"]}) == 1


def test_a_run_replaces_the_last_on_its_jax_and_keeps_the_others(tmp_path):
    def save(jax_version, quick=False):
        circumstances = {**_results.circumstances(), "versions": {"jax": jax_version}}
        return _results.save("solve", "Headline.", report(), circumstances, quick, tmp_path)

    for jax_version in ("0.12.0.1", "0.10.2", "0.9.1", "0.10.2"):
        path = save(jax_version)
    assert save("0.10.2", quick=True) == tmp_path / "quick" / "solve.json"
    versions = [run["versions"]["jax"] for run in json.loads(path.read_text())["runs"]]
    assert versions == ["0.9.1", "0.10.2", "0.12.0.1"]


@pytest.mark.parametrize(("figure", "status", "verdict"), [(12.0, 0, "met"), (9.0, 1, "MISSED")])
def test_a_missed_target_makes_the_exit_status_1(
    figure, status, verdict, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(_results, "FOLDER", tmp_path)
    monkeypatch.setattr("bench.solve.run", lambda quick: report(figure))
    assert command.main(["solve"]) == status
    assert f"target {verdict:<6}  {figure:g} >= 10" in capsys.readouterr().out


def test_an_unknown_name_is_answered_with_the_nearest(capsys):
    assert command.main(["gradeint"]) == 2
    assert "'gradeint'. Did you mean gradient?" in capsys.readouterr().err
    assert command.main(["xyz"]) == 2
    assert f"Known: {', '.join(BENCHMARKS)}." in capsys.readouterr().err


def test_the_list_names_every_benchmark_and_what_it_measures(capsys):
    assert command.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(BENCHMARKS)
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize("name", BENCHMARKS)
def test_results_of_full_runs_are_kept(name):
    content = json.loads((_results.FOLDER / f"{name}.json").read_text())
    assert content["benchmark"] == name
    for run in content["runs"]:
        check_fields(run)
        assert not run["quick"]


def test_workers_start_under_their_own_settings_alone(monkeypatch):
    started = []

    class Process:
        def __init__(self, command, env, **_):
            started.append(env)
            self.stdin, self.stdout = io.StringIO(), io.StringIO('{"a": 1}\n{"b": [2.0]}\n')

        def wait(self):
            return 7

    monkeypatch.setenv("XLA_FLAGS", "--from_importing_jaxlag_here")
    monkeypatch.setattr(_workers.subprocess, "Popen", Process)
    worker = _workers.Worker("solve", True, {"JAXLAG_XLA_FLAGS": "0"})
    assert worker.facts == {"a": 1}
    assert worker.seconds() == {"b": [2.0]}
    with pytest.raises(RuntimeError, match="ended early with status 7"):
        worker.seconds()
    assert "XLA_FLAGS" not in started[0]
    assert started[0]["JAXLAG_XLA_FLAGS"] == "0"


@pytest.mark.parametrize("field", [pendulum.by_hand, pendulum.naive])
def test_all_equations_compared_are_those_of_the_system(field):
    y = jnp.array([0.7, -1.1, 0.4, 1.3])
    params = {name: value * (1.0 + 0.1 * i) for i, (name, value) in enumerate(params_of_bench())}
    expected = jnp.concatenate([y[2:], system.acceleration(params, y[:2], y[2:])])
    # Round-off of an acceleration of about 10 rad/s^2 through a 2 x 2 solve.
    assert jnp.max(jnp.abs(field(0.0, y, params) - expected)) < 1e-13


def params_of_bench():
    return pendulum.params().items()


def off(name, contenders):
    """Largest relative difference of the contenders from the array program."""
    found = lowering.accelerations(name, {"array": array_of(name)} | contenders)
    expected = found.pop("array")
    return max(np.max(np.abs(a - expected)) / np.max(np.abs(expected)) for a in found.values())


def array_of(name):
    return _rk4.by_jaxlag(SCENES[name], "array")


@pytest.mark.parametrize("name", mostly_full(BY_HAND, "pendulum", "top"))
def test_hand_written_equations_are_those_of_the_scene(name):
    plain = BY_HAND[name]
    contenders = {"by hand": (plain, True), "called": (_rk4.called(plain), True)}
    assert off(name, contenders) < lowering.AGREEMENT


@pytest.mark.parametrize("name", ["pendulum", "cart_pole", "kepler", "top", "chain_3"])
def test_equations_by_sympy_are_those_of_the_scene(name, monkeypatch):
    pytest.importorskip("sympy")
    from bench import _sympy

    monkeypatch.setattr(_sympy, "PATIENCE_S", 3.0)
    forms = _sympy.forms(name, SCENES[name])
    assert "as derived" in forms
    assert off(name, {words: (form, True) for words, form in forms.items()}) < lowering.AGREEMENT


def test_sympy_stops_simplifying_when_its_time_is_up(monkeypatch):
    pytest.importorskip("sympy")
    from bench import _sympy

    monkeypatch.setattr(_sympy, "PATIENCE_S", 0.01)
    monkeypatch.setattr(_sympy, "_tidy", lambda x: time.sleep(5.0))
    assert set(_sympy.forms("cart_pole", SCENES["cart_pole"])) == {"as derived"}


def test_the_scalar_program_is_timed_on_scalars_and_the_array_program_on_arrays():
    scene = SCENES["double_pendulum"]
    assert [_rk4.by_jaxlag(scene, words)[1] for words in ("auto", "array")] == [True, False]
    assert len(_rk4.parts(scene.q0, True)) == 2
    assert [x.shape for x in _rk4.parts(scene.q0, False)] == [(2,)]


def test_the_loop_of_evaluations_integrates():
    steps = 1000
    oscillator = lambda params: lambda q, v: [-params * q[0]]  # noqa: E731
    start = ([jnp.asarray(1.0)], [jnp.asarray(0.0)])
    q, v = jax.jit(_rk4.loop(oscillator, steps))(*start, 400.0)
    phase = 20.0 * steps * _rk4.STEP
    # Runge-Kutta's error at 2e-3 rad a step over 2 rad: phase times the fourth power over 120.
    assert abs(q[0][()] - math.cos(phase)) < 1e-12
    assert abs(v[0][()] + 20.0 * math.sin(phase)) < 2e-11


@pytest.mark.parametrize("name", NEIGHBOURS)
@pytest.mark.parametrize("n", [2, 5])
def test_neighbours_compute_the_accelerations_of_the_chain(name, n):
    pytest.importorskip(_chains.MODULES[name])
    scene = links(n)
    q, v = np.array(scene.q0), np.linspace(0.5, -0.4, n)
    expected = _rk4.system(scene).acceleration(scene.params, q, v)
    neighbour = _chains.MAKERS[name](scene, 3)
    found = neighbour.acceleration(q, v)
    assert np.max(np.abs(found - expected)) < lowering.PEER_AGREEMENT * np.max(np.abs(expected))
    neighbour.call()
    assert neighbour.evaluations == 12


def test_the_loop_of_numba_is_the_same():
    pytest.importorskip("numba")
    scene, steps = links(3), 50
    equations, scalar = _rk4.by_jaxlag(scene)
    args = _rk4.parts(scene.q0, scalar), _rk4.parts(scene.v0, scalar), scene.params
    expected = jnp.array(jax.jit(_rk4.loop(equations, steps))(*args))
    found = np.array(_chains.by_numba(scene, steps).call())
    assert np.max(np.abs(found - expected)) < 1e-13


def test_neighbours_that_cannot_be_imported_are_left_out(monkeypatch):
    monkeypatch.setattr(_chains, "MODULES", dict.fromkeys(NEIGHBOURS, "no_such_module"))
    assert _chains.missing() == list(NEIGHBOURS)
    assert _chains.neighbours(links(2), 3) == {}


def test_contenders_that_disagree_are_not_timed(monkeypatch):
    monkeypatch.setitem(BY_HAND, "pendulum", lambda p: lambda q, v: [jnp.sin(q[0])])
    monkeypatch.setattr(lowering, "find_spec", lambda name: None)
    with pytest.raises(RuntimeError, match="pendulum: accelerations of 'by hand' are off by"):
        lowering.evaluation("pendulum", quick=True)


def made_up(part, system, n, times):
    own = times["jaxlag"]
    return [
        {**dict.fromkeys(lowering.COLUMNS), "part": part, "system": system, "n": n}
        | {"contender": name, "ratio": us / own, "min_us": us, "trace_s": 0.5, "compile_s": us}
        for name, us in times.items()
    ]


def judged(rows):
    counts = OPERATIONS | {"top": 90}
    targets, references = verdict(rows, counts, ["sympy"])
    return {t.claim: (round(t.figure, 9), t.met) for t in targets}, references


def test_rows_of_the_lowering_are_judged():
    rows = made_up("evaluation", "a", 1, {"jaxlag": 1.0, "array": 2.0, "by hand": 2.0})
    times = {"jaxlag": 4.0, "array": 40.0, "by hand": 3.0, "sympy trigsimp": 2.0}
    rows += made_up("evaluation", "b", 3, times | {"by hand, called": 1.0})
    rows += made_up("chain", "chain_8", 8, {"jaxlag": 2.0, "array": 12.0, "numba": 4.0})
    rows += made_up("chain", "chain_16", 16, {"jaxlag": 6.0, "numba": 4.0, "MuJoCo": 3.0})
    rows += made_up("chain", "chain_32", 32, {"jaxlag": 9.0, "numba": 1.0})
    rows += made_up("compile", "b", 3, {"jaxlag": 0.75})
    rows += made_up("compile", "chain_12", 12, {"jaxlag": 4.0})
    rows += made_up("solve", "double_pendulum", 2, {"jaxlag": 1.0, "setting on, x": 130.0})
    targets, references = judged(rows[:-2] + rows[-1:])
    best = "times as long: jaxlag as the best of hand-written and sympy"
    faster = "times faster: the scalar than the array program"
    compiled = "s to derive and compile a solve"
    assert targets == {
        f"{best}, mean of 2": (1.0, True),
        f"{best}, worst (b)": (2.0, False),
        f"{faster}, n = 1": (2.0, True),
        f"{faster}, least for n = 2 to 4": (10.0, False),
        f"{faster}, chain of 8": (6.0, True),
        "times as long: jaxlag as its best neighbour, worst of n <= 16 (n = 16)": (2.0, False),
        f"{compiled}, worst of n <= 4 (b)": (1.25, True),
        f"{compiled}, chain of 12": (4.5, False),
        "ms: double pendulum to 1e-9, setting on": (0.13, True),
        "operations of top": (90.0, False),
        "operations of rigid_body": (85.0, True),
        "operations of aircraft": (410.0, True),
        "operations of chain_8": (720.0, True),
    }
    told = {what: figure for figure, what in references}
    assert told["sympy: cannot be imported"] == "left out"
    assert told["times as long: jaxlag as numba, chain of 32"] == "9"
    both = "times as long: jaxlag as the best of both, theirs also called"
    assert told[f"{both}, mean of 2; worst b"] == "1.41; 4"


def test_a_system_without_a_scalar_program_misses_its_count():
    rows = made_up("evaluation", "a", 1, {"jaxlag": 1.0, "by hand": 2.0})
    rows += made_up("compile", "a", 1, {"jaxlag": 1.0})
    rows += made_up("compile", "chain_12", 12, {"jaxlag": 1.0})
    targets, _ = verdict(rows, dict.fromkeys(OPERATIONS), [])
    counts = [target for target in targets if target.claim.startswith("operations")]
    assert [target.met for target in counts] == [False] * 4


def test_columns_that_do_not_apply_are_blank():
    text = _results.text(Report([{"a": "x", "b": None, "c": 1.0}], [], []))
    assert text.splitlines()[1].split() == ["x", "1"]


def recorded(position, energy=0.0, steps=1_000_000):
    """A record with these curves, numbers for constants."""
    position = np.asarray(position, float)
    zero = np.zeros(len(position))
    return constraints.Record(np.linspace(0, steps, len(zero)), position, zero, energy + zero)


@pytest.mark.parametrize("name", mostly_full([*LINKAGES, *ROLLING], *ROLLING))
def test_mechanisms_start_consistent(name):
    mechanism = (LINKAGES | ROLLING)[name]()
    start = jnp.asarray(mechanism.q0)[None], jnp.asarray(mechanism.v0)[None]
    record = constraints.record(mechanism, *start, 0)
    # Rounding of lengths of 1 m and of velocities up to 12 rad/s.
    assert record.position[0] < 1e-15
    assert record.velocity[0] < 1e-14
    at_rest, moving = (
        float(mechanism.system.energy(mechanism.params, mechanism.q0, k * mechanism.v0))
        for k in (0, 1)
    )
    assert math.isclose(moving - at_rest, mechanism.energy, rel_tol=1e-14)


def test_residuals_are_distances_and_the_energy_is_in_units_of_the_start():
    mechanism = double_pendulum()
    off, out = 1e-6, 1e-3
    q, v = (np.tile(x, (4, 1)) for x in (mechanism.q0, mechanism.v0))
    q[1] -= [0.0, off, 0.0, off]  # the first rod too long
    v[2] -= [0.0, 0.0, 0.0, out]  # the second rod lengthening, at half sqrt(2) of its two ends'
    v[3] *= 2.0
    record = constraints.record(mechanism, jnp.asarray(q), jnp.asarray(v), 30)
    assert np.array_equal(record.steps, [0.0, 10.0, 20.0, 30.0])
    # To second order in off, which is small beside the rod.
    assert np.allclose(record.position, [0.0, off, 0.0, 0.0], rtol=1e-5, atol=1e-15)
    assert np.allclose(record.velocity, [0.0, 0.0, out / math.sqrt(2.0), 0.0], atol=1e-14)
    fall = (BOBS["m1"] + BOBS["m2"]) * 9.81 * off / mechanism.energy
    push = 0.5 * BOBS["m2"] * out**2 / mechanism.energy
    assert np.allclose(record.energy, [0.0, -fall, push, 3.0], rtol=1e-8, atol=1e-15)


def test_figures_of_a_known_record():
    steps = np.linspace(0, 2_000_000, 2001)
    late = steps >= 1_000_000
    energy = np.where(late, 0.5 - 3e-7 * steps, 9.0 * np.sin(steps))
    energy[5] = -11.0
    position = np.where(steps < 100_000, 2e-9, 1e-9)
    position[1500] = 6e-9
    found = constraints.figures(recorded(position, energy, 2_000_000))
    assert math.isclose(found["slope"], -0.3)
    assert (found["position"], found["velocity"], found["energy"]) == (6e-9, 0.0, 11.0)
    assert math.isclose(found["growth"], 3.0)


def test_a_run_that_failed_has_no_figures():
    failed = recorded([1e-15] * 40 + [math.nan], [0.0] * 40 + [math.nan])
    done = recorded([1e-15] * 41)
    assert (failed.complete, done.complete) == (False, True)
    found = constraints.figures(failed)
    assert all(math.isnan(found[name]) for name in ("position", "growth", "energy", "slope"))
    times = constraints.times([0.5, 1.0], failed)
    assert math.isnan(times["min_us"])
    assert math.isnan(times["median_us"])
    assert constraints.times([0.5, 1.0], done)["min_us"] == 0.5


def drifted(mechanism, stabilisation, position=1e-14, velocity=1e-14, energy=1.0, ratio=1.0):
    case = constraints.Case(mechanism, "multipliers", stabilisation)
    columns = {"position": position, "velocity": velocity, "energy": energy, "ratio": ratio}
    return {**case._asdict(), **columns, "growth": 100.0}


def test_drift_is_judged_by_the_worst_mechanism_and_missed_by_nan():
    rows = [
        drifted("a", "none", energy=2.0, position=1e-8),
        drifted("a", "projection", velocity=2e-12, ratio=1.4),
        drifted("b", "none", energy=0.5, position=1e-6),
        drifted("b", "projection", position=math.nan, energy=0.75, ratio=1.2),
    ]
    targets, references = constraints.judged(rows)
    found = [(t.claim.split(",")[-1], t.figure, t.met) for t in targets]
    assert math.isnan(found[0][1])
    assert (found[0][0], found[0][2]) == (" multipliers (b)", False)
    assert found[1:] == [
        (" multipliers (a)", 2e-12, False),
        (" multipliers (b)", 1.5, False),
        (" multipliers (a)", 1.4, True),
    ]
    without = [("1e-08 to 1e-06", "position residual without stabilisation")]
    assert references[:1] == without
    assert len(references) == 2  # none of Baumgarte, who has no rows


def test_curves_are_drawn_as_far_as_they_go(tmp_path):
    key = ("a", "multipliers", "projection")
    records = {key: recorded([0.0, 1e-14, math.nan]), ("b", *key[1:]): recorded([0.0, 0.0, 1.0])}
    path = tmp_path / "new" / "drift.png"
    assert _drift_plot.save(records, path) == "drift.png"
    assert path.read_bytes().startswith(b"\x89PNG")


def test_without_matplotlib_there_are_no_curves(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert "matplotlib cannot be imported" in _drift_plot.save({}, tmp_path / "drift.png")
    assert not list(tmp_path.iterdir())


@pytest.mark.full
def test_drift_is_measured_and_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(_results, "FOLDER", tmp_path)
    monkeypatch.setattr(constraints, "QUICK_STEPS", 2000)
    command.main(["constraints", "--quick"])
    assert "times the energy drift: projection as none" in capsys.readouterr().out
    assert (tmp_path / "quick" / "constraints.png").exists()
    (run,) = json.loads((tmp_path / "quick" / "constraints.json").read_text())["runs"]
    check_fields(run)
    fields = constraints.Case._fields
    rows = {constraints.Case(*(row[name] for name in fields)): row for row in run["rows"]}
    assert list(rows) == constraints.cases(quick=True)
    none, projection, *rolling = rows.values()
    assert all(row["velocity"] < 1e-12 for row in rolling[1:])  # projection, quasi-velocities
    assert projection["position"] < 1e-12
    assert projection["velocity"] < 1e-12
    # A tumbling motion at 0.01 s drifts by far more than rounding, and grows with its square.
    assert 1e-12 < none["position"] < 1e-6
    assert none["growth"] > 10.0
    assert none["ratio"] == 1.0


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
