"""Two starts of every system that moves: that of its example, and one with more energy.

If the system can be chaotic, the second motion is: `jl.lyapunov` finds an exponent above three of
its standard errors. Otherwise (one degree of freedom, linear, integrable, short motion) it only has
more energy. Spans are short enough that errors grow less than a million times. With constraints
the values are guesses, which are replaced by the nearest consistent state.
"""

from typing import NamedTuple

from systems.catalogue import ENTRIES, Entry


class Start(NamedTuple):
    """The start of a motion, q0 in m or rad and v0 per s, and its duration, s."""

    name: str
    q0: tuple[float, ...]
    v0: tuple[float, ...]
    duration: float


# For examples whose start must be assembled.
_ASSEMBLED = {
    "four_bar": ((1.0, 0.4, -1.86), (9.0, -1.18, 3.29)),
    "n_link_loop": ((-1.89, -0.2, -0.73, 0.26, 0.76, 1.06), (0.0,) * 6),
}

_CHAOTIC: dict[str, tuple] = {
    "double_pendulum": ((1.6, 0.8), (-2.1, 0.4), 8.0),
    "lamina_double_pendulum": ((1.3, -0.4), (-2.1, 0.4), 12.0),
    "double_pendulum_cartesian": ((1.1, -0.2, 1.4, -0.6), (0.2, 0.1, -1.2, -0.1), 6.0),
    "sleeve_pendulum": ((2.2, 1.7), (0.4, 0.0), 9.0),
    "lamina_on_parabola": ((-0.6, 0.9, 0.5), (0.0, 0.1, -0.4), 8.0),
    "double_pendulum_forces": ((-2.6, -1.2), (0.0, 0.0), 7.0),
    "two_link_robot_arm": ((-1.7, -2.5), (0.4, -0.7), 9.0),
    "n_link_loop": (
        (-1.9, 0.5, -2.3, 1.3, -0.2, 0.2),
        (-0.3, -0.8, 0.4, -0.8, -1.5, -1.2),
        3.0,
    ),
}

_ENERGETIC: dict[str, tuple] = {
    "rotating_body_on_frame": ((0.0, 1.2), (2.0, 4.0), 5.0),
    "disk_on_shaft": ((0.0, 0.5), (1.5, 20.0), 10.0),
    "physical_pendulum_three_origins": ((0.5,), (8.0,), 6.0),
    "lamina_two_forces": ((0.3, -0.2, 0.5), (1.0, 0.5, 1.5), 6.0),
    "lamina_two_forces_fixed_direction": ((0.0, 0.0, 0.5), (1.0, 0.5, -1.0), 6.0),
    "rotating_slender_rod": ((0.0, 1.0), (4.0, 2.0), 6.0),
    "pendulum_bob_energy": ((0.5,), (8.0,), 5.0),
    "spherical_pendulum_fixed": ((0.0, 0.8), (3.0, 1.5), 8.0),
    "spherical_pendulum_cartesian": ((0.6, 0.0, -0.8), (1.0, 3.0, 0.0), 8.0),
    "spherical_pendulum_varying": ((1.0, 0.0, 1.5), (0.3, 2.5, 1.0), 8.0),
    "spherical_pendulum_elastic": ((1.2, 0.0, 1.5), (0.5, 1.0, 1.0), 6.0),
    "particle_on_surface": ((0.5, 0.2, 0.1), (1.0, 1.5, 0.3), 6.0),
    "knife_edge_vehicle": ((0.0, 0.0, 0.3), (1.5, 0.5, -2.0), 6.0),
    "rolling_ball_no_spin": ((0.0, 0.0, 0.0, 0.0, 0.0), (0.5, -0.4, 0.3, 0.5, 2.0), 6.0),
    "rolling_wheel_curved_path": ((0.0, 0.0, 0.3, 0.0), (2.0, 0.6, 1.5, 8.0), 6.0),
    "mass_spring": ((1.0,), (-3.0,), 5.0),
    "two_mass_three_springs": ((0.5, -0.3), (1.0, -2.0), 12.0),
    "simple_pendulum": ((0.5,), (8.0,), 8.0),
    "double_pendulum_rayleigh": ((2.5, 2.0), (1.0, -2.0), 12.0),
    "quadcopter": ((0.0, 0.0, 2.0, 0.3, -0.4, 0.2), (1.0, -1.0, 0.5, 0.8, -0.5, 0.6), 2.0),
    "mass_spring_dashpot": ((0.5,), (-2.0,), 12.0),
    "cart_pendulum": ((0.5, 2.5), (1.0, 2.0), 10.0),
    "rotating_cylinder_disk": ((0.0, 0.3, 0.2), (2.5, 0.5, -15.0), 5.0),
    "disk_on_moving_cart": ((0.2, -0.5), (1.0, 2.0), 12.0),
    "two_carts_spring": ((0.0, 1.5), (1.0, -2.0), 8.0),
    "hockey_puck": ((0.5, 0.0, 0.0), (-4.0, 0.5, 0.5), 3.0),
    "hockey_puck_cord": ((0.5, 0.0, 0.0), (-4.0, 0.5, 0.3), 3.0),
    "symmetric_plane_pendulum": ((0.5,), (8.0,), 6.0),
    "pinned_body_reactions": ((0.4, 0.0, 1.57), (0.0, 0.0, 9.0), 6.0),
    "atwood_machine": ((0.2,), (1.5,), 4.0),
    "atwood_multipliers": ((0.0, 0.0, 0.0), (2.0, -2.0, 20.0), 4.0),
    "falling_stick": ((0.0, 1.0), (0.5, -2.0), 0.5),
    "falling_stick_multiplier": ((0.0, 0.42, 1.0), (0.5, -0.5, -2.0), 0.5),
    "falling_stick_friction": ((0.0, 0.42, 1.0), (-0.5, -0.3, -1.0), 0.3),
    "central_motion": ((1.0, 0.0), (0.5, 3.0), 12.0),
    "rigid_body_roll_pitch_yaw": ((0.5, -0.5, 1.0), (1.5, -0.8, 1.2), 2.0),
    "tricycle": ((0.0, 0.0, 0.3, 0.2), (2.0, 0.5, 0.5, 0.2), 5.0),
    "tricycle_book_lagrangian": ((0.0, 0.0, 0.2, 0.1), (0.9, 0.1, 0.1, 0.1), 2.0),
    "body_axis_translation": ((0.0, 0.0, 0.0), (3.0, -2.0, 1.0), 8.0),
    "euler_rotational_equations": ((0.5, -0.4, 1.0), (1.5, 0.6, -1.2), 4.0),
    "rigid_aircraft": ((0.0, 0.0, -100.0, 0.3, -0.2, 1.0), (25.0, -5.0, 3.0, -0.5, 0.4, 0.3), 2.0),
    "quadcopter_body_axes": (
        (0.0, 0.0, -10.0, -0.3, 0.4, 1.0),
        (2.0, -1.0, 1.0, -0.8, 0.5, -0.6),
        1.5,
    ),
    "slider_crank": ((1.57, -0.64, 0.4), (15.0, 0.0, -4.5), 2.0),
    "four_bar": ((1.0, 0.4, -1.86), (18.0, -2.36, 6.58), 2.0),
    "chaplygin_sleigh": ((0.0, 0.0, 0.5), (-2.0, -1.0, 1.5), 8.0),
    "knife_edge_incline": ((0.0, 0.0, 0.3), (2.0, 0.6, 3.0), 8.0),
    "nonholonomic_particle": ((0.0, -0.5, 0.3), (2.0, 1.5, -1.0), 5.0),
    "vertical_rolling_disk": ((0.0, 0.0, 0.0, 0.3), (2.0, 0.5, 7.0, 1.5), 5.0),
    "rolling_disk": ((0.0, 0.0, 0.3, 0.9, 0.0), (1.5, 0.3, 1.0, 0.5, -5.0), 5.0),
    "rolling_ball_turntable": ((0.2, 0.1, 0.3, 0.2, 0.1), (0.3, 0.2, 4.0, 1.0, 0.5), 1.0),
    "chaplygin_ball": ((0.0, 0.0, 0.3, 0.2, 0.1), (0.4, -0.2, 0.8, 1.6, -1.0), 1.5),
    "snakeboard": ((0.0, 0.0, 0.2, 0.3, 0.2), (0.0, 0.0, 0.0, 2.5, 0.833), 10.0),
    "suslov": ((0.2, 0.3, 0.1), (-1.5, 0.9, 0.3), 5.0),
    "torque_free_asymmetric_top": ((0.5, 0.4, 0.2), (0.3, 2.0, 0.3), 20.0),
    "heavy_symmetric_top": ((0.0, 0.7, 0.0), (1.0, 3.0, 20.0), 2.0),
}


def _of_example(entry: Entry) -> Start:
    example = entry.example
    q0, v0 = _ASSEMBLED.get(entry.name, (example.q0, example.v0))
    return Start("regular", tuple(q0), tuple(v0), example.duration)


def _second(name: str) -> Start:
    if name in _CHAOTIC:
        return Start("chaotic", *_CHAOTIC[name])
    return Start("energetic", *_ENERGETIC[name])


STARTS: dict[str, tuple[Start, Start]] = {
    name: (_of_example(entry), _second(name))
    for name, entry in ENTRIES.items()
    if isinstance(entry, Entry)
}
