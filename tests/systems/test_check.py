"""The check: right files pass, and every wrong number of a file is detected."""

import json
import re

import numpy as np
import pytest
from _families import mostly_full
from _files import harmonic, recorded
from _paths import REFERENCE

import jaxlag as jl
from jaxlag._simulation import _simulate
from systems.__main__ import main
from systems.catalogue import ENTRIES
from systems.reference import _check
from systems.reference._check import compare, replay, replay_case, replay_prescribed, replay_rest
from systems.reference._files import load, read


def written(path, raw):
    path.write_text(json.dumps(raw))
    return str(path)


def places(raw, path=()):
    """Paths of keys to every number of a parsed file."""
    if isinstance(raw, dict | list):
        items = raw.items() if isinstance(raw, dict) else enumerate(raw)
        for key, item in items:
            yield from places(item, (*path, key))
    elif isinstance(raw, float) and not isinstance(raw, bool):
        yield path


def nudged(raw, path):
    """A copy of the file with one number changed by 1e-6, relative and absolute."""
    raw = json.loads(json.dumps(raw), parse_int=float)
    *parents, last = path
    target = raw
    for key in parents:
        target = target[key]
    target[last] += 1e-6 * (1 + abs(target[last]))
    return raw


PLAIN = "cart_pendulum", "atwood_multipliers"
FEW = [*PLAIN, "chaplygin_sleigh"]
"""With a time-dependent force, multipliers, quasi-velocities."""

KINDS = (
    *("spherical_pendulum_elastic", "falling_stick_friction", "heavy_symmetric_top"),
    *("carnival_ride", "sleeve_pendulum_equilibrium", "link_spring_mass_equilibrium"),
)
"""Cyclic coordinates, reactions, L in u, a prescribed motion, one and several equilibria."""


@pytest.mark.full
def test_every_reference_file_passes(capsys):
    files = sorted(REFERENCE.glob("*.json"))
    if not files:
        pytest.skip(f"no files in {REFERENCE}")
    status = main(["check", *map(str, files)])
    out = capsys.readouterr().out
    assert status == 0, out
    assert {line.split()[1] for line in out.splitlines()[:-1]} == {path.name for path in files}


@pytest.mark.parametrize("name", mostly_full(FEW, *PLAIN))
def test_the_reference_file_is_reproduced(name):
    path = REFERENCE / f"{name}.json"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    reference = load(path)
    for case in reference.cases:
        motion = replay_case(reference.entry, case)
        assert motion.status == jl.Status.ok
        for deviation in compare(case, motion.values):
            assert deviation.ok, f"{case.name}: {deviation}"


def replayed(entry, times):
    """The entry's example, replayed as a case of its kind."""
    params = {name: np.asarray(value) for name, value in entry.example.params.items()}
    if entry.kind == "static":
        return replay_rest(entry, params)
    if entry.kind == "prescribed":
        motion = jl.prescribed_motion(lambda t: entry.motion(t, params), times)
        return replay_prescribed(entry, params, times, *motion)
    return replay(entry, params, times, *(x[entry.file_columns] for x in entry.start()))


@pytest.mark.parametrize("name", mostly_full([*FEW, *KINDS], *PLAIN))
def test_every_wrong_number_is_detected(name):
    """Each number of each compared field in turn, including the first saves of derived fields."""
    entry = ENTRIES[name]
    times = np.linspace(0.0, min(2.0, getattr(entry.example, "duration", 2.0)), 6)
    motion = replayed(entry, times)
    raw = json.loads(json.dumps(recorded(entry, times, motion)), parse_int=float)
    (case,) = read(raw).cases
    assert all(deviation.size == 0 for deviation in compare(case, motion.values))

    compared = [
        path for path in places(raw) if path[2] not in ("params", "times", "error_estimate")
    ]
    assert len(compared) == sum(values.size for values in motion.values.values())
    for path in compared:
        field = ".".join(key for key in path[2:] if isinstance(key, str))
        index = next((key for key in path[2:] if isinstance(key, int)), 0)
        index = 0 if entry.kind == "static" else index
        (case,) = read(nudged(raw, path)).cases
        outside = [deviation for deviation in compare(case, motion.values) if not deviation.ok]
        assert [(deviation.field, deviation.time_index) for deviation in outside] == [
            (field, index)
        ]


def test_prescribed_motion_of_the_file_is_the_input():
    """The forces are those of the file's q, v, a; the motion in the file must be the system's."""
    entry = ENTRIES["carnival_ride"]
    times = np.linspace(0.0, 2.0, 6)
    raw = json.loads(json.dumps(recorded(entry, times, replayed(entry, times))), parse_int=float)
    raw["cases"][0]["a"][2][1] += 0.5
    (case,) = read(raw).cases
    found = {d.field: d for d in compare(case, replay_case(entry, case).values) if not d.ok}
    assert set(found) == {"a", "generalized_force", "extras.torque"}
    assert {d.time_index for d in found.values()} == {2}
    # 100 kg at r(0.8 s) = 5.32 m, 0.5 rad/s^2 more: m r^2 theta'' grows by 1415.12 N m.
    torque = 100 * (2 * 5.32 * 0.4 * 3.0 + 5.32**2 * 0.5)
    np.testing.assert_allclose(
        replay_case(entry, case).values["generalized_force"][2, 1], torque, rtol=1e-12
    )


@pytest.mark.full
def test_missing_equilibrium_fails_the_check(tmp_path, capsys):
    """Without a spring the sleeve falls: the file cannot be right."""
    entry = ENTRIES["sleeve_pendulum_equilibrium"]
    raw = recorded(entry, None, replayed(entry, None))
    raw["cases"][0]["params"]["k"] = 0.0
    assert main(["check", written(tmp_path / "wrong.json", raw)]) == 1
    out = capsys.readouterr().out
    assert out.startswith("FAIL  wrong.json")
    assert "ended with implicit_solve_failed; worst" in out


def test_a_right_file_passes(tmp_path, capsys):
    assert main(["check", written(tmp_path / "right.json", harmonic())]) == 0
    line, summary = capsys.readouterr().out.splitlines()
    assert re.fullmatch(
        r"ok +right\.json +base +worst \d\.\de-\d\d of 1e-\d\d in \S+, row \d", line
    )
    assert summary == "files 1, cases 1: all within tolerance"


@pytest.mark.full
@pytest.mark.parametrize(
    "path", list(places(harmonic())), ids=lambda path: ".".join(map(str, path[2:]))
)
def test_a_wrong_number_fails_the_command(path, tmp_path, capsys):
    """Each number of a right file in turn, including the start and the parameters."""
    status = main(["check", written(tmp_path / "wrong.json", nudged(harmonic(), path))])
    out = capsys.readouterr().out
    if path[2] == "error_estimate":
        assert status == 0
        return
    assert status == 1
    assert out.startswith("FAIL  wrong.json")
    assert out.splitlines()[-1] == "files 1, cases 1: 1 out of tolerance"
    is_input = path[2] in ("params", "times") or path[2:4] in (("q", 0), ("v", 0))
    if not is_input:
        field = ".".join(key for key in path[2:] if isinstance(key, str))
        index = next(key for key in path[2:] if isinstance(key, int))
        assert f"in {field}, row {index}; out of tolerance: {field}\n" in out


@pytest.mark.full
def test_other_cases_of_a_known_system_pass(tmp_path):
    """Any parameters, start, times and number of saves: a late start, backward, a single save."""
    variants = [
        harmonic(m=0.2, k=55.0, x0=-1.5, v0=3.0, times=(0.0, 0.5, 0.6, 2.0, 4.0, 6.0)),
        harmonic(times=(7.5, 7.75, 9.0, 11.0, 11.5, 12.0)),
        harmonic(times=(1.0, 0.5, -2.0)),
        harmonic(times=(3.0,)),
    ]
    files = [written(tmp_path / f"{i}.json", raw) for i, raw in enumerate(variants)]
    assert main(["check", *files]) == 0


def test_new_numbers_do_not_compile_again():
    """One compilation per system and number of saves."""
    entry = ENTRIES["mass_spring"]
    (first,) = read(harmonic()).cases
    (second,) = read(harmonic(m=2.0, x0=-0.1, times=(0.0, 0.1, 0.2, 0.5, 0.7, 1.0))).cases

    def compiled():
        return _simulate._simulate.programs(), _check._quantities._cache_size()

    replay_case(entry, first)
    counts = compiled()
    replay_case(entry, second)
    assert compiled() == counts


def test_failed_motion_fails_the_check(tmp_path, capsys):
    """A negative stiffness diverges: the file is right only at its start."""
    raw = harmonic()
    raw["cases"][0]["params"]["k"] = -1e9
    assert main(["check", written(tmp_path / "wrong.json", raw)]) == 1
    assert capsys.readouterr().out.startswith("FAIL  wrong.json")


def test_a_refused_file_does_not_hide_the_others(tmp_path, capsys):
    wrong, nameless = harmonic(), harmonic() | {"system": None}
    wrong["cases"][0]["energy"]["W"] = [0.0] * 6
    files = [
        written(tmp_path / "bad.json", wrong),
        written(tmp_path / "right.json", harmonic()),
        str(tmp_path / "none.json"),
        written(tmp_path / "nameless.json", nameless),
    ]
    assert main(["check", *files]) == 1
    captured = capsys.readouterr()
    first, second, third = captured.err.splitlines()
    assert first.startswith(f"{files[0]}: case 'base': energy must hold known fields only")
    assert second == f"{files[2]}: it must be readable, but No such file or directory."
    assert third == f"{files[3]}: system must be text, but it was None."
    assert captured.out.splitlines()[0].startswith("ok    right.json")
    assert captured.out.splitlines()[-1] == "files 4, cases 1: all within tolerance, 3 refused"
