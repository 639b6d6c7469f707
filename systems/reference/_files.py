"""Reference files: motions and states of rest of known systems, read strictly.

A file is one JSON object about one system, with a list of cases. A case holds parameters and all
known results for them. Nothing in a file is ignored: an unknown field is an error, and so is a
field with an unexpected form.
"""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from systems.catalogue import UnknownSystem, find
from systems.catalogue._entry import AbstractEntry
from systems.reference._cases import Case, members, read_case
from systems.reference._json_fields import (
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
_OPTIONAL = (*_TEXTS, "kind", "parameters", "extras", "coordinates_redundant")


@dataclass(frozen=True)
class Reference:
    """A reference file: a system and its cases."""

    entry: AbstractEntry
    cases: tuple[Case, ...]


def load(path: Path) -> Reference:
    """Read the file at `path`; raises `InvalidReference` with the error found."""
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
    """Read a parsed file; raises `InvalidReference` with the error found."""
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
    _check_coordinates(raw, entry)
    quasi = list(entry.quasi_velocities)
    if raw["quasi_velocities"] != quasi:
        must = f"be {quasi}" if quasi else f"be [], for {entry.name} has none"
        fail("quasi_velocities", must, f"it was {raw['quasi_velocities']!r}")
    _check_constraints(raw["constraints"], entry)
    check_texts("parameters", raw.get("parameters", {}), entry.parameter_units)
    check_texts("extras", raw.get("extras", {}), members(entry, "extras"))
    if not isinstance(raw["cases"], list) or not raw["cases"]:
        fail("cases", "be a list of at least one case", f"it was {raw['cases']!r}")
    cases = tuple(read_case(entry, index, case) for index, case in enumerate(raw["cases"]))
    return Reference(entry, tuple(_numbered(cases)))


def _numbered(cases: tuple[Case, ...]) -> Iterator[Case]:
    """The cases with unique names: repeated names are numbered."""
    seen = Counter[str]()
    for case in cases:
        seen[case.name] += 1
        count = seen[case.name]
        yield case if count == 1 else replace(case, name=f"{case.name} ({count})")


def _check_coordinates(raw: Any, entry: AbstractEntry) -> None:
    """Check the coordinates of the file, and those of the system if it has more."""
    own, every = list(entry.file_coordinates), list(entry.coordinates)
    if raw["coordinates"] != own:
        fail("coordinates", f"be {own}", f"it was {raw['coordinates']!r}")
    redundant = raw.get("coordinates_redundant", every)
    if "coordinates_redundant" in raw and own == every:
        must = f"be left out, for {entry.name} has none"
        fail("coordinates_redundant", must, f"it was {redundant!r}")
    if redundant != every:
        fail("coordinates_redundant", f"be {every}", f"it was {redundant!r}")


def _check_constraints(raw: Any, entry: AbstractEntry) -> None:
    """Check the texts that describe the constraint rows: one for each, in order."""
    rows = entry.file_constraints
    texts = isinstance(raw, list) and all(isinstance(text, str) for text in raw)
    if texts and len(raw) == len(rows):
        return
    must = f"be a list of {len(rows)} texts, one for each of {', '.join(rows)}"
    if not rows:
        must = f"be [], for {entry.name} has none{' in its files' if entry.constraints else ''}"
    fail("constraints", must, f"it was {shown(raw)}")
