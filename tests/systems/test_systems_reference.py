"""Reference files are read strictly: every departure from the format is a named error."""

import copy
import json
import re

import numpy as np
import pytest
from _files import harmonic

from systems._fields import InvalidReference
from systems._reference import load, read

CASE = ("cases", 0)


def changed(place, value):
    """The harmonic file with `value` at `place`, a path of keys."""
    raw = harmonic()
    *parents, last = place
    target = raw
    for key in parents:
        target = target[key]
    target[last] = value
    return as_parsed(raw)


def without(place):
    raw = changed(place, None)
    *parents, last = place
    target = raw
    for key in parents:
        target = target[key]
    del target[last]
    return raw


def as_parsed(raw):
    """As `load` parses it: every number a float."""
    return json.loads(json.dumps(raw), parse_int=float)


def test_a_good_file_is_read_as_it_stands():
    raw = as_parsed(harmonic())
    reference = read(copy.deepcopy(raw))
    (case,) = reference.cases
    assert reference.entry.name == "mass_spring"
    assert case.name == "base"
    assert case.params == {"m": 1.3, "k": 20.0}
    np.testing.assert_array_equal(case.fields["energy.T"], raw["cases"][0]["energy"]["T"])
    assert set(case.fields) == {
        *("q", "v", "a", "energy.T", "energy.V", "energy.E"),
        *("extras.H", "extras.p", "extras.p_dot"),
    }


def test_optional_fields_may_stand_and_may_be_absent():
    for place in [
        (*CASE, "extras"),
        (*CASE, "extras", "H"),
        (*CASE, "description"),
        (*CASE, "error_estimate"),
    ]:
        read(without(place))
    for place, value in [
        (("kind",), "trajectory"),
        (("book",), None),
        (("notes",), "any text"),
        (("parameters",), {"m": "kg", "k": "N/m"}),
        (("extras",), {"H": "energy", "p": "momentum"}),
        ((*CASE, "controls"), None),
        ((*CASE, "controls"), "no applied force"),
        ((*CASE, "controls"), {"force": "none"}),
        ((*CASE, "taylor_tolerance_difference"), None),
        ((*CASE, "velocity_constraint_residual"), 1e-15),
    ]:
        read(changed(place, value))


def test_a_vector_of_one_component_may_stand_as_plain_numbers():
    raw = as_parsed(harmonic())
    column = read(raw).cases[0].fields["extras.p_dot"]
    raw["cases"][0]["extras"]["p_dot"] = [row[0] for row in column.tolist()]
    np.testing.assert_array_equal(read(raw).cases[0].fields["extras.p_dot"], column)


ROW = [0.5] * 6
COLUMN = [[0.5]] * 6

REFUSED = [
    (("schema",), "jaxlag/2", "schema must be 'jaxlag-reference/1', but it was 'jaxlag/2'."),
    (("system",), "mass_sprin", "but it was 'mass_sprin'. Did you mean mass_spring"),
    (("system",), 3, "system must be text, but it was 3.0."),
    (("system",), None, "system must be text, but it was None."),
    (("kind",), "static", "kind must be 'trajectory', as mass_spring is, but it was 'static'."),
    (("kind",), [], "kind must be 'trajectory', as mass_spring is, but it was []."),
    (("coordinates",), ["y"], "coordinates must be ['x'], but it was ['y']."),
    (("quasi_velocities",), ["u"], "quasi_velocities must be [], for mass_spring has none, but"),
    (("constraints",), ["f"], "constraints must be [], for mass_spring has none, but"),
    (("colour",), "red", "the file must hold known fields only (schema, system, coordinates,"),
    (("notes",), 3, "notes must be text or null, but it was 3.0."),
    (
        ("parameters",),
        {"b": "kg"},
        "parameters must hold known fields only (m, k), but it held 'b'",
    ),
    (("parameters",), {"m": 2}, "parameters.m must be text or null, but it was 2.0."),
    (("extras",), {"F": ""}, "extras must hold known fields only (H, p, p_dot), but it held 'F'."),
    (("cases",), [], "cases must be a list of at least one case, but it was []."),
    (CASE, 3, "case 0 must be an object, but it was 3.0."),
    ((*CASE, "name"), 3, "case 0: name must be text, but it was 3.0."),
    ((*CASE, "w"), COLUMN, "case 0 must hold known fields only (name, params, times, q, v, a, u,"),
    (
        (*CASE, "description"),
        [1],
        "case 'base': description must be text or null, but it was [1.0]",
    ),
    ((*CASE, "controls"), {"F": 3}, "controls.F must be text or null, but it was 3.0."),
    ((*CASE, "controls"), [1], "controls must be text or null, but it was [1.0]."),
    ((*CASE, "u"), COLUMN, "u must be null, for mass_spring has no quasi-velocities, but it was"),
    ((*CASE, "lambda"), COLUMN, "lambda must be null, for mass_spring has no constraints, but"),
    ((*CASE, "constraint_force"), COLUMN, "constraint_force must be null, for mass_spring has"),
    ((*CASE, "params", "b"), 1, "params must hold known fields only (m, k), but it held 'b'."),
    ((*CASE, "params", "m"), [1], "params.m must have shape (), but it had (1,)."),
    ((*CASE, "params", "m"), "1", "params.m must be a finite number, but it was '1'."),
    ((*CASE, "params", "m"), True, "params.m must be a finite number, but it was True."),
    ((*CASE, "times"), [0, 0, 1], "times must be a list of times that only rise or only fall, but"),
    ((*CASE, "times"), [0, 1, 0], "times must be a list of times that only rise or only fall, but"),
    ((*CASE, "times"), [], "times must be a list of times that only rise or only fall, but"),
    ((*CASE, "times"), 3, "times must be a list of times that only rise or only fall, but"),
    ((*CASE, "times"), COLUMN, "times must be a list of times that only rise or only fall, but"),
    ((*CASE, "q"), COLUMN[:5], "q must have shape (6, 1), one row for each of 6 times, but it had"),
    ((*CASE, "v"), [[0.5, 1.0]] * 6, "v must have shape (6, 1), one row for each of 6 times, but"),
    ((*CASE, "a"), [[0.5], 0.5], "a must have rows of equal length, but it was [[0.5], 0.5]."),
    ((*CASE, "a"), None, "case 'base': a must be a finite number, but it was None."),
    ((*CASE, "q", 3, 0), np.nan, "case 'base': q[3][0] must be a finite number, but it was nan."),
    ((*CASE, "energy", "T", 2), np.inf, "energy.T[2] must be a finite number, but it was inf."),
    ((*CASE, "energy", "W"), ROW, "energy must hold known fields only (T, V, E), but it held 'W'."),
    ((*CASE, "energy"), ROW, "case 'base': energy must be an object, but it was [0.5, "),
    ((*CASE, "energy", "E"), COLUMN, "energy.E must have shape (6,), one row for each of 6 times"),
    ((*CASE, "extras", "F"), ROW, "extras must hold known fields only (H, p, p_dot), but it held"),
    ((*CASE, "invariants", "E"), ROW, "invariants must hold known fields only (nothing), but it"),
]


def test_cases_have_names_of_their_own():
    raw = as_parsed(harmonic())
    raw["cases"] *= 2
    with pytest.raises(
        InvalidReference, match="cases must have distinct names, but 2 were called 'base'"
    ):
        read(raw)
    raw["cases"] = [raw["cases"][0], raw["cases"][1] | {"name": "other"}]
    assert [case.name for case in read(raw).cases] == ["base", "other"]


@pytest.mark.parametrize(("place", "value", "message"), REFUSED)
def test_a_departure_is_refused_by_name(place, value, message):
    with pytest.raises(InvalidReference, match=re.escape(message)):
        read(changed(place, value))


@pytest.mark.parametrize(
    "place",
    [(name,) for name in harmonic() if name != "kind"]
    + [
        (*CASE, name)
        for name in ("params", "times", "q", "v", "a", "u", "lambda", "constraint_force")
    ]
    + [(*CASE, "energy"), (*CASE, "energy", "V"), (*CASE, "invariants"), (*CASE, "params", "k")],
)
def test_a_missing_field_is_named(place):
    with pytest.raises(InvalidReference, match=rf"must hold '{place[-1]}', but it held "):
        read(without(place))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "it must be JSON, but Expecting value: line 1 column 1"),
        (b'{"schema": "jaxlag', "it must be JSON, but Unterminated string"),
        (b"\xff\xfe\x00", "it must be JSON, but 'utf-8' codec can't decode"),
        (b"[" * 100_000, "it must be JSON, but maximum recursion depth"),
        (b'{"a": 1, "a": 2}', "it must have distinct fields, but 'a' stands twice"),
        (b"[1, 2]", "the file must be an object, but it was [1.0, 2.0]"),
    ],
)
def test_a_malformed_file_is_refused(content, message, tmp_path):
    path = tmp_path / "file.json"
    path.write_bytes(content)
    with pytest.raises(InvalidReference, match=re.escape(message)):
        load(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InvalidReference, match="it must be readable, but No such file"):
        load(tmp_path / "none.json")
    with pytest.raises(InvalidReference, match="it must be readable, but Is a directory"):
        load(tmp_path)
