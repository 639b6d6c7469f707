"""The cases of a reference file, read strictly; their contents depend on the kind of system."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import numpy as np

from systems.catalogue._entry import AbstractEntry, Entry, PrescribedEntry, StaticEntry
from systems.reference._json_fields import (
    check_fields,
    check_text,
    check_texts,
    fail,
    numbers,
    shown,
)
from systems.reference._quantities import shapes

_MOTION = ("q", "v", "a")
_REACTIONS = ("lambda", "constraint_force")
_TEXTS = ("description", "derivation", "error_method")
_ERROR_RECORDS = (
    "error_estimate",
    "taylor_tolerance_difference",
    "velocity_constraint_residual",
    "position_constraint_residual",
)
_OPTIONAL = (*_TEXTS, *_ERROR_RECORDS)


@dataclass(frozen=True)
class Case:
    """One motion, prescribed motion or state of rest of one system.

    Attributes:
        name: its name in the file.
        params: parameter name -> value.
        times: shape (S,), s; for a state of rest a single 0.
        fields: name of a quantity -> its values, shape (S, ...). For a motion the first values of
            `q` and `v` are the start; for a prescribed one `q`, `v` and `a` are the motion.
    """

    name: str
    params: dict[str, np.ndarray]
    times: np.ndarray
    fields: dict[str, np.ndarray]


@singledispatch
def read_case(entry: AbstractEntry, index: int, raw: Any) -> Case:
    """Read case number `index` of a file of this system."""
    raise NotImplementedError(f"cases of {entry.kind} systems cannot be read")


@read_case.register
def _(entry: Entry, index: int, raw: Any) -> Case:
    absent = {} if entry.quasi_velocities else {"u": "quasi-velocities"}
    if not entry.file_constraints:
        things = "constraints in its files" if entry.constraints else "constraints"
        absent |= dict.fromkeys(_REACTIONS, things)
    fields = tuple(field for field in (*_MOTION, "u", *_REACTIONS) if field not in absent)
    required = ("name", "params", "times", *_MOTION, "u", *_REACTIONS, "energy", "invariants")
    where = _begin(index, raw, required, (*_OPTIONAL, "extras", "controls"))
    _check_controls(f"{where}: controls", raw.get("controls"))
    for field, things in absent.items():
        if raw[field] is not None:
            must = f"be null, for {entry.name} has no {things}"
            fail(f"{where}: {field}", must, f"it was {shown(raw[field])}")
    groups = {"energy": ("T", "V", "E"), "extras": (), "invariants": ()}
    given = {field: raw[field] for field in fields} | _grouped(where, entry, raw, groups)
    return _case(where, entry, raw, _read_times(where, raw["times"]), given)


@read_case.register
def _(entry: StaticEntry, index: int, raw: Any) -> Case:
    values = tuple(shapes(entry))
    where = _begin(index, raw, ("name", "params", *values), _OPTIONAL)
    return _case(where, entry, raw, np.zeros(1), {name: [raw[name]] for name in values})


@read_case.register
def _(entry: PrescribedEntry, index: int, raw: Any) -> Case:
    required = ("name", "params", "times", *_MOTION, "generalized_force")
    where = _begin(index, raw, required, (*_OPTIONAL, "extras"))
    given = {field: raw[field] for field in (*_MOTION, "generalized_force")}
    given |= _grouped(where, entry, raw, {"extras": ()})
    return _case(where, entry, raw, _read_times(where, raw["times"]), given)


def members(entry: AbstractEntry, group: str) -> tuple[str, ...]:
    """Names of the quantities in one group (energy, extras, invariants)."""
    prefix = f"{group}."
    return tuple(name.removeprefix(prefix) for name in shapes(entry) if name.startswith(prefix))


def _begin(index: int, raw: Any, required: tuple[str, ...], optional: tuple[str, ...]) -> str:
    """Check names and texts of a case; return its name for messages."""
    where = f"case {index}"
    check_fields(where, raw, required, optional)
    if not isinstance(raw["name"], str):
        fail(f"{where}: name", "be text", f"it was {raw['name']!r}")
    where = f"case {raw['name']!r}"
    for field in _TEXTS:
        check_text(f"{where}: {field}", raw.get(field))
    return where


def _case(
    where: str, entry: AbstractEntry, raw: Any, times: np.ndarray, given: Mapping[str, Any]
) -> Case:
    return Case(
        name=raw["name"],
        params=_read_params(where, entry, raw["params"]),
        times=times,
        fields=_read_values(where, entry, given, len(times)),
    )


def _read_times(where: str, raw: Any) -> np.ndarray:
    times = numbers(f"{where}: times", raw)
    steps = np.diff(times) if times.ndim == 1 and times.size else None
    if steps is None or not (np.all(steps > 0) or np.all(steps < 0)):
        must = "be a list of times that only rise or only fall"
        fail(f"{where}: times", must, f"it was {shown(raw)}")
    return times


def _read_params(where: str, entry: AbstractEntry, raw: Any) -> dict[str, np.ndarray]:
    check_fields(f"{where}: params", raw, tuple(entry.parameter_units))
    params = {}
    for name, example in entry.example.params.items():
        value = numbers(f"{where}: params.{name}", raw[name])
        if value.shape != np.shape(example):
            must = f"have shape {np.shape(example)}"
            fail(f"{where}: params.{name}", must, f"it had {value.shape}")
        params[name] = value
    return params


def _grouped(
    where: str, entry: AbstractEntry, raw: Any, groups: Mapping[str, tuple[str, ...]]
) -> dict[str, Any]:
    """`group.name` -> value of every quantity in one of the groups."""
    given = {}
    for group, required in groups.items():
        values = raw.get(group, {})
        check_fields(f"{where}: {group}", values, required, members(entry, group))
        given |= {f"{group}.{name}": value for name, value in values.items()}
    return given


def _read_values(
    where: str, entry: AbstractEntry, given: Mapping[str, Any], count: int
) -> dict[str, np.ndarray]:
    """Every quantity of the case, with `count` values of the shape that the system defines."""
    fields = {}
    for field, value in given.items():
        values = numbers(f"{where}: {field}", value)
        shape = (count, *shapes(entry)[field])
        if values.shape == (count,) and shape == (count, 1):
            values = values.reshape(shape)  # a vector of one component may be a plain number
        if values.shape != shape:
            must = f"have shape {shape}, one row for each of {count} times"
            fail(f"{where}: {field}", must, f"it had {values.shape}")
        fields[field] = values
    return fields


def _check_controls(where: str, raw: Any) -> None:
    """Check the texts that describe the applied forces; their values are in `params`."""
    if isinstance(raw, dict):
        check_texts(where, raw, raw)
    else:
        check_text(where, raw)
