"""The systems of this package by name."""

from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from importlib import import_module
from types import ModuleType

from systems.catalogue import chapter2, chapter3, chapter4, classics
from systems.catalogue._entry import AbstractEntry as AbstractEntry
from systems.catalogue._entry import Chart as Chart
from systems.catalogue._entry import Entry as Entry
from systems.catalogue._entry import Example as Example
from systems.catalogue._entry import PrescribedEntry as PrescribedEntry
from systems.catalogue._entry import StaticEntry as StaticEntry

_PACKAGES = {
    name: chapter.__name__
    for chapter in (chapter2, chapter3, chapter4, classics)
    for name in chapter.SYSTEMS
}


def module(name: str) -> ModuleType:
    """The module of the system called `name`; raises `KeyError` if there is none."""
    return import_module(f"{_PACKAGES[name]}.{name}")


class _Entries(Mapping[str, AbstractEntry]):
    """Entries by name; a module is imported when its entry is asked for."""

    def __getitem__(self, name: str) -> AbstractEntry:
        return module(name).entry

    def __iter__(self) -> Iterator[str]:
        return iter(_PACKAGES)

    def __len__(self) -> int:
        return len(_PACKAGES)


ENTRIES: Mapping[str, AbstractEntry] = _Entries()
"""Name -> entry, in the order of the book; systems that are not in the book come last."""


class UnknownSystem(LookupError):
    """No system of this package has this name."""


def find(name: str) -> AbstractEntry:
    """The entry called `name`; raises `UnknownSystem` with the nearest names."""
    if name in ENTRIES:
        return ENTRIES[name]
    near = get_close_matches(name, ENTRIES, n=3)
    hint = f"Did you mean {' or '.join(near)}?" if near else f"Known: {', '.join(ENTRIES)}."
    raise UnknownSystem(f"system must be the name of a known system, but it was {name!r}. {hint}")
