"""Errata of chapter 3 up to eq. 3.119, in the order of the book.

Those of Example 5 are in `_quadcopter.py`.
"""

import jax.numpy as jnp
from numpy import array, concatenate, cos, sin, tan

import jaxlag as jl
from jaxlag import energy
from systems.catalogue.chapter3 import (
    double_pendulum,
    double_pendulum_cartesian,
    mass_spring_dashpot,
    simple_pendulum,
)
from systems.errata import _quadcopter
from systems.errata._erratum import Erratum, State, around, around_example, motion

# Knife edge: the point of contact A, the body turned by theta.


def _knife_pose(t, q, params):
    return jl.rotation.about_z(q[2]), jnp.stack([q[0], q[1], jnp.zeros_like(q[0])])


def _knife_divided(s: State):
    x_rate, y_rate, _ = s.v
    return x_rate - y_rate / tan(s.q[2])


def _knife_undivided(s: State):
    x_rate, y_rate, _ = s.v
    return y_rate * cos(s.q[2]) - x_rate * sin(s.q[2])


# Double pendulum by the positions of its bobs, x to the right and y upward.


def _bobs(t, q, params):
    r1 = params["h1"] * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])
    r2 = r1 + params["h2"] * jnp.stack([jnp.sin(q[1]), -jnp.cos(q[1])])
    return jnp.concatenate([r1, r2])


def _bob_masses(params):
    return jnp.stack([params["m1"], params["m2"]])


_DOUBLE = jl.System(
    coordinates=("theta1", "theta2"),
    kinetic=lambda t, q, v, params: energy.particles(
        lambda t, q, params: _bobs(t, q, params).reshape(2, 2), _bob_masses(params), t, q, v, params
    ),
    potential=lambda t, q, params: double_pendulum_cartesian.potential(
        t, _bobs(t, q, params), params
    ),
)

_BOBS = jl.System(
    coordinates=("x1", "y1", "x2", "y2"),
    kinetic=double_pendulum_cartesian.kinetic,
    potential=double_pendulum_cartesian.potential,
)
"""The two bobs without strings."""


def _displacement(s: State, factor):
    """sum_k dr/dq_k factor_k of both bobs, shape (4,)."""
    first = s.params["h1"] * factor[0] * array([cos(s.q[0]), sin(s.q[0])])
    second = s.params["h2"] * factor[1] * array([cos(s.q[1]), sin(s.q[1])])
    return concatenate([first, first + second])


def _bob_energy(s: State, power: int):
    """T, with y1' raised to `power`."""
    m1, m2, h1, h2 = s.values("m1", "m2", "h1", "h2")
    (c1, c2), (s1, s2), (w1, w2) = cos(s.q), sin(s.q), s.v
    first = (h1 * c1 * w1) ** 2 + (h1 * s1 * w1) ** power
    second = (h1 * c1 * w1 + h2 * c2 * w2) ** 2 + (h1 * s1 * w1 + h2 * s2 * w2) ** 2
    return 0.5 * m1 * first + 0.5 * m2 * second


def _second_equation(s: State, power: int):
    """Left side of the second equation of motion, with m2 h2^power theta2''."""
    m2, h1, h2, g = s.values("m2", "h1", "h2", "g")
    theta1, theta2 = s.q
    c, sine = cos(theta1 - theta2), sin(theta1 - theta2)
    turning = m2 * h1 * h2 * (s.a[0] * c - s.v[0] ** 2 * sine)
    return m2 * h2**power * s.a[1] + turning + m2 * g * h2 * sin(theta2)


def _string_forces(s: State):
    """Forces of the strings on the swinging bobs, (4,)."""
    a = _DOUBLE.acceleration(s.q, s.v, s.params, t=s.t)
    return jl.inverse_dynamics(_BOBS, *motion(_bobs, s, a), s.params)


def _multiplier_forces(s: State, sign: int):
    """sign sum_i lambda_i grad f_i, f_i = (length of string i)^2 - h_i^2, with tight strings.

    lambda_i = -tension_i/(2 h_i): a tension pulls against grad f_i.
    """
    m1, m2, h1, h2, g = s.values("m1", "m2", "h1", "h2", "g")
    (theta1, theta2), (w1, w2) = s.q, s.v
    u1, u2 = array([sin(theta1), -cos(theta1)]), array([sin(theta2), -cos(theta2)])
    c = cos(theta1 - theta2)
    # Along the strings: m1 h1 w1^2 = t1 - t2 c - m1 g cos(theta1), and for the second bob minus
    # the first m1 m2 h2 w2^2 = (m1 + m2) t2 - m2 t1 c.
    right = array([m1 * (h1 * w1**2 + g * cos(theta1)), m1 * m2 * h2 * w2**2])
    determinant = m1 + m2 - m2 * c**2
    t1 = ((m1 + m2) * right[0] + c * right[1]) / determinant
    t2 = (m2 * c * right[0] + right[1]) / determinant
    lambda1, lambda2 = -t1 / (2 * h1), -t2 / (2 * h2)
    grad1, grad2 = 2 * h1 * u1, 2 * h2 * u2
    return sign * concatenate([lambda1 * grad1 - lambda2 * grad2, lambda2 * grad2])


# One bob on a string.


def _bob(t, q, params):
    return params["h1"] * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])


_BOB = jl.System(
    coordinates=("x", "y"),
    kinetic=lambda t, q, v, params: 0.5 * params["m1"] * v @ v,
    potential=lambda t, q, params: params["m1"] * params["g"] * q[1],
)
"""The bob of the simple pendulum without its string."""


def _string_force(s: State):
    a = simple_pendulum.system.acceleration(s.q, s.v, s.params, t=s.t)
    return jl.inverse_dynamics(_BOB, *motion(_bob, s, a), s.params)


def _multiplier_force(s: State, sign: int):
    """sign lambda grad f, f = x^2 + y^2 - h1^2, with lambda = -tension/(2 h1): a tight string."""
    m1, h1, g = s.values("m1", "h1", "g")
    ((theta,), (w,)) = s.q, s.v
    multiplier = -m1 * (g * cos(theta) + h1 * w**2) / (2 * h1)
    return sign * multiplier * 2 * h1 * array([sin(theta), -cos(theta)])


# Hanging mass of Example 6.


def _spring_and_weight(s: State):
    m, k, g = s.values("m", "k", "g")
    return energy.spring(k, s.q) + energy.gravity(m, s.q, jnp.stack([g]))


def _hanging_potential(s: State, stiffness: float):
    return 0.5 * stiffness * s.q[0] ** 2 - s.params["m"] * s.params["g"] * s.q[0]


ERRATA = (
    Erratum(
        place="3.13, last form, knife edge at theta = 0",
        wrong="divided by tan(theta) = 0",
        draw=around({}, (0.0, 0.0, 0.0), dq=(0.4, 0.4, 0.0)),
        engine=lambda s: energy.body_velocity(_knife_pose, s.t, s.q, s.v, s.params)[0][1],
        printed=_knife_divided,
        right=_knife_undivided,
        singular=True,
    ),
    Erratum(
        place="Sec. 3.7, virtual displacement delta x_i",
        wrong="sum of dx_i'/dv_k without the factors delta q_k",
        draw=around_example(double_pendulum.entry),
        engine=lambda s: energy.velocity(_bobs, s.t, s.q, s.v, s.params),
        printed=lambda s: _displacement(s, (1.0, 1.0)),
        right=lambda s: _displacement(s, s.v),
    ),
    Erratum(
        place="3.67, T of the double pendulum",
        wrong="y1' for y1'^2",
        draw=around_example(double_pendulum.entry),
        engine=lambda s: _DOUBLE.kinetic(s.q, s.v, s.params, t=s.t),
        printed=lambda s: _bob_energy(s, 1),
        right=lambda s: _bob_energy(s, 2),
    ),
    Erratum(
        place="3.72-3.73, second equation of the double pendulum",
        wrong="m2 h2 theta2'' for m2 h2^2 theta2''",
        draw=around_example(double_pendulum.entry),
        engine=lambda s: jl.inverse_dynamics(_DOUBLE, s.q, s.v, s.a, s.params, t=s.t)[1],
        printed=lambda s: _second_equation(s, 1),
        right=lambda s: _second_equation(s, 2),
    ),
    *_quadcopter.ERRATA,
    Erratum(
        place="Ch. 3, Example 6, V of the hanging mass",
        wrong="1/2 m k x^2 for 1/2 k x^2",
        draw=around_example(mass_spring_dashpot.entry),
        engine=_spring_and_weight,
        printed=lambda s: _hanging_potential(s, s.params["m"] * s.params["k"]),
        right=lambda s: _hanging_potential(s, s.params["k"]),
    ),
    Erratum(
        place="3.112, 3.114, reaction of a constraint",
        wrong="-lambda df/dq for +lambda df/dq as in 3.118",
        draw=around_example(simple_pendulum.entry),
        engine=_string_force,
        printed=lambda s: _multiplier_force(s, -1),
        right=lambda s: _multiplier_force(s, +1),
    ),
    Erratum(
        place="3.115, reactions from the augmented function",
        wrong="L - sum lambda f for L + sum lambda f",
        draw=around_example(double_pendulum.entry),
        engine=_string_forces,
        printed=lambda s: _multiplier_forces(s, -1),
        right=lambda s: _multiplier_forces(s, +1),
    ),
)

TEXT_ONLY = (
    (
        "Sec. 3.1, ball rolling without spin",
        "four coordinates, two of them angles, would make it holonomic; the ball has five, and "
        "omega_X, omega_Y are no rates of coordinates",
    ),
    ("3.14", "n is the number of coordinates; the degrees of freedom are n - k"),
    ("3.52-3.53", "dT/d(delta q') is dT/dq'"),
    ("Sec. 3.7, last line", "dF/q_k' is dF/dq_k'"),
    *_quadcopter.TEXT_ONLY,
    ("3.98, 3.158", "theta1' is theta'"),
    (
        "Ch. 3, Example 8, kinetic energy of the rod",
        "the parallel axis theorem can be used, with a cross term for the moving pin",
    ),
    ("3.111-3.112", "dq1/df is 1/(df/dq1)"),
)
