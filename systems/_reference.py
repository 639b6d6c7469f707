"""Reference files: trajectories of known systems, read strictly.

A file is one JSON object about one system, with a list of cases; a case holds parameters, times,
and one row per time of everything known about the motion. Nothing in a file is passed over:
a field that is not known here is an error, and so is one whose form is not as expected.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from systems._catalogue import UnknownSystem, find
from systems._entry import Entry
from systems._quantities import shapes

SCHEMA = "jaxlag-reference/1"

_FILE_REQUIRED = ("schema", "system", "coordinates", "quasi_velocities", "constraints", "cases")
_FILE_TEXTS = ("book", "notes", "set")
_FILE_OPTIONAL = (*_FILE_TEXTS, "kind", "parameters", "extras")

_ABSENT = {
    "u": "quasi-velocities",
    "lambda": "constraints",
    "constraint_force": "constraints",
}
_CASE_REQUIRED = ("name", "params", "times", "q", "v", "a", *_ABSENT, "energy", "invariants")
_CASE_TEXTS = ("description", "derivation", "error_method")
_CASE_ERROR_RECORDS = (
    "error_estimate",
    "taylor_tolerance_difference",
    "velocity_constraint_residual",
    "position_constraint_residual",
)
_CASE_OPTIONAL = (*_CASE_TEXTS, *_CASE_ERROR_RECORDS, "extras", "controls")


class InvalidReference(ValueError):
    """A reference file that cannot be read, naming the field and what it must be."""


@dataclass(frozen=True)
class Case:
    """One motion of one system.

    Attributes:
        name: its name in the file.
        params: parameter name -> value.
        times: shape (S,), s.
        fields: name of a quantity -> its rows, shape (S, ...); `q` and `v` are among them, and
            their first rows are the start of the motion.
    """

    name: str
    params: dict[str, np.ndarray]
    times: np.ndarray
    fields: dict[str, np.ndarray]


@dataclass(frozen=True)
class Reference:
    """A reference file: a system and its cases."""

    entry: Entry
    cases: tuple[Case, ...]


def load(path: Path) -> Reference:
    """Read the file at `path`; raises `InvalidReference` saying what is wrong with it."""
    try:
        raw = json.loads(
            path.read_text(encoding="utf-8"), parse_int=float, object_pairs_hook=_distinct
        )
    except OSError as error:
        raise InvalidReference(f"it must be readable, but {error.strerror}.") from error
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidReference(f"it must be JSON, but {error}.") from error
    return read(raw)


def read(raw: Any) -> Reference:
    """Read a parsed file; raises `InvalidReference` saying what is wrong with it."""
    _check_fields("the file", raw, _FILE_REQUIRED, _FILE_OPTIONAL)
    if raw["schema"] != SCHEMA:
        _fail("schema", f"be {SCHEMA!r}", f"it was {raw['schema']!r}")
    for field in ("system", *_FILE_TEXTS):
        _check_text(field, raw.get(field))
    try:
        entry = find(raw["system"])
    except UnknownSystem as error:
        raise InvalidReference(str(error)) from error
    kind = raw.get("kind", "trajectory")
    if not isinstance(kind, str) or kind not in _CASE_READERS:
        kinds = ", ".join(map(repr, _CASE_READERS))
        _fail("kind", f"be one that this version replays ({kinds})", f"it was {kind!r}")
    if raw["coordinates"] != list(entry.coordinates):
        _fail("coordinates", f"be {list(entry.coordinates)}", f"it was {raw['coordinates']!r}")
    for field in ("quasi_velocities", "constraints"):
        if raw[field] != []:
            _fail(field, f"be [], for {entry.name} has none", f"it was {raw[field]!r}")
    _check_texts("parameters", raw.get("parameters", {}), entry.parameter_units)
    _check_texts("extras", raw.get("extras", {}), _members(entry, "extras"))
    if not isinstance(raw["cases"], list) or not raw["cases"]:
        _fail("cases", "be a list of at least one case", f"it was {raw['cases']!r}")
    read_case = _CASE_READERS[kind]
    return Reference(
        entry, tuple(read_case(entry, index, case) for index, case in enumerate(raw["cases"]))
    )


def read_trajectory(entry: Entry, index: int, raw: Any) -> Case:
    """Read case number `index`, a motion from its first row on."""
    where = f"case {index}"
    _check_fields(where, raw, _CASE_REQUIRED, _CASE_OPTIONAL)
    if not isinstance(raw["name"], str):
        _fail(f"{where}: name", "be text", f"it was {raw['name']!r}")
    where = f"case {raw['name']!r}"
    for field in _CASE_TEXTS:
        _check_text(f"{where}: {field}", raw.get(field))
    _check_controls(f"{where}: controls", raw.get("controls"))
    for field, things in _ABSENT.items():
        if raw[field] is not None:
            must = f"be null, for {entry.name} has no {things}"
            _fail(f"{where}: {field}", must, f"it was {_shown(raw[field])}")

    times = _numbers(f"{where}: times", raw["times"])
    steps = np.diff(times) if times.ndim == 1 and times.size else None
    if steps is None or not (np.all(steps > 0) or np.all(steps < 0)):
        must = "be a list of times that only rise or only fall"
        _fail(f"{where}: times", must, f"it was {_shown(raw['times'])}")
    return Case(
        name=raw["name"],
        params=_read_params(where, entry, raw["params"]),
        times=times,
        fields=_read_rows(where, entry, raw, len(times)),
    )


_CASE_READERS: dict[str, Callable[[Entry, int, Any], Case]] = {"trajectory": read_trajectory}


def _read_params(where: str, entry: Entry, raw: Any) -> dict[str, np.ndarray]:
    _check_fields(f"{where}: params", raw, tuple(entry.parameter_units))
    params = {}
    for name, example in entry.example.params.items():
        value = _numbers(f"{where}: params.{name}", raw[name])
        if value.shape != np.shape(example):
            must = f"have shape {np.shape(example)}"
            _fail(f"{where}: params.{name}", must, f"it had {value.shape}")
        params[name] = value
    return params


def _read_rows(where: str, entry: Entry, raw: Any, count: int) -> dict[str, np.ndarray]:
    """Every quantity that the case holds, each with `count` rows of the system's own shape."""
    given = {field: raw[field] for field in ("q", "v", "a")}
    for group, required in {"energy": ("T", "V", "E"), "extras": (), "invariants": ()}.items():
        members = raw.get(group, {})
        known = _members(entry, group)
        _check_fields(f"{where}: {group}", members, required, known)
        given |= {f"{group}.{name}": value for name, value in members.items()}

    fields = {}
    for field, value in given.items():
        rows = _numbers(f"{where}: {field}", value)
        shape = (count, *shapes(entry)[field])
        if rows.shape == (count,) and shape == (count, 1):
            rows = rows.reshape(shape)  # a vector of one component may stand as a plain number
        if rows.shape != shape:
            must = f"have shape {shape}, one row for each of {count} times"
            _fail(f"{where}: {field}", must, f"it had {rows.shape}")
        fields[field] = rows
    return fields


def _members(entry: Entry, group: str) -> tuple[str, ...]:
    """Names of the quantities in one group (energy, extras, invariants)."""
    prefix = f"{group}."
    return tuple(name.removeprefix(prefix) for name in shapes(entry) if name.startswith(prefix))


def _numbers(where: str, raw: Any) -> np.ndarray:
    """A number or a nested list of numbers, all finite, as an array."""
    for place, leaf in _leaves(where, raw):
        if not isinstance(leaf, float) or not math.isfinite(leaf):
            _fail(place, "be a finite number", f"it was {leaf!r}")
    try:
        return np.array(raw, dtype=np.float64)
    except ValueError:
        _fail(where, "have rows of equal length", f"it was {_shown(raw)}")


def _leaves(where: str, raw: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(raw, list):
        for index, item in enumerate(raw):
            yield from _leaves(f"{where}[{index}]", item)
    else:
        yield where, raw


def _check_fields(
    where: str, raw: Any, required: tuple[str, ...], optional: Iterable[str] = ()
) -> None:
    if not isinstance(raw, dict):
        _fail(where, "be an object", f"it was {_shown(raw)}")
    known = dict.fromkeys((*required, *optional))
    for name in raw:
        if name not in known:
            names = ", ".join(known) or "nothing"
            _fail(where, f"hold known fields only ({names})", f"it held {name!r}")
    for name in required:
        if name not in raw:
            _fail(where, f"hold {name!r}", f"it held {', '.join(raw) or 'nothing'}")


def _check_text(where: str, raw: Any) -> None:
    if raw is not None and not isinstance(raw, str):
        _fail(where, "be text or null", f"it was {_shown(raw)}")


def _check_texts(where: str, raw: Any, known: Iterable[str]) -> None:
    _check_fields(where, raw, (), known)
    for name, text in raw.items():
        _check_text(f"{where}.{name}", text)


def _check_controls(where: str, raw: Any) -> None:
    """What the applied forces are, in words: their numbers are in `params`."""
    if isinstance(raw, dict):
        _check_texts(where, raw, raw)
    else:
        _check_text(where, raw)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of the file, whose names must differ."""
    result: dict[str, Any] = {}
    for name, value in pairs:
        if name in result:
            raise InvalidReference(f"it must have distinct fields, but {name!r} stands twice.")
        result[name] = value
    return result


def _shown(raw: Any) -> str:
    text = repr(raw)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _fail(where: str, must: str, was: str) -> NoReturn:
    raise InvalidReference(f"{where} must {must}, but {was}.")
