"""Energy over a million steps: the drift of structure-preserving methods, with its error.

Along a quasi-periodic motion, H oscillates about a mean with the frequencies of the motion. Its
means over the first and the second half of the run use smooth weights, which vanish with all
derivatives at the ends of each half. These means converge faster than any power of the length. An
oscillation of 10^12 eps therefore changes the drift by less than 1e-4 eps per step. The difference
of the two means is drift or rounding. The 20 starts have different values; their spread gives the
standard error of the mean. The figure is an upper limit of the drift, |mean| + 4 standard errors.
It exceeds its bound if there is a drift, or if the error is too large to exclude one.

Source: Das, Saiki, Sander, Yorke, Nonlinearity 30 (2017) 4111; Hairer, Lubich, Wanner, Geometric
Numerical Integration, sec. VIII.5, VIII.6.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._cases import Cases, Found, names
from bench.stability._long_runs import EPS, solved

cases = Cases()


def uneven(t: Any, q: Array, v: Array, params: Any) -> Array:
    """Henon and Heiles, with a frequency ratio of sqrt(2) instead of 1."""
    V = 0.5 * q[0] ** 2 + q[1] ** 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3
    return 0.5 * (v @ v) - V


def wire(t: Any, q: Array, v: Array, params: Any) -> Array:
    """A bead on a parabola: the mass depends on the position, so that L is not separable."""
    return 0.5 * (1.0 + q[0] ** 2) * v[0] ** 2 - 0.5 * q[0] ** 2


def bob(t: Any, q: Array, v: Array, params: Any) -> Array:
    """A spherical pendulum as a free point."""
    return 0.5 * (v @ v) - q[2]


def rod(t: Any, q: Array, params: Any) -> Array:
    """Its constraint."""
    return q @ q - 1.0


UNEVEN = jl.System(uneven, ("a", "b"))
WIRE = jl.System(wire, ("x",))
BOB = jl.System(bob, ("x", "y", "z"), constraints=(jl.Holonomic(rod, "rod"),))


def uneven_starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts with at most 0.02 of the energy of the rim, where all motions are regular."""
    random = np.random.default_rng(1)
    return random.uniform(-0.1, 0.1, (count, 2)), random.uniform(-0.1, 0.1, (count, 2))


def wire_starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.random.default_rng(2).uniform(0.5, 1.0, (count, 1)), np.zeros((count, 1))


def bob_starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Thrown sideways."""
    random = np.random.default_rng(3)
    angle, rate = random.uniform(0.6, 1.0, count), random.uniform(0.5, 1.0, count)
    zero = np.zeros(count)
    q = np.stack([np.sin(angle), zero, -np.cos(angle)], 1)
    return q, np.stack([zero, np.sin(angle) * rate, zero], 1)


class Long(NamedTuple):
    """The saved quantities of a long run.

    Attributes:
        energy: (starts, saves), change of H divided by the largest kinetic energy.
        spin: (starts, saves), relative change of x v_y - y v_x; for spherical pendulums.
        every: steps between save times.
        statuses: of all motions.
    """

    energy: np.ndarray
    spin: np.ndarray | None
    every: int
    statuses: tuple[str, ...]


class Setting(NamedTuple):
    """The problem that a method solves."""

    system: jl.System
    starts: Callable[[int], tuple[np.ndarray, np.ndarray]]
    dt: float


SPLIT, CURVED, HELD = (
    Setting(UNEVEN, uneven_starts, 0.1),
    Setting(WIRE, wire_starts, 0.1),
    Setting(BOB, bob_starts, 0.05),
)
SETTINGS = {
    **{f"splitting{order}": SPLIT for order in (2, 4, 6, 8)},
    **{f"gauss{order}": CURVED for order in (2, 4, 6, 8)},
    **{f"variational{order}": HELD for order in (2, 4)},
}


class Length(NamedTuple):
    """The length of runs, and the number of starts."""

    steps: int
    half: int  # save times of one half: a second or two apart, a third of a period
    starts: int


FULL, BRIEF = Length(1_000_000, 25_000, 20), Length(30_000, 1_500, 8)


@cache
def long_run(method: str, length: Length, dtype: Any = np.float64) -> Long:
    """Motions saved at ends of steps."""
    system, starts, dt = SETTINGS[method]
    every = length.steps // (2 * length.half)
    ts = np.arange(2 * length.half + 1) * (every * dt)
    given = [x.astype(dtype) for x in starts(length.starts)]
    motions = solved(system, given, ts, method, dt)
    q, v = np.asarray(motions.q), np.asarray(motions.v)
    energy = np.asarray(motions.energy, float)
    top = np.max(0.5 * np.sum(v**2, -1), axis=1, keepdims=True)
    spin = None
    if system is BOB:
        spin = q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0]
        spin = spin / spin[:, :1] - 1.0
    return Long((energy - energy[:, :1]) / top, spin, every, names(motions.status))


def smooth_mean(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis with weights exp(-1 / (x (1 - x))), x from 0 to 1."""
    count = values.shape[-1]
    x = (np.arange(count) + 0.5) / count
    weights = np.exp(-1.0 / (x * (1.0 - x)))
    return values @ (weights / np.sum(weights))


def drifts(values: np.ndarray, every: int) -> np.ndarray:
    """Drift per step of each motion; `values` (starts, saves) are `every` steps apart."""
    half = values.shape[-1] // 2
    first, second = smooth_mean(values[:, :half]), smooth_mean(values[:, half : 2 * half])
    return (second - first) / (half * every)


def drift(
    values: np.ndarray, every: int, statuses: tuple[str, ...], rounding: float = EPS
) -> Found:
    """|mean| + 4 standard errors of the drift, in units of `rounding` per step."""
    per_step = drifts(values, every) / rounding
    mean, error = np.mean(per_step), np.std(per_step, ddof=1) / np.sqrt(len(per_step))
    details = f"mean {mean:.2e} +- {error:.1e} eps per step"
    return Found(float(abs(mean) + 4 * error), statuses, details)


def walked(roundings: int, length: Length) -> float:
    """Bound on |mean| + 4 standard errors if there is no drift, eps per step.

    A rounding error changes a number by at most half an eps of it, 0.29 eps rms, and H by 0.6 eps
    of the largest kinetic energy. The squares of `roundings` such errors per step add up, and the
    steps form a random walk. Between the centers of its halves a walk of N steps changes by at
    most sigma sqrt(N / 2), per step sigma sqrt(2 / N). The mean of the starts is within 4 standard
    errors of 0.
    """
    return 8.0 * 0.6 * float(np.sqrt(roundings * 2.0 / (length.steps * length.starts)))


# Rounding errors per step. Splitting: s kicks, s + 1 drifts. Gauss: those of q, p and v at the end
# and of p at the start, doubled for the residuals of the stages. With constraints: three
# coordinates, and the constraint impulse.
ROUNDINGS = {
    **{f"splitting{order}": 2 * kicks + 1 for order, kicks in ((2, 1), (4, 6), (6, 11), (8, 17))},
    **dict.fromkeys(("gauss2", "gauss4", "gauss6", "gauss8"), 8),
    **dict.fromkeys(("variational2", "variational4"), 24),
}

# Systematic errors. Coefficients are rounded: b_i a_ij + b_j a_ji - b_i b_j, which should vanish,
# adds up to 0.9 eps (4 stages). It changes H by (h w)^2 of that relative to v^2 / 2: 0.02 eps.
# The end of a step violates the constraint of the rod by a rounding error of |q|^2. Its mean may be
# eps / 8, because numbers below 1 are twice as dense as those above: eps / 16 of the length. The
# next step corrects it along the previous direction of the rod. This leaves w times the error in v,
# at most eps / 8 in v^2 / 2.
SYSTEMATIC = {"splitting": 0.0, "gauss": 0.02, "variational": 0.125}


def most(method: str, length: Length) -> float:
    """Bound on a drift, eps per step."""
    return SYSTEMATIC[method.rstrip("2468")] + walked(ROUNDINGS[method], length)


FIGURE = "|drift| + 4 se, eps per step"


def _add_drift(method: str) -> None:
    name = f"energy over a million steps, {method}"

    @cases.add(name, FIGURE, most(method, FULL), quick_bound=most(method, BRIEF))
    def run(quick: bool) -> Found:
        motions = long_run(method, BRIEF if quick else FULL)
        return drift(motions.energy, motions.every, motions.statuses)


for _method in SETTINGS:
    _add_drift(_method)


# As for the energy: gravity and the rod have no moment about the vertical. So there are only the
# same rounding errors, of x v_y and y v_x, and the same systematic error along the rod.
def _add_spin(method: str) -> None:
    name = f"angular momentum of spherical pendulums, {method}"

    @cases.add(name, FIGURE, most(method, FULL), quick_bound=most(method, BRIEF))
    def run(quick: bool) -> Found:
        motions = long_run(method, BRIEF if quick else FULL)
        assert motions.spin is not None
        return drift(motions.spin, motions.every, motions.statuses)


for _method in ("variational2", "variational4"):
    _add_spin(_method)
