"""Long runs of the methods that keep a structure: energy, round-off, momenta, reversal.

A drift is judged with its error: motions from 20 starts have slopes of their energy that differ,
and their mean has the standard error of independent values. What is beyond four of these is
systematic; it may be a twentieth of a rounding per step. Round-off that is not systematic walks:
energy with the square root of time, the phase of an orbit with the power 3/2 (Brouwer's law).

Source: Hairer, Lubich, Wanner, Geometric Numerical Integration, sec. VIII.5, IX.3.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench._stress import Found, Rows, names

EPS = np.finfo(float).eps
LONG, QUICK = 1_000_000, 10_000  # steps
ROWS = 101

rows = Rows()


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
    """The same as free points."""
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


def well_starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Inside the well, whose rim is at 1/6."""
    random = np.random.default_rng(1)
    return random.uniform(-0.25, 0.25, (count, 2)), random.uniform(-0.2, 0.2, (count, 2))


def arm_starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(2)
    return random.uniform(-1.0, 1.0, (count, 2)), np.zeros((count, 2))


def bob_starts(count: int) -> tuple[np.ndarray, np.ndarray]:
    q = arm_starts(count)[0]
    first = np.stack([np.sin(q[:, 0]), -np.cos(q[:, 0])], 1)
    second = np.stack([np.sin(q[:, 1]), -np.cos(q[:, 1])], 1)
    return np.concatenate([first, first + second], 1), np.zeros((count, 4))


def solved(system: jl.System, starts: Any, ts: np.ndarray, method: str, dt: float) -> jl.Solution:
    """All motions at once."""
    most = int(abs(ts[-1] - ts[0]) / dt) + 8 * len(ts)
    solve = jax.jit(
        jax.vmap(
            lambda q, v: jl.simulate(
                system, q, v, ts, {}, method=method, dt=dt, max_steps=most, throw=False
            )
        )
    )
    return solve(*map(jnp.asarray, starts))


def drift(system: jl.System, starts: Callable, method: str, dt: float, quick: bool) -> Found:
    """Systematic drift beyond four standard errors, in roundings of H's scale per step."""
    steps, count = (QUICK, 8) if quick else (LONG, 20)
    ts = np.linspace(0.0, steps * dt, ROWS)
    motions = solved(system, starts(count), ts, method, dt)
    energy = np.asarray(motions.energy)
    scale = np.max(np.abs(0.5 * np.sum(np.asarray(motions.v) ** 2, -1)), axis=1, keepdims=True)
    error = (energy - energy[:, :1]) / scale
    per_step = np.polynomial.polynomial.polyfit(np.linspace(0, steps, ROWS), error.T, 1)[1]
    mean, deviation = np.mean(per_step), np.std(per_step, ddof=1) / np.sqrt(count)
    return Found(float(max(abs(mean) - 4 * deviation, 0.0) / EPS), names(motions.status))


DRIFTS = {
    "splitting2": (WELLS, well_starts, 0.1),
    "splitting4": (WELLS, well_starts, 0.1),
    "splitting6": (WELLS, well_starts, 0.1),
    "splitting8": (WELLS, well_starts, 0.1),
    "gauss4": (ARMS, arm_starts, 0.01),
    "gauss8": (ARMS, arm_starts, 0.01),
    "variational2": (BOBS, bob_starts, 0.01),
    "variational4": (BOBS, bob_starts, 0.01),
}


def _add_drift(method: str) -> None:
    system, starts, dt = DRIFTS[method]

    @rows.row(f"energy over a million steps, {method}", "drift, eps per step", 0.05)
    def run(quick: bool) -> Found:
        return drift(system, starts, method, dt, quick)


for _method in DRIFTS:
    _add_drift(_method)


def kepler_starts(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(q0, v0, eccentricities) at the pericentre, semi-major axis 1, turned by chance."""
    random = np.random.default_rng(3)
    e, turn = random.uniform(0.05, 0.15, count), random.uniform(0, 2 * np.pi, count)
    along = np.stack([np.cos(turn), np.sin(turn)], 1)
    across = np.stack([-np.sin(turn), np.cos(turn)], 1)
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


@cache
def exponents(quick: bool) -> tuple[float, float, tuple[str, ...]]:
    """Powers of time with which energy and phase wander, from steps too short to see."""
    steps, count = (30_000, 32) if quick else (LONG, 128)
    q0, v0, e = kepler_starts(count)
    dt = 2 * np.pi / 400
    ts = np.concatenate([[0.0], np.geomspace(steps / 100, steps, 15).round() * dt])
    motions = solved(ORBIT, (q0, v0), ts, "splitting8", dt)
    energy = np.asarray(motions.energy)
    q, v = np.asarray(motions.q), np.asarray(motions.v)
    behind = np.sum((q - kepler(q0, v0, e, ts)) * v, -1) / np.sum(v**2, -1)

    def power(error: np.ndarray) -> float:
        size = np.sqrt(np.mean(error[:, 1:] ** 2, axis=0))
        return float(np.polyfit(np.log(ts[1:]), np.log(size), 1)[0])

    return power(energy - energy[:, :1]), power(behind), names(motions.status)


@rows.row("Brouwer's law: energy, splitting8", "|exponent - 0.5|", 0.1)
def brouwer_energy(quick: bool) -> Found:
    power, _, statuses = exponents(quick)
    return Found(abs(power - 0.5), statuses)


@rows.row("Brouwer's law: phase, splitting8", "|exponent - 1.5|", 0.1)
def brouwer_phase(quick: bool) -> Found:
    _, power, statuses = exponents(quick)
    return Found(abs(power - 1.5), statuses)


def reversal(system: jl.System, starts: Callable, method: str, dt: float, steps: int) -> Found:
    """There and back, over the growth of the perturbations on the way (two motions 1e-8 apart)."""
    q0, v0 = starts(8)
    span = np.array([0.0, steps * dt])
    there = solved(system, (q0, v0), span, method, dt)
    beside = solved(system, (q0 + 1e-8 * (q0 != 0), v0), span, method, dt)
    growth = 1.0 + np.max(np.abs(np.asarray(beside.q - there.q)[:, -1]), 1) / 1e-8
    back = solved(system, (there.q[:, -1], there.v[:, -1]), span[::-1], method, dt)
    error = np.max(np.abs(np.asarray(back.q)[:, -1] - q0), 1) / growth
    return Found(float(np.max(error) / EPS), names(there.status) + names(back.status))


# A walk of 2 * 1000 steps of some roundings each, with roundings of v for as many steps.
@rows.row("there and back, splitting8", "error, eps of the growth", 1e5)
def reverse_splitting(quick: bool) -> Found:
    return reversal(WELLS, well_starts, "splitting8", 0.1, 1000)


@rows.row("there and back, gauss6", "error, eps of the growth", 1e5)
def reverse_gauss(quick: bool) -> Found:
    return reversal(ARMS, lambda n: (0.3 * arm_starts(n)[0], arm_starts(n)[1]), "gauss6", 0.01, 500)


@rows.row("angular momentum of orbits, splitting6", "rms change, eps per root of a step", 8.0)
def momentum(quick: bool) -> Found:
    steps = QUICK if quick else LONG
    q0, v0, _ = kepler_starts(20)
    dt = 2 * np.pi / 200
    motions = solved(ORBIT, (q0, v0), np.array([0.0, steps * dt]), "splitting6", dt)
    q, v = np.asarray(motions.q), np.asarray(motions.v)
    spin = q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0]
    change = np.sqrt(np.mean((spin[:, -1] - spin[:, 0]) ** 2))
    return Found(float(change / EPS / np.sqrt(steps)), names(motions.status))
