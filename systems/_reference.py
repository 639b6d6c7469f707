"""Reference files: motions and states of rest of known systems, read strictly.

A file is one JSON object about one system, with a list of cases; a case holds parameters and
everything known about what they lead to. Nothing in a file is passed over: a field that is not
known here is an error, and so is one whose form is not as expected.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from systems._cases import Case, members, read_case
from systems._catalogue import UnknownSystem, find
from systems._entry import AbstractEntry
from systems._fields import (
    InvalidReference,
    check_fields,
    check_text,
    check_texts,
    distinct,
    fail,
    shown,
)

SCHEMA = "jaxlag-reference/1"

_REQUIRED = ("schema", "system", "coordinates", "quasi_velocities", "constraints", "cases")
_TEXTS = ("book", "notes", "set")
_OPTIONAL = (*_TEXTS, "kind", "parameters", "extras")


@dataclass(frozen=True)
class Reference:
    """A reference file: a system and its cases."""

    entry: AbstractEntry
    cases: tuple[Case, ...]


def load(path: Path) -> Reference:
    """Read the file at `path`; raises `InvalidReference` saying what is wrong with it."""
    try:
        raw = json.loads(
            path.read_text(encoding="utf-8"), parse_int=float, object_pairs_hook=distinct
        )
    except OSError as error:
        raise InvalidReference(f"it must be readable, but {error.strerror}.") from error
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidReference(f"it must be JSON, but {error}.") from error
    return read(raw)


def read(raw: Any) -> Reference:
    """Read a parsed file; raises `InvalidReference` saying what is wrong with it."""
    check_fields("the file", raw, _REQUIRED, _OPTIONAL)
    if raw["schema"] != SCHEMA:
        fail("schema", f"be {SCHEMA!r}", f"it was {raw['schema']!r}")
    for field in _TEXTS:
        check_text(field, raw.get(field))
    if not isinstance(raw["system"], str):
        fail("system", "be text", f"it was {shown(raw['system'])}")
    try:
        entry = find(raw["system"])
    except UnknownSystem as error:
        raise InvalidReference(str(error)) from error
    kind = raw.get("kind", "trajectory")
    if kind != entry.kind:
        fail("kind", f"be {entry.kind!r}, as {entry.name} is", f"it was {kind!r}")
    if raw["coordinates"] != list(entry.coordinates):
        fail("coordinates", f"be {list(entry.coordinates)}", f"it was {raw['coordinates']!r}")
    for field in ("quasi_velocities", "constraints"):
        if raw[field] != []:
            fail(field, f"be [], for {entry.name} has none", f"it was {raw[field]!r}")
    check_texts("parameters", raw.get("parameters", {}), entry.parameter_units)
    check_texts("extras", raw.get("extras", {}), members(entry, "extras"))
    if not isinstance(raw["cases"], list) or not raw["cases"]:
        fail("cases", "be a list of at least one case", f"it was {raw['cases']!r}")
    cases = tuple(read_case(entry, index, case) for index, case in enumerate(raw["cases"]))
    names = [case.name for case in cases]
    for name in names:
        if names.count(name) > 1:
            fail("cases", "have distinct names", f"{names.count(name)} were called {name!r}")
    return Reference(entry, cases)
