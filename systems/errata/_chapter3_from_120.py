"""Errata of chapter 3 from eq. 3.120 on, in the order of the book."""

import jax
import jax.numpy as jnp
from numpy import array, cos, sin

import jaxlag as jl
from jaxlag import energy
from systems.catalogue.chapter3 import (
    central_motion,
    disk_on_moving_cart,
    double_pendulum_forces,
    falling_stick,
    falling_stick_multiplier,
    hockey_puck_cord,
    rotating_cylinder_disk,
    sleeve_pendulum,
)
from systems.errata._erratum import Erratum, State, around, around_example, motion, rate

# Double pendulum under two forces.


def _pulls(s: State, *names: str):
    return double_pendulum_forces.system.generalized_force(s.q, s.v, s.params, t=s.t, names=names)


def _Q2(s: State, sign: int):
    l2, Fx, Fy = s.values("l2", "Fx", "Fy")
    return cos(s.params["Omega"] * s.t) * l2 * (Fx * cos(s.q[1]) + sign * Fy * sin(s.q[1]))


def _joint_by_theta1(s: State):
    unit = jnp.array([1.0, 0.0])
    return energy.velocity(double_pendulum_forces.joint, s.t, s.q, unit, s.params)


def _joint_derivative(s: State, sign: int):
    return s.params["l1"] * array([cos(s.q[0]), sign * sin(s.q[0])])


def _joint_moment(s: State, sign: int):
    return array(s.values("Bx", "By")) @ _joint_derivative(s, sign)


# Disk spinning on a rod that turns about the vertical.


def _steady(rod: float):
    """The rod, of mass `rod`, held level by a pivot, without gravity, both rates steady."""
    params = {**rotating_cylinder_disk.entry.example.params, "m1": rod}
    params |= dict.fromkeys(("tau_z0", "tau_b", "g"), 0.0)
    return around(params, (0.0, 0.0, 0.0), dq=(0.4, 0.0, 0.4), dv=(3.0, 0.0, 3.0), da=0.0)


def _support_torque(s: State):
    return rotating_cylinder_disk.system.multipliers(s.q, s.v, s.params, t=s.t)["level"]


def _momentum_about_vertical(s: State):
    return rotating_cylinder_disk.system.momentum(s.q, s.v, s.params, t=s.t)[0]


def _disk_inertia(s: State):
    m2, length, Iz = s.values("m2", "l", "Iz")
    return Iz + m2 * length**2


# Disk on a moving cart: the Lagrangian from its springs and positions.


def _cart_lagrangian(s: State):
    K1, K2 = s.values("K1", "K2")
    T = disk_on_moving_cart.system.kinetic(s.q, s.v, s.params, t=s.t)
    return T - energy.spring(K1, s.q[1:]) - energy.spring(K2, s.q[:1])


def _cart_formula(s: State, sign: int):
    m0, m, theta, K1, K2 = s.values("m0", "m", "theta", "K1", "K2")
    (X, x1), (X_rate, x1_rate) = s.q, s.v
    disk = X_rate**2 + 2 * X_rate * x1_rate * cos(theta) + 1.5 * x1_rate**2
    return 0.5 * (m0 * X_rate**2 + m * disk - K1 * x1**2 + sign * K2 * X**2)


def _disk_momentum(s: State, spin: float):
    m, theta = s.values("m", "theta")
    return m * s.v[0] * cos(theta) + m * s.v[1] + spin


# Sleeve on a rod.


def _sleeve_end(t, q, params):
    return (q[0] + 0.5 * params["L2"]) * jnp.stack([jnp.sin(q[1]), -jnp.cos(q[1])])


def _sleeve_force(t, q, v, params):
    return jnp.stack([params["F0"] * jnp.cos(params["omega"] * t), jnp.zeros_like(t)])


_SLEEVE = jl.System(
    coordinates=("x1", "theta"),
    kinetic=sleeve_pendulum.kinetic,
    potential=sleeve_pendulum.potential,
    forces=(jl.PointForce(_sleeve_end, _sleeve_force, "force"),),
)


def _sleeve_moment(s: State, arm: float):
    return arm * s.params["F0"] * cos(s.params["omega"] * s.t) * cos(s.q[1])


# Falling stick on rough ground: first the moment of a given friction, then the motion.


def _contact(t, q, params):
    x, y, theta = q
    half = 0.5 * params["L"]
    return jnp.stack([x - half * jnp.cos(theta), y - half * jnp.sin(theta)])


def _ground_force(t, q, v, params):
    return params["N"] * jnp.stack([params["mu"], jnp.ones_like(params["mu"])])


_STICK = jl.System(
    coordinates=("x", "y", "theta"),
    kinetic=falling_stick_multiplier.kinetic,
    potential=falling_stick_multiplier.potential,
    forces=(jl.PointForce(_contact, _ground_force, "ground"),),
)
"""The stick without ground, with the ground's force (mu N, N) at its lower end."""

_sliding = around({"m": 0.5, "L": 1.0, "g": 9.81, "mu": 0.3, "N": 4.0}, (0.0, 1.0))


def _stick(t, q, params):
    """(x, y, theta) of the stick on the ground."""
    return jnp.concatenate([falling_stick.center(t, q, params), q[1:]])


def _friction_moment(s: State):
    """Generalized force of the friction on theta."""
    q = _stick(s.t, s.q, s.params)
    rough, smooth = s.params, {**s.params, "mu": 0.0 * s.params["mu"]}
    Q, Q_smooth = (_STICK.generalized_force(q, jnp.zeros(3), p) for p in (rough, smooth))
    return (Q - Q_smooth)[2]


def _sliding_acceleration(s: State):
    """(x_c'', theta'') for which the ground's force (mu N, N) is the only applied force."""

    def missing(unknown):
        a, N = unknown[:2], unknown[2]
        return jl.inverse_dynamics(_STICK, *motion(_stick, s, a), {**s.params, "N": N})

    start = jnp.zeros(3)  # the equations are linear
    return -jnp.linalg.solve(jax.jacfwd(missing)(start), missing(start))[:2]


def _sliding_formula(s: State, mu: float):
    """(x_c'', theta'') with the moment of a friction coefficient `mu` in the second."""
    m, L, g = s.values("m", "L", "g")
    c, sine, w = cos(s.q[1]), sin(s.q[1]), s.v[1]
    lever = c - mu * sine
    inertia = m * L**2 / 12 + 0.25 * m * L**2 * c * lever
    theta_acceleration = -0.5 * L * lever * (m * g - 0.5 * m * L * w**2 * sine) / inertia
    N = m * g + 0.5 * m * L * (theta_acceleration * c - w**2 * sine)
    return [s.params["mu"] * N / m, theta_acceleration]


# Spherical pendulum on a string of given length L(t), driven and damped.


def _swinging(t, q, params):
    length = params["L0"] + params["L1"] * jnp.sin(params["Omega"] * t)
    across = jnp.sin(q[1])
    direction = jnp.cos(q[0]) * across, jnp.sin(q[0]) * across, -jnp.cos(q[1])
    return length * jnp.stack(direction)


def _swinging_weight(t, q, params):
    g = jnp.array([0.0, 0.0, -params["g"]])
    return energy.gravity(params["m"], _swinging(t, q, params), g)


_VARYING = jl.System(
    coordinates=("theta", "phi"),
    kinetic=lambda t, q, v, params: energy.particles(_swinging, params["m"], t, q, v, params),
    potential=_swinging_weight,
    forces=(
        jl.GeneralizedForce(
            lambda t, q, v, params: jnp.stack([params["tau"], jnp.zeros_like(t)]), "drive"
        ),
        jl.Rayleigh(lambda t, q, v, params: 0.5 * params["c"] * v[1] ** 2, "drag"),
    ),
)

_varying = around(
    {"m": 0.5, "g": 9.81, "L0": 1.0, "L1": 0.2, "Omega": 3.0, "tau": 0.8, "c": 0.4}, (0.0, 1.2)
)


def _swinging_power(s: State):
    return rate(
        lambda t, q, v: _VARYING.energy(q, v, s.params, t=t),
        s,
        _VARYING.acceleration(s.q, s.v, s.params, t=s.t),
    )


def _length(s: State):
    """L and its first two derivatives."""
    L0, L1, Omega = s.values("L0", "L1", "Omega")
    beat, other = sin(Omega * s.t), cos(Omega * s.t)
    return L0 + L1 * beat, L1 * Omega * other, -L1 * Omega**2 * beat


def _turning(s: State):
    return s.v[1] ** 2 + (s.v[0] * sin(s.q[1])) ** 2


def _explicit_power(s: State):
    """-dL/dt at fixed (q, v)."""
    L, L_rate, L_acceleration = _length(s)
    m, g = s.values("m", "g")
    return -m * L_rate * (L_acceleration + L * _turning(s) + g * cos(s.q[1]))


def _swinging_energy(s: State, sign: int):
    """T_2 + sign T_0 + V."""
    L, L_rate, _ = _length(s)
    m, g = s.values("m", "g")
    return 0.5 * m * (L**2 * _turning(s) + sign * L_rate**2) - m * g * L * cos(s.q[1])


# Central motion.


def _radial_momentum_rate(s: State):
    system = central_motion.system
    a = system.acceleration(s.q, s.v, s.params, t=s.t)
    return rate(lambda t, q, v: system.momentum(q, v, s.params, t=t), s, a)[0]


def _radial_formula(s: State, divisor: float):
    m, K, c = s.values("m", "K", "c")
    r = s.q[0]
    p_phi = m * r**2 * s.v[1]
    return p_phi**2 / (divisor * m * r**3) - K / r**2 - c * r


ERRATA = (
    Erratum(
        place="3.133, Q2 of the double pendulum under forces",
        wrong="-Fy l2 sin(theta2) for +",
        draw=around_example(double_pendulum_forces.entry),
        engine=lambda s: _pulls(s, "end force")[1],
        printed=lambda s: _Q2(s, -1),
        right=lambda s: _Q2(s, +1),
    ),
    Erratum(
        place="Ch. 3, Example 10, remarks 1-2, derivative of the joint by theta1",
        wrong="-l1 sin(theta1) J for +",
        draw=around_example(double_pendulum_forces.entry),
        engine=_joint_by_theta1,
        printed=lambda s: _joint_derivative(s, -1),
        right=lambda s: _joint_derivative(s, +1),
    ),
    Erratum(
        place="Ch. 3, Example 10, remarks 1-2, Q of the force on the joint",
        wrong="-By l1 sin(theta1) for +",
        draw=around_example(double_pendulum_forces.entry),
        engine=lambda s: _pulls(s, "joint force")[0],
        printed=lambda s: _joint_moment(s, -1),
        right=lambda s: _joint_moment(s, +1),
    ),
    Erratum(
        place="3.141, H_z of the disk on the rod",
        wrong="omega_x for omega_z in the third row",
        draw=_steady(0.0),
        engine=_momentum_about_vertical,
        printed=lambda s: _disk_inertia(s) * s.v[1],
        right=lambda s: _disk_inertia(s) * s.v[0],
    ),
    Erratum(
        place="Ch. 3, Example 11, angular momentum about O of rod and disk",
        wrong="without the rod's m1 l^2/3 Omega",
        draw=_steady(0.9),
        engine=_momentum_about_vertical,
        printed=lambda s: _disk_inertia(s) * s.v[0],
        right=lambda s: (_disk_inertia(s) + s.params["m1"] * s.params["l"] ** 2 / 3) * s.v[0],
    ),
    Erratum(
        place="3.143, torque on the rod that holds it level",
        wrong="(Iy - Iz - m2 l^2) Omega omega1 for Iy Omega omega1",
        draw=_steady(0.9),
        engine=_support_torque,
        printed=lambda s: -(s.params["Iy"] - _disk_inertia(s)) * s.v[0] * s.v[2],
        right=lambda s: -s.params["Iy"] * s.v[0] * s.v[2],
    ),
    Erratum(
        place="Ch. 3, Example 12, item 2(a), L of disk and cart",
        wrong="+1/2 K2 X^2 for -1/2 K2 X^2",
        draw=around_example(disk_on_moving_cart.entry),
        engine=_cart_lagrangian,
        printed=lambda s: _cart_formula(s, +1),
        right=lambda s: _cart_formula(s, -1),
    ),
    Erratum(
        place="Ch. 3, Example 12, dL/dx1' of disk and cart",
        wrong="1/2 + m x1' for 1/2 m x1'",
        draw=around_example(disk_on_moving_cart.entry),
        engine=lambda s: disk_on_moving_cart.system.momentum(s.q, s.v, s.params, t=s.t)[1],
        printed=lambda s: _disk_momentum(s, 0.5 + s.params["m"] * s.v[1]),
        right=lambda s: _disk_momentum(s, 0.5 * s.params["m"] * s.v[1]),
    ),
    Erratum(
        place="3.159-3.160, moment of the force on the sleeve",
        wrong="arm x1 for x1 + L2/2",
        draw=around_example(sleeve_pendulum.entry),
        engine=lambda s: _SLEEVE.generalized_force(s.q, s.v, s.params, t=s.t)[1],
        printed=lambda s: _sleeve_moment(s, s.q[0]),
        right=lambda s: _sleeve_moment(s, s.q[0] + 0.5 * s.params["L2"]),
    ),
    Erratum(
        place="Secs. 3.11-3.12, pull of an unwinding cord",
        wrong="turns with the puck",
        draw=around_example(hockey_puck_cord.entry),
        engine=lambda s: hockey_puck_cord.system.generalized_force(s.q, s.v, s.params, t=s.t)[1:],
        printed=lambda s: s.params["F1"] * array([cos(s.q[0]), sin(s.q[0])]),
        right=lambda s: s.params["F1"] * array([cos(s.params["gamma"]), sin(s.params["gamma"])]),
    ),
    Erratum(
        place="3.175-3.176, Q of the friction on the stick's angle",
        wrong="0 for mu N (L/2) sin(theta)",
        draw=_sliding,
        engine=_friction_moment,
        printed=lambda s: 0.0,
        right=lambda s: s.params["mu"] * s.params["N"] * 0.5 * s.params["L"] * sin(s.q[1]),
    ),
    Erratum(
        place="3.176-3.177, accelerations of the stick with friction",
        wrong="theta'' of smooth ground",
        draw=_sliding,
        engine=_sliding_acceleration,
        printed=lambda s: _sliding_formula(s, 0.0),
        right=lambda s: _sliding_formula(s, s.params["mu"]),
    ),
    Erratum(
        place="3.194, dH/dt with applied and dissipative forces",
        wrong="without v.Q - v.dR/dv",
        draw=_varying,
        engine=_swinging_power,
        printed=_explicit_power,
        right=lambda s: _explicit_power(s) + s.params["tau"] * s.v[0] - s.params["c"] * s.v[1] ** 2,
    ),
    Erratum(
        place="3.207, H of a rheonomic system",
        wrong="T + V for T_2 - T_0 + V",
        draw=_varying,
        engine=lambda s: _VARYING.energy(s.q, s.v, s.params, t=s.t),
        printed=lambda s: _swinging_energy(s, +1),
        right=lambda s: _swinging_energy(s, -1),
    ),
    Erratum(
        place="Ch. 3, Example 19, p_r' of central motion",
        wrong="p_phi^2/(2 m r^3) for p_phi^2/(m r^3)",
        draw=around_example(central_motion.entry),
        engine=_radial_momentum_rate,
        printed=lambda s: _radial_formula(s, 2.0),
        right=lambda s: _radial_formula(s, 1.0),
    ),
)

TEXT_ONLY = (
    ("3.125", "= 0 is missing"),
    ("Ch. 3, Example 12", "theta is both the slope and the disk's angle of roll"),
    ("Ch. 3, Example 12, items (h) and (p)", "omega_z = -x1'/R and x1 = R theta differ in sign"),
    ("Ch. 3, Example 12, item (q)", "omega_z^2 = is left unfinished"),
    ("Ch. 3, Example 13, V", "parentheses are not balanced"),
    ("3.159-3.160", "the axes change: I is downward and J horizontal here"),
    ("Sec. 3.12, item 9 of the list", "dV/dq1 is dV/dq2 (both are 0)"),
    ("Ch. 3, Example 15", "R is both the pin's reaction and the arm in R x F"),
    (
        "Ch. 3, Example 16",
        "the moments of the tensions cancel for the system as a whole only: with a massive "
        "pulley T1 and T2 differ",
    ),
    ("Ch. 3, Example 17", "m x_c is m x_c'' = 0"),
    ("3.178", "the q_i are coordinates, not generalized velocities"),
    ("3.201", "dt is missing in the last term"),
    ("3.203-3.204", "the second q1' is q2'"),
    ("3.206", "the sum runs to n, not N"),
    ("Ch. 3, Example 18", "H is written in theta1'; the canonical equations need it in p"),
)
