"""Equations of motion without Lagrangians or autodiff, for independent ends of motions.

Newton's and Euler's equations on numbers, integrated by scipy's DOP853 at tolerance 1e-12.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

TOLERANCE = 1e-12


def integrated(rates: Callable[[float, np.ndarray], Any], y0: Any, t1: float) -> np.ndarray:
    """y at t1."""
    found = solve_ivp(
        rates, (0.0, t1), y0, method="DOP853", rtol=TOLERANCE, atol=TOLERANCE, t_eval=[t1]
    )
    if not found.success:
        raise RuntimeError(found.message)
    return found.y[:, -1]


class Links(NamedTuple):
    """Links that turn in a plane about pins, by their angles.

    The center of body i is `reach[i] @ rays`, with rays the unit vectors along the links.

    A_kl (cos(q_k - q_l) q_l'' + sin(q_k - q_l) q_l'^2) + J_k q_k'' = torque_k - weight_k cos q_k,
    A = reach^T diag(m) reach, weight = g m^T reach.

    Attributes:
        held: links that do not turn.
    """

    reach: np.ndarray
    masses: np.ndarray
    inertias: np.ndarray
    g: float
    torques: Callable[[np.ndarray], np.ndarray] = np.zeros_like
    held: tuple[int, ...] = ()

    def end(self, angles: np.ndarray, rates: np.ndarray, t1: float) -> np.ndarray:
        """Angles at t1."""
        n = angles.size
        A, weight = self.reach.T * self.masses @ self.reach, self.g * self.masses @ self.reach
        free = np.setdiff1d(np.arange(n), self.held)

        def moving(t: float, y: np.ndarray) -> np.ndarray:
            q, w = y[:n], y[n:]
            between = q[:, None] - q[None, :]
            M = A * np.cos(between) + np.diag(self.inertias)
            right = self.torques(q) - weight * np.cos(q) - (A * np.sin(between)) @ w**2
            turned = np.zeros(n)
            turned[free] = np.linalg.solve(M[np.ix_(free, free)], right[free])
            return np.concatenate([w, turned])

        return integrated(moving, np.concatenate([angles, rates]), t1)[:n]


def parallelograms(
    n: int, p: Mapping[str, float], angle: float, rate: float, t1: float
) -> np.ndarray:
    """Angle of n + 1 equal cranks whose n couplers stay level: a compound pendulum."""
    inertia, weight = (n + 1) / 3.0 + n, (n + 1) / 2.0 + n
    pull = p["g"] * weight / (p["l"] * inertia)
    return integrated(lambda t, y: [y[1], -pull * np.cos(y[0])], [angle, rate], t1)[0]


def governor(
    p: Mapping[str, float], crank: float, rate: float, arm: float, t1: float
) -> np.ndarray:
    """Coordinates of the governor, from two degrees of freedom: crank and arm."""
    r, rod, ratio, a = p["r"], p["l"], p["ratio"], p["a"]

    def engine(q: Any) -> Any:
        """Inertia of crank, rod and piston about the crank's axis."""
        along = -np.arcsin(r * np.sin(q) / rod)
        per = -r * np.cos(q) / (rod * np.cos(along))  # of the rod, for each rad of the crank
        piston = -r * np.sin(q) - rod * np.sin(along) * per
        center = (-r * np.sin(q) - 0.5 * rod * np.sin(along) * per) ** 2 + (
            0.5 * r * np.cos(q)
        ) ** 2
        return p["J"] + p["m_piston"] * piston**2 + p["m_rod"] * (center + (rod * per) ** 2 / 12.0)

    def moving(t: float, y: np.ndarray) -> list[float]:
        q, x, q_rate, x_rate = y
        s, c = np.sin(x), np.cos(x)
        inertia, slope = engine(q), np.imag(engine(q + 1e-30j)) / 1e-30
        radius = p["e"] + a * s
        balls = 2.0 * p["m_ball"] * radius**2 * ratio**2
        balls_slope = 4.0 * p["m_ball"] * radius * a * c * ratio**2
        torque = p["torque"] * c - p["d"] * q_rate
        turned = torque - 0.5 * slope * q_rate**2 - balls_slope * x_rate * q_rate
        arms = 2.0 * p["m_ball"] * a**2 + p["m_sleeve"] * (2.0 * a * s) ** 2
        arms_slope = 8.0 * p["m_sleeve"] * a**2 * s * c
        fall = 2.0 * p["g"] * a * s * (p["m_ball"] + p["m_sleeve"])
        swung = 0.5 * balls_slope * q_rate**2 - 0.5 * arms_slope * x_rate**2 - fall
        return [q_rate, x_rate, turned / (inertia + balls), swung / arms]

    q, x = integrated(moving, [crank, arm, rate, 0.0], t1)[:2]
    along = -np.arcsin(r * np.sin(q) / rod)
    piston = r * np.cos(q) + rod * np.cos(along)
    return np.array([q, along, piston, ratio * q, x, -2.0 * a * np.cos(x)])


def tensegrity(
    r: np.ndarray,
    v: np.ndarray,
    bars: np.ndarray,
    forces: Callable[[np.ndarray], np.ndarray],
    mass: float,
    t1: float,
) -> np.ndarray:
    """Positions of equal masses at the ends of bars that have no end in common.

    The tension s of a bar u follows from (u.u)'' = 0: 2 s u.u = u.(f_2 - f_1) + m u'.u'.
    """
    first, second = bars.T

    def moving(t: float, y: np.ndarray) -> np.ndarray:
        r, v = y.reshape(2, -1, 3)
        f = forces(r)
        u, w = r[second] - r[first], v[second] - v[first]
        s = np.sum(u * (f[second] - f[first]) + mass * w * w, 1) / (2.0 * np.sum(u * u, 1))
        np.add.at(f, first, s[:, None] * u)
        np.add.at(f, second, -s[:, None] * u)
        return np.concatenate([v.ravel(), f.ravel() / mass])

    return integrated(moving, np.concatenate([r.ravel(), v.ravel()]), t1)[: r.size]
