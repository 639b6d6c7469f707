"""Energy over a million steps: the drift of methods that keep a structure, with its error.

On a motion that is quasi-periodic, H oscillates about a mean with the frequencies of the motion.
Its means over the first and the second half of the run are taken with weights that are smooth to
all orders and vanish with all derivatives at the ends of a half: they converge faster than any
power of its length, so that of an oscillation of 10^12 roundings less than a ten-thousandth of one
is left per step. Their difference is drift or round-off. Motions from 20 starts have differences
of their own, whose spread is the error of their mean. The figure is what the drift may be at most,
|mean| + 4 standard errors: it is beyond its bound where there is a drift, and where the error is
too large to tell.

Source: Das, Saiki, Sander, Yorke, Nonlinearity 30 (2017) 4111; Hairer, Lubich, Wanner, Geometric
Numerical Integration, sec. VIII.5, VIII.6.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._long_runs import EPS, solved
from bench.stability._rows import Found, Rows, names

rows = Rows()


def uneven(t: Any, q: Array, v: Array, params: Any) -> Array:
    """Henon and Heiles, with frequencies whose ratio is the root of 2 in place of 1."""
    V = 0.5 * q[0] ** 2 + q[1] ** 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3
    return 0.5 * (v @ v) - V


def wire(t: Any, q: Array, v: Array, params: Any) -> Array:
    """A bead on a parabola: the mass depends on the position, so that L does not separate."""
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
    """At 0.02 of the energy of the rim at most, where all is regular."""
    random = np.random.default_rng(1)
    return random.uniform(-0.1, 0.1, (count, 2)), random.uniform(-0.1, 0.1, (count, 2))


def wire_starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.random.default_rng(2).uniform(0.5, 1.0, (count, 1)), np.zeros((count, 1))


def bob_starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Thrown sideways."""
    random = np.random.default_rng(3)
    angle, rate = random.uniform(0.6, 1.0, count), random.uniform(0.5, 1.0, count)
    still = np.zeros(count)
    q = np.stack([np.sin(angle), still, -np.cos(angle)], 1)
    return q, np.stack([still, np.sin(angle) * rate, still], 1)


class Long(NamedTuple):
    """What is kept of a long run.

    Attributes:
        energy: (starts, rows), change of H over the largest kinetic energy.
        spin: (starts, rows), change of x v_y - y v_x over its size; of spherical pendulums.
        every: steps from row to row.
        statuses: of all motions.
    """

    energy: np.ndarray
    spin: np.ndarray | None
    every: int
    statuses: tuple[str, ...]


class Setting(NamedTuple):
    """What a method is run on."""

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
    """How long runs are, and how many starts there are."""

    steps: int
    half: int  # rows of one half: a second or two apart, a third of a period
    starts: int


FULL, BRIEF = Length(1_000_000, 25_000, 20), Length(30_000, 1_500, 8)


@cache
def long_run(method: str, length: Length, dtype: Any = np.float64) -> Long:
    """Motions whose rows are ends of steps."""
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
    """Change per step of each line of `values`, whose rows are `every` steps apart."""
    half = values.shape[-1] // 2
    first, second = smooth_mean(values[:, :half]), smooth_mean(values[:, half : 2 * half])
    return (second - first) / (half * every)


def drift(
    values: np.ndarray, every: int, statuses: tuple[str, ...], rounding: float = EPS
) -> Found:
    """|mean| + 4 standard errors of the drift, in roundings per step."""
    per_step = drifts(values, every) / rounding
    mean, error = np.mean(per_step), np.std(per_step, ddof=1) / np.sqrt(len(per_step))
    details = f"mean {mean:.2e} +- {error:.1e} eps per step"
    return Found(float(abs(mean) + 4 * error), statuses, details)


def walked(roundings: int, length: Length) -> float:
    """What |mean| + 4 standard errors are at most where there is no drift, eps per step.

    A rounding moves one number by half an eps of it at most, 0.29 eps in the mean square, and H by
    0.6 eps of the largest kinetic energy; `roundings` of them a step add in squares, and steps make
    a walk. Between the centres of its halves a walk of N steps changes by sigma sqrt(N / 2) at
    most, per step sigma sqrt(2 / N); the mean of the starts is within 4 standard errors of 0.
    """
    return 8.0 * 0.6 * float(np.sqrt(roundings * 2.0 / (length.steps * length.starts)))


# Roundings of a step. Splitting: s kicks, s + 1 drifts. Gauss: those of q, p and v at its end and
# of p at its start, each twice for what is left of the stages. Under constraints three coordinates,
# and the impulse.
ROUNDINGS = {
    **{f"splitting{order}": 2 * kicks + 1 for order, kicks in ((2, 1), (4, 6), (6, 11), (8, 17))},
    **dict.fromkeys(("gauss2", "gauss4", "gauss6", "gauss8"), 8),
    **dict.fromkeys(("variational2", "variational4"), 24),
}

# What may be systematic. Coefficients are rounded: b_i a_ij + b_j a_ji - b_i b_j, which should
# vanish, adds up to 0.9 eps (4 stages) and changes H by (h w)^2 of that over v^2 / 2: 0.02 eps.
# The end of a step misses the rod by a rounding of |q|^2, whose mean may be eps / 8, as numbers
# below 1 are twice as dense as those above: eps / 16 of the length. The next step makes up for it
# along the rod as it was, and leaves w times that in v, at most eps / 8 in v^2 / 2.
SYSTEMATIC = {"splitting": 0.0, "gauss": 0.02, "variational": 0.125}


def most(method: str, length: Length) -> float:
    """Bound on a drift, eps per step."""
    return SYSTEMATIC[method.rstrip("2468")] + walked(ROUNDINGS[method], length)


FIGURE = "|drift| + 4 se, eps per step"


def _add_drift(method: str) -> None:
    name = f"energy over a million steps, {method}"

    @rows.row(name, FIGURE, most(method, FULL), quick_bound=most(method, BRIEF))
    def run(quick: bool) -> Found:
        motions = long_run(method, BRIEF if quick else FULL)
        return drift(motions.energy, motions.every, motions.statuses)


for _method in SETTINGS:
    _add_drift(_method)


# As with the energy: gravity and the rod have no moment about the vertical, so that what is left
# are the same roundings, of x v_y and y v_x, and the same leak along the rod.
def _add_spin(method: str) -> None:
    name = f"angular momentum of spherical pendulums, {method}"

    @rows.row(name, FIGURE, most(method, FULL), quick_bound=most(method, BRIEF))
    def run(quick: bool) -> Found:
        motions = long_run(method, BRIEF if quick else FULL)
        assert motions.spin is not None
        return drift(motions.spin, motions.every, motions.statuses)


for _method in ("variational2", "variational4"):
    _add_spin(_method)
