"""The systems of this package by name."""

from collections.abc import Mapping
from difflib import get_close_matches
from types import MappingProxyType

from systems import (
    atwood_machine,
    carnival_ride,
    cart_pendulum,
    central_motion,
    disk_on_moving_cart,
    disk_on_shaft,
    double_pendulum,
    double_pendulum_forces,
    double_pendulum_rayleigh,
    double_pendulum_static_load,
    falling_stick,
    hockey_puck,
    hockey_puck_cord,
    lamina_double_pendulum,
    lamina_two_forces,
    lamina_two_forces_fixed_direction,
    mass_spring,
    mass_spring_dashpot,
    pendulum_bob_energy,
    physical_pendulum_three_origins,
    quadcopter,
    rotating_body_on_frame,
    rotating_slender_rod,
    simple_pendulum,
    sleeve_pendulum,
    sleeve_pendulum_equilibrium,
    spherical_pendulum_elastic,
    spherical_pendulum_fixed,
    symmetric_plane_pendulum,
    two_carts_spring,
    two_link_robot_arm,
    two_link_robot_arm_inverse,
    two_mass_three_springs,
)
from systems._entry import AbstractEntry

_MODULES = (
    rotating_body_on_frame,
    disk_on_shaft,
    physical_pendulum_three_origins,
    lamina_two_forces,
    lamina_two_forces_fixed_direction,
    lamina_double_pendulum,
    rotating_slender_rod,
    two_link_robot_arm,
    two_link_robot_arm_inverse,
    carnival_ride,
    pendulum_bob_energy,
    spherical_pendulum_fixed,
    spherical_pendulum_elastic,
    mass_spring,
    two_mass_three_springs,
    simple_pendulum,
    double_pendulum,
    double_pendulum_forces,
    double_pendulum_static_load,
    double_pendulum_rayleigh,
    quadcopter,
    mass_spring_dashpot,
    sleeve_pendulum,
    sleeve_pendulum_equilibrium,
    cart_pendulum,
    disk_on_moving_cart,
    two_carts_spring,
    hockey_puck,
    hockey_puck_cord,
    symmetric_plane_pendulum,
    atwood_machine,
    falling_stick,
    central_motion,
)

ENTRIES: Mapping[str, AbstractEntry] = MappingProxyType(
    {module.entry.name: module.entry for module in _MODULES}
)
"""Name -> entry, in the order of the book."""


class UnknownSystem(LookupError):
    """A name that no system of this package bears."""


def find(name: str) -> AbstractEntry:
    """The entry called `name`; raises `UnknownSystem` with the nearest names."""
    if name in ENTRIES:
        return ENTRIES[name]
    near = get_close_matches(name, ENTRIES, n=3)
    hint = f"Did you mean {' or '.join(near)}?" if near else f"Known: {', '.join(ENTRIES)}."
    raise UnknownSystem(f"system must be the name of a known system, but it was {name!r}. {hint}")
