"""Constraint drift: figures of known records, verdicts, curves."""

import json
import math
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _kept_runs import check_fields

from bench import __main__ as command
from bench import constraints
from bench._harness import results
from bench._problems.mechanisms import BOBS, LINKAGES, ROLLING, double_pendulum
from bench.constraints import _drift_plot


def recorded(position, energy=0.0, steps=1_000_000):
    """A record with these curves; numbers give constant curves."""
    position = np.asarray(position, float)
    zero = np.zeros(len(position))
    return constraints.Record(np.linspace(0, steps, len(zero)), position, zero, energy + zero)


@pytest.mark.full
@pytest.mark.parametrize("name", mostly_full([*LINKAGES, *ROLLING], *ROLLING))
def test_mechanisms_start_consistent(name):
    mechanism = (LINKAGES | ROLLING)[name]()
    start = jnp.asarray(mechanism.q0)[None], jnp.asarray(mechanism.v0)[None]
    record = constraints.record(mechanism, *start, 0)
    # Rounding of lengths of 1 m and of velocities up to 12 rad/s.
    assert record.position[0] < 1e-15
    assert record.velocity[0] < 1e-14
    at_rest, moving = (
        float(mechanism.system.energy(mechanism.q0, k * mechanism.v0, mechanism.params))
        for k in (0, 1)
    )
    assert math.isclose(moving - at_rest, mechanism.energy, rel_tol=1e-14)


def test_residuals_are_distances_and_the_energy_is_in_units_of_the_start():
    mechanism = double_pendulum()
    off, out = 1e-6, 1e-3
    q, v = (np.tile(x, (4, 1)) for x in (mechanism.q0, mechanism.v0))
    q[1] -= [0.0, off, 0.0, off]  # the first rod is too long
    v[2] -= [0.0, 0.0, 0.0, out]  # the second rod lengthens: out / sqrt(2) over its two ends
    v[3] *= 2.0
    record = constraints.record(mechanism, jnp.asarray(q), jnp.asarray(v), 30)
    assert np.array_equal(record.steps, [0.0, 10.0, 20.0, 30.0])
    # To second order in off, which is small relative to the rod.
    assert np.allclose(record.position, [0.0, off, 0.0, 0.0], rtol=1e-5, atol=1e-15)
    assert np.allclose(record.velocity, [0.0, 0.0, out / math.sqrt(2.0), 0.0], atol=1e-14)
    fall = (BOBS["m1"] + BOBS["m2"]) * 9.81 * off / mechanism.energy
    gain = 0.5 * BOBS["m2"] * out**2 / mechanism.energy
    assert np.allclose(record.energy, [0.0, -fall, gain, 3.0], rtol=1e-8, atol=1e-15)


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


def drifted(mechanism, stabilization, position=1e-14, velocity=1e-14, energy=1.0, ratio=1.0):
    case = constraints.Case(mechanism, "multipliers", stabilization)
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
    assert len(references) == 2  # none for Baumgarte, which has no rows


def test_curves_are_drawn_up_to_a_failure(tmp_path):
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
def test_drift_is_measured_and_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(results, "FOLDER", tmp_path)
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
    # A tumbling motion at 0.01 s drifts far more than rounding, and the drift grows quadratically.
    assert 1e-12 < none["position"] < 1e-6
    assert none["growth"] > 10.0
    assert none["ratio"] == 1.0
