"""Constrained mechanisms with consistent starts, to measure stabilization.

The only forces are weight and a spring, so that H is constant. Lengths are in m, masses in kg,
angles in rad. Linkages move in a plane, y upward, and start where V is least. So their initial
kinetic energy is H minus its least value. Their motion stays bounded, because the rounding error
of phi, eps |q|, would grow with angles that increase with every revolution. Rolling bodies have
constraint rows without phi, and quasi-velocities that satisfy these rows identically.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from systems import rolling_disk, snakeboard

G = 9.81


class Mechanism(NamedTuple):
    """A system with constraints, a consistent start, and its initial kinetic energy in J."""

    system: jl.System
    q0: np.ndarray
    v0: np.ndarray
    params: Mapping[str, float]
    energy: float


# ---- Double pendulum of point masses, in the Cartesian coordinates of its bobs -------------------

BOBS = {"m1": 1.0, "m2": 0.6, "l1": 0.9, "l2": 0.7}
SPIN = 5.0  # rad/s, of the first rod at the start


def bobs(t: Any, q: Array, v: Array, params: Any) -> Array:
    """L of two point masses, q = (x1, y1, x2, y2) from the pivot."""
    m = jnp.stack([params["m1"], params["m1"], params["m2"], params["m2"]])
    return 0.5 * jnp.sum(m * v**2) - G * (params["m1"] * q[1] + params["m2"] * q[3])


def rods(t: Any, q: Array, params: Any) -> Array:
    """Squared distances between the ends of the rods, minus their squared lengths."""
    d = q[2:] - q[:2]
    return jnp.stack([q[:2] @ q[:2] - params["l1"] ** 2, d @ d - params["l2"] ** 2])


def double_pendulum() -> Mechanism:
    """It hangs straight down; the first rod turns fast enough to make the second one tumble."""
    l1, l2 = BOBS["l1"], BOBS["l2"]
    system = jl.System(
        bobs, ("x1", "y1", "x2", "y2"), constraints=(jl.Holonomic(rods, ("rod1", "rod2")),)
    )
    q0, v0 = np.array([0.0, -l1, 0.0, -l1 - l2]), SPIN * l1 * np.array([1.0, 0.0, 1.0, 0.0])
    return _started(system, q0, v0, BOBS)


# ---- Four-bar linkage by the angles of crank, coupler and rocker, closed by two rows -------------

FOUR_BAR = {"a": 0.4, "b": 1.1, "c": 0.8, "d": 1.0}
CRANK, RATE = -1.83, 12.0  # rad, rad/s, of the crank at the start


def links(t: Any, q: Array, v: Array, params: Any) -> Array:
    """L of uniform slender links a, b, c joined head to tail from the origin; mass 1 kg/m."""
    lengths = jnp.stack([params["a"], params["b"], params["c"]])
    rates = jnp.stack([-jnp.sin(q), jnp.cos(q)], -1) * (lengths * v)[:, None]
    centers = jnp.cumsum(rates, 0) - 0.5 * rates
    rises = lengths * jnp.sin(q)
    heights = jnp.cumsum(rises) - 0.5 * rises
    T = 0.5 * jnp.sum(lengths * jnp.sum(centers**2, 1)) + jnp.sum(lengths**3 * v**2) / 24
    return T - G * jnp.sum(lengths * heights)


def closure(t: Any, q: Array, params: Any) -> Array:
    """Position of the head of the last link relative to the other pivot (d, 0)."""
    lengths = jnp.stack([params["a"], params["b"], params["c"]])
    return jnp.stack([lengths @ jnp.cos(q) - params["d"], lengths @ jnp.sin(q)])


def four_bar() -> Mechanism:
    """The open configuration, by the law of cosines; the crank swings through 4 rad."""
    lengths = np.array([FOUR_BAR[name] for name in "abc"])
    a, b, c = lengths
    gap = np.array([FOUR_BAR["d"] - a * np.cos(CRANK), -a * np.sin(CRANK)])
    length, slope = np.hypot(*gap), np.arctan2(gap[1], gap[0])
    at_b = np.arccos((b**2 + length**2 - c**2) / (2 * b * length))
    at_c = np.arccos((c**2 + length**2 - b**2) / (2 * c * length))
    q0 = np.array([CRANK, slope + at_b, slope - at_c])
    A = np.stack([-lengths * np.sin(q0), lengths * np.cos(q0)])
    v0 = RATE * np.array([1.0, *np.linalg.solve(A[:, 1:], -A[:, 0])])
    system = jl.System(
        links, ("crank", "coupler", "rocker"), constraints=(jl.Holonomic(closure, "pin"),)
    )
    return _started(system, q0, v0, FOUR_BAR)


def _started(
    system: jl.System, q0: np.ndarray, v0: np.ndarray, params: Mapping[str, float]
) -> Mechanism:
    T = 0.5 * v0 @ np.asarray(system.mass_matrix(q0, params=params)) @ v0
    return Mechanism(system, q0, v0, params, float(T))


# ---- Rolling bodies of the catalogue, with a spring on the steered wheels ------------------------

BOARD = {"m": 2.0, "r": 0.3, "J": 0.08, "J_r": 0.03, "J_w": 0.005, "k": 0.5}


def spring(t: Any, q: Array, params: Any) -> Array:
    """V of a torsion spring that centers the steering."""
    return 0.5 * params["k"] * q[4] ** 2


def sprung_snakeboard() -> Mechanism:
    """The wheels swing about the forward direction, so that the board moves on a winding path."""
    free = snakeboard.system
    system = jl.System(
        coordinates=free.coordinates.shapes,
        kinetic=snakeboard.kinetic,
        potential=spring,
        quasi=free.quasi,
    )
    q0 = np.array([0.0, 0.0, 0.0, 0.0, 0.4])
    u0 = {"xi": 2.0, "psidot": 6.0, "phidot": 0.5}
    return _started(system, q0, np.asarray(system.velocities(q0, u0, BOARD)), BOARD)


DISK = {"m": 1.5, "R": 0.25, "I_d": 0.025, "I_a": 0.045, "g": G}


def disk() -> Mechanism:
    """It rolls leaning and wobbling, fast enough not to fall."""
    system, q0 = rolling_disk.system, np.array([0.0, 0.0, 0.0, 1.2, 0.0])
    v0 = np.asarray(system.velocities(q0, {"w1": 0.3, "w2": 1.0, "w3": 12.0}, DISK))
    return _started(system, q0, v0, DISK)


LINKAGES: dict[str, Callable[[], Mechanism]] = {
    "double pendulum": double_pendulum,
    "four-bar": four_bar,
}
ROLLING: dict[str, Callable[[], Mechanism]] = {
    "snakeboard": sprung_snakeboard,
    "rolling disk": disk,
}
