"""Rounding errors of structure-preserving methods: random walks, momenta, reversal.

Rounding errors that are not systematic make a random walk. The error of the energy grows with the
square root of time, that of the phase of an orbit with the power 3/2 (Brouwer's law).

Source: Hairer, Lubich, Wanner, Geometric Numerical Integration, sec. VIII.5, IX.3.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._cases import Cases, Found, names

EPS = np.finfo(float).eps
LONG = 1_000_000  # steps

cases = Cases()


def wells(t: Any, q: Array, v: Array, params: Any) -> Array:
    """Henon and Heiles."""
    V = 0.5 * (q @ q) + q[0] ** 2 * q[1] - q[1] ** 3 / 3
    return 0.5 * (v @ v) - V


def arms(t: Any, q: Array, v: Array, params: Any) -> Array:
    """Double pendulum with m = l = 1."""
    c = jnp.cos(q[0] - q[1])
    T = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * c
    return T + 9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


def bobs(t: Any, q: Array, v: Array, params: Any) -> Array:
    """The same bobs as free points."""
    return 0.5 * (v @ v) - 9.81 * (q[1] + q[3])


def rods(t: Any, q: Array, params: Any) -> Array:
    """Their constraints."""
    d = q[2:] - q[:2]
    return jnp.stack([q[:2] @ q[:2] - 1.0, d @ d - 1.0])


def orbit(t: Any, q: Array, v: Array, params: Any) -> Array:
    """Kepler, mu = 1."""
    return 0.5 * (v @ v) + 1.0 / jnp.sqrt(q @ q)


WELLS, ARMS, ORBIT = (jl.System(L, ("a", "b")) for L in (wells, arms, orbit))
BOBS = jl.System(
    bobs, ("x1", "y1", "x2", "y2"), constraints=(jl.Holonomic(rods, ("rod1", "rod2")),)
)


def well_starts(count: int, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Starts inside the well; its rim has the energy 1/6."""
    random = np.random.default_rng(1)
    q = random.uniform(-0.25, 0.25, (count, 2)) + offset
    return q, random.uniform(-0.2, 0.2, (count, 2))


def small_arm_starts(count: int, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Starts of regular motions about the lowest position."""
    random = np.random.default_rng(2)
    return random.uniform(-0.3, 0.3, (count, 2)) + offset, np.zeros((count, 2))


def bob_starts(count: int, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The same starts of free points."""
    q, _ = small_arm_starts(count, offset)
    first = np.stack([np.sin(q[:, 0]), -np.cos(q[:, 0])], 1)
    second = np.stack([np.sin(q[:, 1]), -np.cos(q[:, 1])], 1)
    return np.concatenate([first, first + second], 1), np.zeros((count, 4))


def solved(system: jl.System, starts: Any, ts: np.ndarray, method: str, dt: float) -> jl.Solution:
    """All motions in one batch."""
    most = int(abs(ts[-1] - ts[0]) / dt) + 8 * len(ts)
    solve = jax.jit(
        jax.vmap(
            lambda q, v: jl.simulate(
                system, q, v, ts, {}, method=method, dt=dt, max_steps=most, throw=False
            )
        )
    )
    return solve(*map(jnp.asarray, starts))


def kepler_starts(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(q0, v0, eccentricities) at the pericenter, semi-major axis 1, in random directions."""
    random = np.random.default_rng(3)
    e, angle = random.uniform(0.05, 0.15, count), random.uniform(0, 2 * np.pi, count)
    along = np.stack([np.cos(angle), np.sin(angle)], 1)
    across = np.stack([-np.sin(angle), np.cos(angle)], 1)
    return (1 - e)[:, None] * along, np.sqrt((1 + e) / (1 - e))[:, None] * across, e


def kepler(q0: np.ndarray, v0: np.ndarray, e: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Exact positions, (starts, times, 2), of orbits of period 2 pi."""
    mean = np.remainder(t, 2 * np.pi)[None] * np.ones_like(e)[:, None]
    E = mean.copy()
    for _ in range(20):
        slope = 1 - e[:, None] * np.cos(E)
        E -= (E - e[:, None] * np.sin(E) - mean) / slope
    f = (np.cos(E) - e[:, None]) / (1 - e[:, None])
    g = np.sqrt(1 - e[:, None] ** 2) * np.sin(E) / np.linalg.norm(v0, axis=1)[:, None]
    return f[..., None] * q0[:, None] + g[..., None] * v0[:, None]


class Wandering(NamedTuple):
    """Errors of orbits after numbers of steps in geometric progression: (starts, numbers) each.

    Attributes:
        steps: the numbers of steps.
        energy: change of H.
        phase: time error of q along the orbit, s.
        spin: change of the angular momentum.
        statuses: of all motions.
    """

    steps: np.ndarray
    energy: np.ndarray
    phase: np.ndarray
    spin: np.ndarray
    statuses: tuple[str, ...]


# (steps per revolution, steps, whether to save at whole revolutions only). The truncation error is
# below rounding: with 17 stages of order 8 from 400 steps per revolution on, with Gauss's 4 stages,
# whose error constant is 1e-9, from 100 on. Order 4 would need 10^5 steps per revolution. Its
# energy error vanishes at whole revolutions. Its phase error does not: it grows with the exponent 1
# of a wrong period.
ORBITS = {
    "splitting8": (400, LONG, False),
    "gauss8": (120, 150_000, False),
    "variational4": (500, 100_000, True),
}
QUICK_ORBITS = 30_000


@cache
def wandering(method: str, quick: bool) -> Wandering:
    """Orbits with steps so short that only rounding errors remain."""
    per_revolution, steps, whole = ORBITS[method]
    steps, count = (QUICK_ORBITS, 32) if quick else (steps, 128)
    part = per_revolution if whole else 1
    saves = np.unique((np.geomspace(steps / 100, steps, 15) / part).round()).astype(int) * part
    q0, v0, e = kepler_starts(count)
    dt = 2 * np.pi / per_revolution
    ts = np.concatenate([[0.0], saves * dt])
    motions = solved(ORBIT, (q0, v0), ts, method, dt)
    energy, q, v = (np.asarray(x) for x in (motions.energy, motions.q, motions.v))
    behind = np.sum((q - kepler(q0, v0, e, ts)) * v, -1) / np.sum(v**2, -1)
    spin = q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0]
    energy, behind, spin = ((x - x[:, :1])[:, 1:] for x in (energy, behind, spin))
    return Wandering(saves, energy, behind, spin, names(motions.status))


def power(method: str, quick: bool, what: str, expected: float) -> Found:
    """Difference from the expected power of time with which the rms of an error grows."""
    motions = wandering(method, quick)
    size = np.sqrt(np.mean(getattr(motions, what) ** 2, axis=0))
    exponent = float(np.polyfit(np.log(motions.steps), np.log(size), 1)[0])
    details = f"exponent {exponent:.3f}, {size[-1] / EPS:.0f} eps after {motions.steps[-1]} steps"
    return Found(abs(exponent - expected), motions.statuses, details)


# The rms of 128 walks is known to 1 / sqrt(256), 6 %, at each of 15 numbers of steps over two
# decades. These share most of their steps, so the exponent is known to some 0.03.
def _add_power(method: str, what: str, expected: float) -> None:
    @cases.add(f"Brouwer's law: {what}, {method}", f"|exponent - {expected}|", 0.1)
    def run(quick: bool) -> Found:
        return power(method, quick, what, expected)


for _method, _what, _expected in (
    ("splitting8", "energy", 0.5),
    ("splitting8", "phase", 1.5),
    ("gauss8", "energy", 0.5),
    ("gauss8", "phase", 1.5),
    ("variational4", "energy", 0.5),
):
    _add_power(_method, _what, _expected)


def spin_walk(method: str, quick: bool) -> Found:
    """Change of the angular momentum of orbits, divided by a random walk of eps per step."""
    motions = wandering(method, quick)
    change = float(np.sqrt(np.mean(motions.spin[:, -1] ** 2)) / EPS)
    details = f"{change:.0f} eps after {motions.steps[-1]} steps"
    return Found(change / float(np.sqrt(motions.steps[-1])), motions.statuses, details)


# Forces are central and q x v is quadratic, so only rounding errors change it, each by 0.3 eps of
# |q| |v| rms. Splitting of order 8: 35 drifts and kicks, of two coordinates each: 0.3 sqrt(70) =
# 2.5. The others: q, v and p at the end and p at the start, doubled for the residuals of the
# stages: 0.3 sqrt(16) = 1.2. Orbits of e = 0.15 have |q| |v| up to 1.2; a factor 1.3 is for the
# spread.
def _add_spin(method: str, bound: float) -> None:
    @cases.add(f"angular momentum of orbits, {method}", "rms change, eps per root of a step", bound)
    def run(quick: bool) -> Found:
        return spin_walk(method, quick)


for _method, _bound in (("splitting8", 4.0), ("gauss8", 2.0), ("variational4", 2.0)):
    _add_spin(_method, _bound)


def reversal(system: jl.System, starts: Callable, method: str, dt: float, steps: int) -> Found:
    """Error after forward and backward motion, divided by the growth of perturbations.

    The growth is that of the difference of two motions, which is 1e-8 at the start.
    """
    q0, v0 = starts(8)
    span = np.array([0.0, steps * dt])
    forward = solved(system, (q0, v0), span, method, dt)
    perturbed = solved(system, starts(8, 1e-8), span, method, dt)
    growth = 1.0 + np.max(np.abs(np.asarray(perturbed.q - forward.q)[:, -1]), 1) / 1e-8
    back = solved(system, (forward.q[:, -1], forward.v[:, -1]), span[::-1], method, dt)
    error = np.max(np.abs(np.asarray(back.q)[:, -1] - q0), 1) / growth
    details = f"growth {np.min(growth):.3g} to {np.max(growth):.3g}"
    return Found(float(np.max(error) / EPS), names(forward.status) + names(back.status), details)


# A random walk forward and backward: 0.3 eps of the largest coordinate, times the square root of
# the number of rounding errors per step and of the number of steps; 3 for the largest of 8 motions.
# |q| up to 0.5, 13 or 35 drifts and kicks, 2000 steps: 3 * 0.3 * 0.5 * sqrt(13 or 35 * 2000).
@cases.add("there and back, splitting4", "error, eps of the growth", 75.0)
def reverse_fourth(quick: bool) -> Found:
    return reversal(WELLS, well_starts, "splitting4", 0.1, 1000)


@cases.add("there and back, splitting8", "error, eps of the growth", 120.0)
def reverse_eighth(quick: bool) -> Found:
    return reversal(WELLS, well_starts, "splitting8", 0.1, 1000)


# |v| up to 1.5, 8 rounding errors, 1000 steps: 3 * 0.3 * 1.5 * sqrt(8000).
@cases.add("there and back, gauss6", "error, eps of the growth", 120.0)
def reverse_gauss(quick: bool) -> Found:
    return reversal(ARMS, small_arm_starts, "gauss6", 0.01, 500)


# |q| up to 2, 12 rounding errors, 1000 steps: 3 * 0.3 * 2 * sqrt(12000).
@cases.add("there and back, variational2", "error, eps of the growth", 200.0)
def reverse_held(quick: bool) -> Found:
    return reversal(BOBS, bob_starts, "variational2", 0.01, 500)
