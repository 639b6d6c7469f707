"""The systems of this package by name."""

from difflib import get_close_matches
from types import MappingProxyType

from systems import (
    cart_pendulum,
    central_motion,
    double_pendulum,
    double_pendulum_rayleigh,
    mass_spring,
    mass_spring_dashpot,
    rotating_slender_rod,
    simple_pendulum,
    sleeve_pendulum,
    two_mass_three_springs,
)
from systems._entry import Entry

_MODULES = (
    rotating_slender_rod,
    mass_spring,
    two_mass_three_springs,
    simple_pendulum,
    double_pendulum,
    double_pendulum_rayleigh,
    mass_spring_dashpot,
    sleeve_pendulum,
    cart_pendulum,
    central_motion,
)

ENTRIES = MappingProxyType({module.entry.name: module.entry for module in _MODULES})
"""Name -> entry, in the order of the book."""


class UnknownSystem(LookupError):
    """A name that no system of this package bears."""


def find(name: str) -> Entry:
    """The entry called `name`; raises `UnknownSystem` with the nearest names."""
    if name in ENTRIES:
        return ENTRIES[name]
    near = get_close_matches(name, ENTRIES, n=3)
    hint = f"Did you mean {' or '.join(near)}?" if near else f"Known: {', '.join(ENTRIES)}."
    raise UnknownSystem(f"system must be the name of a known system, but it was {name!r}. {hint}")
