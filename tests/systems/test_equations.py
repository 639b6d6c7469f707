"""Accelerations and multipliers against equations of motion derived by hand.

Each function returns the book's mass matrix and the terms of the right-hand side, so that M a =
sum(terms). Under constraints M is bordered by their rows and the solution is (a, lam). The
solutions by hand and by jaxlag have rounding of relative size eps cond(M) from the solve, and of a
few eps in every term. With K = 32 roundings allowed, they agree to K eps cond(M) |M^-1|
sum(|terms|).
"""

from functools import partial

import jax
import numpy as np
import pytest
from _families import mostly_full
from _hand_constrained import HAND_EQUATIONS as CONSTRAINED
from _hand_equations2 import HAND_EQUATIONS as CHAPTER_2
from _hand_equations3 import HAND_EQUATIONS as CHAPTER_3
from _hand_equations4 import HAND_EQUATIONS as CHAPTER_4
from _states import random_states
from numpy import cos, sin
from numpy.linalg import norm

from systems.catalogue import ENTRIES
from systems.reference._quantities import quantities

K = 32
EPS = np.finfo(float).eps


def mass_spring(t, q, v, m, k):
    return [[m]], [[-k * q[0]]]


def two_mass_three_springs(t, q, v, m1, m2, k1, k2, k3):
    x1, x2 = q
    return np.diag([m1, m2]), [[-k1 * x1, -k3 * x2], [k2 * (x2 - x1), -k2 * (x2 - x1)]]


def simple_pendulum(t, q, v, m1, h1, g):
    return [[1.0]], [[-g / h1 * sin(q[0])]]


def double_pendulum(t, q, v, m1, m2, h1, h2, g):
    (theta1, theta2), (w1, w2) = q, v
    c, s = cos(theta1 - theta2), sin(theta1 - theta2)
    M = [[(m1 + m2) * h1**2, m2 * h1 * h2 * c], [m2 * h1 * h2 * c, m2 * h2**2]]
    centrifugal = [-m2 * h1 * h2 * w2**2 * s, m2 * h1 * h2 * w1**2 * s]
    gravity = [-(m1 + m2) * g * h1 * sin(theta1), -m2 * g * h2 * sin(theta2)]
    return M, [centrifugal, gravity]


def double_pendulum_rayleigh(t, q, v, m1, m2, h1, h2, g, c1x, c1y, c2x, c2y):
    M, terms = double_pendulum(t, q, v, m1, m2, h1, h2, g)
    dx1, dy1 = np.array([h1 * cos(q[0]), 0.0]), np.array([h1 * sin(q[0]), 0.0])
    dx2, dy2 = np.array([dx1[0], h2 * cos(q[1])]), np.array([dy1[0], h2 * sin(q[1])])
    drag = ((c1x, dx1), (c1y, dy1), (c2x, dx2), (c2y, dy2))
    return M, terms + [-c * (direction @ v) * direction for c, direction in drag]


def mass_spring_dashpot(t, q, v, m, k, b, g, F0, Omega):
    return [[m]], [[m * g], [F0 * cos(Omega * t)], [-b * v[0]], [-k * q[0]]]


def sleeve_pendulum(t, q, v, M1, M2, IA, IG, L1, L2, L0, k, F0, omega, g):
    (x1, theta), (x1_rate, w) = q, v
    c, s, F = cos(theta), sin(theta), F0 * cos(omega * t)
    return np.diag([M2, IA + IG + M2 * x1**2]), [
        [M2 * x1 * w**2, -2 * M2 * x1 * x1_rate * w],
        [-k * (x1 - L0 - L2 / 2), 0.0],
        [M2 * g * c, -(M1 * L1 / 2 + M2 * x1) * g * s],
        [F * s, (x1 + L2 / 2) * F * c],
    ]


def cart_pendulum(t, q, v, m1, m2, l, k, b, g, F0, F2, Omega):  # noqa: E741
    (x, theta), (x_rate, w) = q, v
    c, s = cos(theta), sin(theta)
    F, end = F0 * cos(Omega * t), F2 * sin(Omega * t)
    M = [[m1 + m2, m2 * l * c / 2], [m2 * l * c / 2, m2 * l**2 / 3]]
    return M, [
        [m2 * l * w**2 * s / 2, -m2 * g * l * s / 2],
        [-k * x, 0.0],
        [-b * x_rate, 0.0],
        [F + end, end * l * c],
    ]


def central_motion(t, q, v, m, K, c):
    (r, _), (r_rate, w) = q, v
    return np.diag([m, m * r**2]), [
        [m * r * w**2, -2 * m * r * r_rate * w],
        [-K / r**2, 0.0],
        [-c * r, 0.0],
    ]


def rotating_slender_rod(t, q, v, rho, L, R, g, tau0, Omega):
    (_, theta2), (w1, w2) = q, v
    c2, s2 = cos(theta2), sin(theta2)
    M, ybar, I = rho * L, L / 2, rho * L**3 / 3  # noqa: E741
    about_axis = M * R**2 + I * s2**2 + 2 * M * ybar * R * s2
    return np.diag([about_axis, I]), [
        [-2 * (I * s2 + M * ybar * R) * c2 * w2 * w1, (I * s2 + M * ybar * R) * c2 * w1**2],
        [tau0 * cos(Omega * t), M * g * ybar * s2],
    ]


HAND_EQUATIONS = (
    {
        function.__name__: function
        for function in (
            mass_spring,
            two_mass_three_springs,
            simple_pendulum,
            double_pendulum,
            double_pendulum_rayleigh,
            mass_spring_dashpot,
            sleeve_pendulum,
            cart_pendulum,
            central_motion,
            rotating_slender_rod,
        )
    }
    | CHAPTER_2
    | CHAPTER_3
    | CHAPTER_4
    | CONSTRAINED
)


MOVING = [name for name, entry in ENTRIES.items() if entry.kind == "trajectory"]


def evaluate(entry, params, t, q, v):
    """Every quantity, dL/dq, Q, and dH/dt along the motion."""
    values = quantities(entry, params, t, q, v)

    def energy(t, q, v):
        return entry.system.energy(q, v, params, t=t)

    return values | {
        "dL_dq": jax.grad(entry.system.lagrangian, argnums=1)(t, q, v, params),
        "Q": entry.system.generalized_force(q, v, params, t=t),
        "H_dot": jax.jvp(energy, (t, q, v), (1.0, v, values["a"]))[1],
    }


PLAIN = (
    *("central_motion", "cart_pendulum", "double_pendulum_rayleigh", "quadcopter"),
    *("atwood_multipliers", "tricycle"),
)


@pytest.fixture(scope="module", params=mostly_full(MOVING, *PLAIN))
def evaluated(request, lowering):
    """An entry with its values at random states: (entry, [((t, q, v, params), values), ...])."""
    entry = ENTRIES[request.param]
    values = jax.jit(partial(evaluate, entry))
    states = random_states(entry)
    return entry, [((t, q, v, params), values(params, t, q, v)) for t, q, v, params in states]


def test_every_system_has_its_hand_equations():
    assert set(HAND_EQUATIONS) == set(MOVING)


def test_random_states_are_on_the_constraints(evaluated):
    entry, pairs = evaluated
    for (t, q, v, params), _ in pairs if entry.constraints else []:
        positions, rates = entry.system.residuals(q, v, params, t=t)
        for residuals, size in ((positions, 1 + norm(q)), (rates, 1 + norm(v))):
            for residual in residuals.values():
                np.testing.assert_allclose(residual, 0.0, rtol=0, atol=K * EPS * size**2)


def test_accelerations_equal_those_of_the_book(evaluated):
    """The multipliers, too, if there are any."""
    entry, pairs = evaluated
    for (t, q, v, params), values in pairs:
        M, terms = HAND_EQUATIONS[entry.name](t, q, v, **params)
        expected = np.linalg.solve(M, np.sum(terms, axis=0))
        size = norm(np.linalg.inv(M), 2) * np.sum(norm(terms, axis=1))
        tolerance = K * EPS * np.linalg.cond(M) * size
        found = np.concatenate([values["a"], values.get("lambda", [])])
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def test_momenta_obey_lagrange_equations(evaluated):
    """dp/dt along the motion, a derivative of p, equals dL/dq + Q + A^T lam.

    The derivation through a multiplies its error by M, hence the condition number.
    """
    entry, pairs = evaluated
    for (t, q, v, params), values in pairs:
        M, terms = HAND_EQUATIONS[entry.name](t, q, v, **params)
        size = 1 + np.sum(norm(terms, axis=1))
        tolerance = K * EPS * np.linalg.cond(M) * size
        expected = values["dL_dq"] + values["Q"] + values.get("constraint_force", 0.0)
        np.testing.assert_allclose(values["extras.p_dot"], expected, rtol=0, atol=tolerance)


def test_energy_changes_by_the_power_of_the_forces(evaluated):
    """dH/dt = v . (Q + A^T lam), because no Lagrangian here contains the time."""
    entry, pairs = evaluated
    for (t, q, v, params), values in pairs:
        M, terms = HAND_EQUATIONS[entry.name](t, q, v, **params)
        power = v @ (values["Q"] + values.get("constraint_force", 0.0))
        size = norm(v) * (1 + np.sum(norm(terms, axis=1)))
        tolerance = K * EPS * np.linalg.cond(M) * size
        np.testing.assert_allclose(values["H_dot"], power, rtol=0, atol=tolerance)


MOVED = ("spherical_pendulum_varying", "particle_on_surface", "rolling_ball_turntable")
"""Systems with constraints that depend on time."""


def test_constraints_at_rest_do_no_work(evaluated):
    """v . A^T lam = 0 if no row contains the time; otherwise it is not zero."""
    entry, pairs = evaluated
    moving = entry.name in MOVED
    for (_, _, v, _), values in pairs if entry.constraints else []:
        force = values["constraint_force"]
        rounding = K * EPS * norm(v) * norm(force)
        assert (abs(v @ force) > 1e6 * rounding) == moving
        assert moving or abs(v @ force) <= rounding
