"""The systems of this package by name."""

from collections.abc import Mapping
from difflib import get_close_matches
from types import MappingProxyType

from systems.catalogue._entry import AbstractEntry
from systems.catalogue.chapter2 import (
    carnival_ride,
    disk_on_shaft,
    lamina_double_pendulum,
    lamina_on_parabola,
    lamina_two_forces,
    lamina_two_forces_fixed_direction,
    pendulum_bob_energy,
    physical_pendulum_three_origins,
    rotating_body_on_frame,
    rotating_slender_rod,
    two_link_robot_arm,
    two_link_robot_arm_inverse,
)
from systems.catalogue.chapter3 import (
    atwood_machine,
    atwood_multipliers,
    cart_pendulum,
    central_motion,
    disk_on_moving_cart,
    double_pendulum,
    double_pendulum_cartesian,
    double_pendulum_forces,
    double_pendulum_rayleigh,
    double_pendulum_static_load,
    falling_stick,
    falling_stick_friction,
    falling_stick_multiplier,
    hockey_puck,
    hockey_puck_cord,
    knife_edge_vehicle,
    link_spring_mass_equilibrium,
    mass_spring,
    mass_spring_dashpot,
    particle_on_surface,
    pinned_body_reactions,
    quadcopter,
    rolling_ball_no_spin,
    rolling_wheel_curved_path,
    rotating_cylinder_disk,
    simple_pendulum,
    sleeve_pendulum,
    sleeve_pendulum_equilibrium,
    spherical_pendulum_cartesian,
    spherical_pendulum_elastic,
    spherical_pendulum_fixed,
    spherical_pendulum_varying,
    symmetric_plane_pendulum,
    two_carts_spring,
    two_mass_three_springs,
)
from systems.catalogue.chapter4 import (
    body_axis_translation,
    euler_rotational_equations,
    quadcopter_body_axes,
    rigid_aircraft,
    rigid_body_roll_pitch_yaw,
    tricycle,
    tricycle_book_lagrangian,
)
from systems.catalogue.classics import (
    chaplygin_ball,
    chaplygin_sleigh,
    four_bar,
    heavy_symmetric_top,
    knife_edge_incline,
    n_link_loop,
    nonholonomic_particle,
    rolling_ball_turntable,
    rolling_disk,
    slider_crank,
    snakeboard,
    suslov,
    torque_free_asymmetric_top,
    vertical_rolling_disk,
)

_MODULES = (
    rotating_body_on_frame,
    disk_on_shaft,
    physical_pendulum_three_origins,
    lamina_two_forces,
    lamina_two_forces_fixed_direction,
    lamina_double_pendulum,
    lamina_on_parabola,
    rotating_slender_rod,
    two_link_robot_arm,
    two_link_robot_arm_inverse,
    carnival_ride,
    pendulum_bob_energy,
    spherical_pendulum_fixed,
    spherical_pendulum_cartesian,
    spherical_pendulum_varying,
    spherical_pendulum_elastic,
    particle_on_surface,
    knife_edge_vehicle,
    double_pendulum_cartesian,
    rolling_ball_no_spin,
    rolling_wheel_curved_path,
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
    link_spring_mass_equilibrium,
    cart_pendulum,
    rotating_cylinder_disk,
    disk_on_moving_cart,
    two_carts_spring,
    hockey_puck,
    hockey_puck_cord,
    symmetric_plane_pendulum,
    pinned_body_reactions,
    atwood_machine,
    atwood_multipliers,
    falling_stick,
    falling_stick_multiplier,
    falling_stick_friction,
    central_motion,
    rigid_body_roll_pitch_yaw,
    tricycle,
    tricycle_book_lagrangian,
    body_axis_translation,
    euler_rotational_equations,
    rigid_aircraft,
    quadcopter_body_axes,
    slider_crank,
    four_bar,
    n_link_loop,
    chaplygin_sleigh,
    knife_edge_incline,
    nonholonomic_particle,
    vertical_rolling_disk,
    rolling_disk,
    rolling_ball_turntable,
    chaplygin_ball,
    snakeboard,
    suslov,
    torque_free_asymmetric_top,
    heavy_symmetric_top,
)

ENTRIES: Mapping[str, AbstractEntry] = MappingProxyType(
    {module.entry.name: module.entry for module in _MODULES}
)
"""Name -> entry, in the order of the book; what is not in it last."""


class UnknownSystem(LookupError):
    """A name that no system of this package bears."""


def find(name: str) -> AbstractEntry:
    """The entry called `name`; raises `UnknownSystem` with the nearest names."""
    if name in ENTRIES:
        return ENTRIES[name]
    near = get_close_matches(name, ENTRIES, n=3)
    hint = f"Did you mean {' or '.join(near)}?" if near else f"Known: {', '.join(ENTRIES)}."
    raise UnknownSystem(f"system must be the name of a known system, but it was {name!r}. {hint}")
