"""Scenes that are declared once, for numbers and for symbols.

Every function takes the module of elementary functions, `jax.numpy` or `sympy`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

G = 9.81
Expression = Any


@dataclass(frozen=True)
class Scene:
    """A system of n coordinates and the state about which it is linearized.

    Attributes:
        names: of the coordinates.
        lagrangian: L of (module, q, v).
        q: coordinates.
        v: velocities.
        independent: names, with a prime for velocities.
        phi: holonomic rows of (module, q).
        rows: Pfaffian rows of (module, q, v).
    """

    names: tuple[str, ...]
    lagrangian: Callable[..., Expression]
    q: np.ndarray
    v: np.ndarray
    independent: tuple[str, ...] | None = None
    phi: Callable[..., Sequence[Expression]] | None = None
    rows: Callable[..., Sequence[Expression]] | None = None


def chain(n: int) -> Scene:
    """n point masses of 1 kg on rods of 1 m, by absolute angles."""

    def lagrangian(m: Any, q: Any, v: Any) -> Expression:
        x = y = height = total = 0.0
        for i in range(n):
            x, y = x + m.cos(q[i]) * v[i], y + m.sin(q[i]) * v[i]
            height = height - m.cos(q[i])
            total = total + 0.5 * (x**2 + y**2) - G * height
        return total

    shape = np.arange(1, n + 1)
    names = tuple(f"q{i}" for i in shape)
    return Scene(names, lagrangian, 0.3 * np.cos(shape), 0.5 * np.sin(shape))


def pendulum() -> Scene:
    """A mass of 1 kg on a rod of 1 m, in Cartesian coordinates."""

    def lagrangian(m: Any, q: Any, v: Any) -> Expression:
        return 0.5 * (v[0] ** 2 + v[1] ** 2) - G * q[1]

    angle, rate = 0.4, 1.3
    q = np.array([np.sin(angle), -np.cos(angle)])
    v = rate * np.array([np.cos(angle), np.sin(angle)])
    phi = lambda m, q: [q[0] ** 2 + q[1] ** 2 - 1.0]  # noqa: E731
    return Scene(("x", "y"), lagrangian, q, v, ("x", "x'"), phi)


def disk() -> Scene:
    """A thin disk of 1 kg and radius 1 m that rolls straight ahead at 2 m/s, leaned."""

    def lagrangian(m: Any, q: Any, v: Any) -> Expression:
        _, _, psi, theta, _ = q
        s, c = m.sin(theta), m.cos(theta)
        across = c * v[3], s * v[2]
        x = v[0] + across[0] * m.sin(psi) + across[1] * m.cos(psi)
        y = v[1] - across[0] * m.cos(psi) + across[1] * m.sin(psi)
        turning = v[3] ** 2 + (c * v[2]) ** 2
        spin = (v[4] + s * v[2]) ** 2
        moving = 0.5 * (x**2 + y**2 + (s * v[3]) ** 2)
        return moving + 0.125 * turning + 0.25 * spin - G * c

    def rows(m: Any, q: Any, v: Any) -> list[Expression]:
        return [v[0] - m.cos(q[2]) * v[4], v[1] - m.sin(q[2]) * v[4]]

    psi = 0.3
    q, v = np.array([0.0, 0.0, psi, 0.2, 0.0]), np.zeros(5)
    v[:] = 2.0 * np.cos(psi), 2.0 * np.sin(psi), 0.4, 0.1, 2.0
    names = ("x", "y", "psi", "theta", "phi")
    return Scene(names, lagrangian, q, v, (*names, "psi'", "theta'", "phi'"), rows=rows)


SCENES: dict[str, Callable[[], Scene]] = {
    "double pendulum": lambda: chain(2),
    "chain of 4": lambda: chain(4),
    "pendulum with a row": pendulum,
    "rolling disk": disk,
}
BICYCLE = "bicycle"
"""By rigid bodies; for numbers alone."""
