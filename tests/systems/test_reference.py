"""Reference files are read strictly: every deviation from the format is a named error."""

import copy
import json
import re

import numpy as np
import pytest
from _files import harmonic, recorded

from systems.catalogue import ENTRIES
from systems.reference._check import replay, replay_rest
from systems.reference._files import load, read
from systems.reference._json_fields import InvalidReference

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


def test_valid_file_is_read_unchanged():
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


def test_optional_fields_may_be_present_or_absent():
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


def test_vector_of_one_component_may_be_plain_numbers():
    raw = as_parsed(harmonic())
    column = read(raw).cases[0].fields["extras.p_dot"]
    raw["cases"][0]["extras"]["p_dot"] = [value[0] for value in column.tolist()]
    np.testing.assert_array_equal(read(raw).cases[0].fields["extras.p_dot"], column)


NUMBERS = [0.5] * 6
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
    (("color",), "red", "the file must hold known fields only (schema, system, coordinates,"),
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
    (
        (*CASE, "energy", "W"),
        NUMBERS,
        "energy must hold known fields only (T, V, E), but it held 'W'.",
    ),
    ((*CASE, "energy"), NUMBERS, "case 'base': energy must be an object, but it was [0.5, "),
    ((*CASE, "energy", "E"), COLUMN, "energy.E must have shape (6,), one row for each of 6 times"),
    (
        (*CASE, "extras", "F"),
        NUMBERS,
        "extras must hold known fields only (H, p, p_dot), but it held",
    ),
    (
        (*CASE, "invariants", "E"),
        NUMBERS,
        "invariants must hold known fields only (nothing), but it",
    ),
]


def test_repeated_names_are_numbered():
    raw = as_parsed(harmonic())
    raw["cases"] *= 3
    raw["cases"][1] = raw["cases"][1] | {"name": "other"}
    assert [case.name for case in read(raw).cases] == ["base", "other", "base (2)"]


@pytest.mark.parametrize(("place", "value", "message"), REFUSED)
def test_deviation_is_refused_by_name(place, value, message):
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


# ---- Constraints ---------------------------------------------------------------------------------


def of(name):
    """A file of the entry's example with a single save, as parsed."""
    entry = ENTRIES[name]
    start = [x[entry.file_columns] for x in entry.start()] if entry.kind == "trajectory" else []
    params = {name: np.asarray(x) for name, x in entry.example.params.items()}
    times = np.zeros(1)
    motion = replay(entry, params, times, *start) if start else replay_rest(entry, params)
    return as_parsed(recorded(entry, times, motion))


@pytest.fixture(scope="module")
def files(lowering):
    names = (
        *("double_pendulum_cartesian", "falling_stick_friction", "link_spring_mass_equilibrium"),
        *("chaplygin_sleigh", "heavy_symmetric_top"),
    )
    return {name: of(name) for name in names}


@pytest.mark.full
def test_multipliers_and_reactions_have_the_order_of_the_rows(files):
    raw = files["double_pendulum_cartesian"]
    assert raw["constraints"] == ["string1", "string2"]
    (case,) = read(raw).cases
    assert case.fields["lambda"].shape == (1, 2)
    assert case.fields["constraint_force"].shape == (1, 4)


@pytest.mark.full
def test_quasi_velocities_include_vanishing_ones_in_order(files):
    raw = files["chaplygin_sleigh"]
    assert raw["quasi_velocities"] == ["v", "v_n", "omega"]
    assert raw["constraints"] == ["v_n"]
    (case,) = read(raw).cases
    assert case.fields["u"].shape == (1, 3)
    assert case.fields["lambda"].shape == (1, 1)
    (case,) = read(files["heavy_symmetric_top"]).cases
    assert case.fields["u"].shape == (1, 3)
    assert "lambda" not in case.fields


def test_a_file_may_be_written_in_independent_coordinates(files):
    """It then contains no constraints, and no fields of all coordinates."""
    raw = files["falling_stick_friction"]
    assert raw["coordinates"] == ["x_c", "theta"]
    assert raw["constraints"] == []
    (case,) = read(raw).cases
    assert {name: values.shape for name, values in case.fields.items()} == {
        **dict.fromkeys("qva", (1, 2)),
        **dict.fromkeys(("energy.T", "energy.V", "energy.E"), (1,)),
        **dict.fromkeys(("extras.N", "extras.friction", "extras.contact_point_velocity_x"), (1,)),
    }


def test_equilibrium_may_name_its_coordinates(files):
    raw = files["link_spring_mass_equilibrium"]
    assert raw["coordinates"] == ["theta"]
    for more in ({}, {"coordinates_redundant": ["x", "y", "theta"]}):
        (case,) = read(raw | more).cases
        names = {"x", "y", "theta", "lambda1", "lambda2", "spring_force", "d2V_dtheta2"}
        assert set(case.fields) == names


SLEIGH = "chaplygin_sleigh"
STRINGS = "double_pendulum_cartesian"
STICK = "falling_stick_friction"
LINK = "link_spring_mass_equilibrium"


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        (
            STRINGS,
            ("constraints",),
            ["one"],
            "constraints must be a list of 2 texts, one for each of string1, string2, but it was",
        ),
        (STRINGS, ("constraints",), [1.0, 2.0], "constraints must be a list of 2 texts, one for"),
        (STRINGS, (*CASE, "lambda"), None, "lambda must be a finite number, but it was None."),
        (STRINGS, (*CASE, "lambda"), [[1.0]], "lambda must have shape (1, 2), one row for each of"),
        (
            STRINGS,
            (*CASE, "constraint_force"),
            [[1.0, 2.0]],
            "constraint_force must have shape (1, 4), one row for each of 1 times, but it had",
        ),
        (
            STRINGS,
            ("coordinates_redundant",),
            ["x1", "y1", "x2", "y2"],
            "coordinates_redundant must be left out, for double_pendulum_cartesian has none, but",
        ),
        (
            STICK,
            ("coordinates",),
            ["x_c", "y_c", "theta"],
            "coordinates must be ['x_c', 'theta'], but it was ['x_c', 'y_c', 'theta'].",
        ),
        (
            STICK,
            ("constraints",),
            ["ground"],
            "constraints must be [], for falling_stick_friction has none in its files, but it was",
        ),
        (
            STICK,
            (*CASE, "lambda"),
            [[1.0]],
            "lambda must be null, for falling_stick_friction has no constraints in its files, but",
        ),
        (
            STICK,
            (*CASE, "extras", "H"),
            [1.0],
            "extras must hold known fields only (N, contact_point_velocity_x, friction), but it",
        ),
        (
            LINK,
            ("coordinates_redundant",),
            ["x", "y"],
            "coordinates_redundant must be ['x', 'y', 'theta'], but it was ['x', 'y'].",
        ),
        (
            LINK,
            (*CASE, "q"),
            [0.7],
            "must hold known fields only (name, params, d2V_dtheta2, lambda1, lambda2, ",
        ),
        (
            SLEIGH,
            ("quasi_velocities",),
            ["v", "omega"],
            "quasi_velocities must be ['v', 'v_n', 'omega'], but it was ['v', 'omega'].",
        ),
        (SLEIGH, ("quasi_velocities",), [], "quasi_velocities must be ['v', 'v_n', 'omega'], but"),
        (SLEIGH, (*CASE, "u"), None, "u must be a finite number, but it was None."),
        (
            SLEIGH,
            (*CASE, "u"),
            [[1.0, 2.0]],
            "u must have shape (1, 3), one row for each of 1 times, but it had (1, 2).",
        ),
        (LINK, (*CASE, "lambda2"), None, "lambda2[0] must be a finite number, but it was None."),
    ],
)
def test_deviation_under_constraints_is_refused_by_name(name, place, value, message, files):
    raw = copy.deepcopy(files[name])
    *parents, last = place
    target = raw
    for key in parents:
        target = target[key]
    target[last] = value
    with pytest.raises(InvalidReference, match=re.escape(message)):
        read(raw)
