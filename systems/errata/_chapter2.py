"""Errata of chapter 2, in the order of the book."""

import jax.numpy as jnp
from numpy import array, cos, hypot, sin

import jaxlag as jl
from systems.catalogue.chapter2 import (
    carnival_ride,
    lamina_double_pendulum,
    lamina_two_forces,
    lamina_two_forces_fixed_direction,
    physical_pendulum_three_origins,
    rotating_slender_rod,
)
from systems.errata._erratum import Erratum, State, around, around_example, motion

FREE_FALL = 9.81
"""g [m/s^2] in which the book gives accelerations."""


# Physical pendulum: a rigid body seen from origin (3), x downward and y to the right.


def _pendulum_pose(t, q, params):
    center = _pendulum_center(params)
    R = jl.rotation.about_z(q[0] - jnp.arctan2(center[1], center[0]))
    return R, R @ (center - jnp.array([params["xb"], params["yb"], 0.0]))


def _pendulum_center(params):
    r, alpha = params["r"], params["alpha"]
    along = params["xb"] - r * jnp.sin(alpha), params["yb"] - r * jnp.cos(alpha)
    return jnp.array([*along, 0.0])


def _pendulum_lagrangian(s: State):
    M, Ic, xb, yb, g = s.values("M", "Ic", "xb", "yb", "g")
    inertia = (0.0, 0.0, Ic + M * (xb**2 + yb**2))
    body = jl.energy.RigidBody(M, inertia, jnp.array([xb, yb, 0.0]))
    T = body.kinetic(_pendulum_pose, s.t, s.q, s.v, s.params)
    return T - body.gravity(_pendulum_pose, s.t, s.q, s.params, (g, 0.0, 0.0))


def _pendulum_right(s: State):
    M, Ic, r, alpha, xb, yb, g = s.values("M", "Ic", "r", "alpha", "xb", "yb", "g")
    squared = xb**2 + yb**2 + r**2 - 2 * r * (xb * sin(alpha) + yb * cos(alpha))
    return 0.5 * (Ic + M * squared) * s.v[0] ** 2 + M * g * squared**0.5 * cos(s.q[0])


# Lamina under two forces. The factor of cos(theta) is y' xb - x' yb.


def _lamina_kinetic(s: State, sign: float):
    M, Iz, xb, yb = s.values("M", "Iz", "xb", "yb")
    x, y, w = s.v
    cosine, sine = cos(s.q[2]), sin(s.q[2])
    cross = (y * xb + sign * x * yb) * cosine - (x * xb + y * yb) * sine
    return 0.5 * M * (x**2 + y**2) + 0.5 * Iz * w**2 + M * w * cross


def _following_printed(s: State):
    f1x, f1y, f2x, f2y = s.values("f1x", "f1y", "f2x", "f2y")
    return [f1x + f2x, f1y + f2y]


def _following_right(s: State):
    fx, fy = _following_printed(s)
    cosine, sine = cos(s.q[2]), sin(s.q[2])
    return [fx * cosine - fy * sine, fx * sine + fy * cosine]


def _fixed_printed(s: State):
    x1, y1, x2, y2, F1X, F1Y, F2X, F2Y = s.values(
        "x1", "y1", "x2", "y2", "F1X", "F1Y", "F2X", "F2Y"
    )
    return F1Y * x1 - F1X * y1 + F2Y * x2 - F2X * y2


def _fixed_right(s: State):
    x1, y1, x2, y2, F1X, F1Y, F2X, F2Y = s.values(
        "x1", "y1", "x2", "y2", "F1X", "F1Y", "F2X", "F2Y"
    )
    cosine, sine = cos(s.q[2]), sin(s.q[2])
    first = F1Y * (x1 * cosine - y1 * sine) - F1X * (x1 * sine + y1 * cosine)
    return first + F2Y * (x2 * cosine - y2 * sine) - F2X * (x2 * sine + y2 * cosine)


# Slender rod on a turning arm: body X horizontal, Y along the rod.


def _rod_pose(t, q, params):
    theta1, theta2 = q
    out = jnp.array([jnp.cos(theta1), jnp.sin(theta1), 0.0])
    up = jnp.array([0.0, 0.0, 1.0])
    X = jnp.cross(out, up)
    Y = jnp.cos(theta2) * up + jnp.sin(theta2) * out
    return jnp.stack([X, Y, jnp.cross(X, Y)], axis=1), params["R"] * out


def _rod_kinetic(s: State):
    rho, L = s.values("rho", "L")
    inertia = rho * L**3 / 3 * jnp.array([1.0, 0.0, 1.0])
    rod = jl.energy.RigidBody(rho * L, inertia, jnp.array([0.0, 1.0, 0.0]) * L / 2)
    return rod.kinetic(_rod_pose, s.t, s.q, s.v, s.params)


def _rod_formula(s: State, ybar: float):
    rho, L, R = s.values("rho", "L", "R")
    M, inertia = rho * L, rho * L**3 / 3
    s2 = sin(s.q[1])
    about_axis = M * R**2 + inertia * s2**2 + 2 * M * ybar * R * s2
    return 0.5 * about_axis * s.v[0] ** 2 + 0.5 * inertia * s.v[1] ** 2


def _rod_end_velocity(s: State):
    """Velocity of the free end across the rod, along body Z."""

    def end(t, q, params):
        R, pin = _rod_pose(t, q, params)
        return pin + params["L"] * R[:, 1]

    R, _ = _rod_pose(s.t, s.q, s.params)
    return R[:, 2] @ jl.energy.velocity(end, s.t, s.q, s.v, s.params)


# Carnival ride: the rider in a fixed frame, its acceleration along and across the arm.


def _rider(t, q, params):
    return q[0] * jnp.stack([jnp.cos(q[1]), jnp.sin(q[1])])


def _rider_acceleration(s: State):
    return motion(_rider, s, s.a)[2]


def _across(s: State):
    return jnp.stack([-jnp.sin(s.q[1]), jnp.cos(s.q[1])])


def _transverse(s: State):
    return 2 * s.v[0] * s.v[1] + s.q[0] * s.a[1]


def _centripetal(s: State):
    """Centripetal acceleration in units of g, from the force on the rider."""
    force = jl.inverse_dynamics(carnival_ride.system, s.q, s.v, s.a, s.params, t=s.t)
    return -force[0] / (s.params["m"] * FREE_FALL)


_RIDE = carnival_ride.entry.example.params

ERRATA = (
    Erratum(
        place="2.18, L of the physical pendulum",
        wrong="set equal to 0",
        draw=around_example(physical_pendulum_three_origins.entry),
        engine=_pendulum_lagrangian,
        printed=lambda s: 0.0,
        right=_pendulum_right,
    ),
    Erratum(
        place="2.21, third line, T of the lamina",
        wrong="y' xb + x' yb for y' xb - x' yb",
        draw=around_example(lamina_two_forces.entry),
        engine=lambda s: lamina_two_forces.system.kinetic(s.q, s.v, s.params, t=s.t),
        printed=lambda s: _lamina_kinetic(s, +1),
        right=lambda s: _lamina_kinetic(s, -1),
    ),
    Erratum(
        place="2.22, Q_x and Q_y of forces along the body axes",
        wrong="body components, not turned into the fixed axes",
        draw=around_example(lamina_two_forces.entry),
        engine=lambda s: lamina_two_forces.system.generalized_force(s.q, s.v, s.params, t=s.t)[:2],
        printed=_following_printed,
        right=_following_right,
    ),
    Erratum(
        place="2.22, Q_theta where f is along the fixed axes",
        wrong="arms are not turned with the body",
        draw=around_example(lamina_two_forces_fixed_direction.entry),
        engine=lambda s: lamina_two_forces_fixed_direction.system.generalized_force(
            s.q, s.v, s.params, t=s.t
        )[2],
        printed=_fixed_printed,
        right=_fixed_right,
    ),
    Erratum(
        place="Ch. 2, Example 5, item (d), omega_z of the hanging lamina",
        wrong="phi' + theta' for phi'",
        draw=around_example(lamina_double_pendulum.entry),
        engine=lambda s: jl.energy.body_velocity(
            lamina_double_pendulum.pose, s.t, s.q, s.v, s.params
        )[1][2],
        printed=lambda s: s.v[1] + s.v[0],
        right=lambda s: s.v[1],
    ),
    Erratum(
        place="Ch. 2, Example 6, item 3, rod's velocity along body Z",
        wrong="+l theta2' for -l theta2'",
        draw=around_example(rotating_slender_rod.entry),
        engine=_rod_end_velocity,
        printed=lambda s: s.params["L"] * s.v[1],
        right=lambda s: -s.params["L"] * s.v[1],
    ),
    Erratum(
        place="Ch. 2, Example 6, item 6, T of the rod",
        wrong="ybar = 0 for ybar = L/2",
        draw=around_example(rotating_slender_rod.entry),
        engine=_rod_kinetic,
        printed=lambda s: _rod_formula(s, 0.0),
        right=lambda s: _rod_formula(s, s.params["L"] / 2),
    ),
    Erratum(
        place="Ch. 2, Example 7, transverse acceleration of the rider",
        wrong="torque 2 m r r' theta' + m r^2 theta'' called so",
        draw=around(_RIDE, (5.0, 0.0)),
        engine=lambda s: _across(s) @ _rider_acceleration(s),
        printed=lambda s: s.params["m"] * s.q[0] * _transverse(s),
        right=_transverse,
    ),
    Erratum(
        place="Ch. 2, Example 7, magnitude of the acceleration",
        wrong="transverse part alone",
        draw=around(_RIDE, (5.0, 0.0)),
        engine=lambda s: jl.math.norm(_rider_acceleration(s)),
        printed=lambda s: abs(_transverse(s)),
        right=lambda s: hypot(s.a[0] - s.q[0] * s.v[1] ** 2, _transverse(s)),
    ),
    Erratum(
        place="Ch. 2, Example 7, 45 m/s^2 in units of g",
        wrong="4.5 for 4.59",
        draw=around(_RIDE, (5.0, 0.0), array([0.4, 3.0]), dq=(0.0, 0.4), dv=(0.3, 0.0), da=0.0),
        engine=_centripetal,
        printed=lambda s: 4.5,
        right=lambda s: s.q[0] * s.v[1] ** 2 / FREE_FALL,
    ),
)

TEXT_ONLY = (
    ("2.7, second line", "a parenthesis is missing before phi' + psi' cos(theta), factor of x"),
    ("2.14, v_y", "the last factor, printed s in phi, is sin(phi)"),
    ("2.17-2.19", "Iz names three inertias, one about each origin"),
)
