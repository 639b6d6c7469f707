"""Strict reading of JSON: numbers, texts and objects whose fields are all known."""

import math
from collections.abc import Iterable, Iterator
from typing import Any, NoReturn

import numpy as np


class InvalidReference(ValueError):
    """A reference file cannot be read; the message names the field and the requirement."""


def numbers(where: str, raw: Any) -> np.ndarray:
    """A number or a nested list of numbers, all finite, as an array."""
    for place, leaf in _leaves(where, raw):
        if not isinstance(leaf, float) or not math.isfinite(leaf):
            fail(place, "be a finite number", f"it was {leaf!r}")
    try:
        return np.array(raw, dtype=np.float64)
    except ValueError:
        fail(where, "have rows of equal length", f"it was {shown(raw)}")


def _leaves(where: str, raw: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(raw, list):
        for index, item in enumerate(raw):
            yield from _leaves(f"{where}[{index}]", item)
    else:
        yield where, raw


def check_fields(
    where: str, raw: Any, required: tuple[str, ...], optional: Iterable[str] = ()
) -> None:
    """Raise unless `raw` is an object with all required fields and no unknown ones."""
    if not isinstance(raw, dict):
        fail(where, "be an object", f"it was {shown(raw)}")
    known = dict.fromkeys((*required, *optional))
    for name in raw:
        if name not in known:
            names = ", ".join(known) or "nothing"
            fail(where, f"hold known fields only ({names})", f"it held {name!r}")
    for name in required:
        if name not in raw:
            fail(where, f"hold {name!r}", f"it held {', '.join(raw) or 'nothing'}")


def check_text(where: str, raw: Any) -> None:
    """Raise unless `raw` is text or null."""
    if raw is not None and not isinstance(raw, str):
        fail(where, "be text or null", f"it was {shown(raw)}")


def check_texts(where: str, raw: Any, known: Iterable[str]) -> None:
    """Raise unless `raw` is an object of texts under known names."""
    check_fields(where, raw, (), known)
    for name, text in raw.items():
        check_text(f"{where}.{name}", text)


def distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of the file; its names must be distinct."""
    result: dict[str, Any] = {}
    for name, value in pairs:
        if name in result:
            raise InvalidReference(f"it must have distinct fields, but {name!r} stands twice.")
        result[name] = value
    return result


def shown(raw: Any) -> str:
    """`raw` as text for a message."""
    text = repr(raw)
    return text if len(text) <= 80 else f"{text[:77]}..."


def fail(where: str, must: str, was: str) -> NoReturn:
    """Raise an error that names the field, the requirement and the value."""
    raise InvalidReference(f"{where} must {must}, but {was}.")
