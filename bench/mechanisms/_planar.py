"""Planar mechanisms; x to the right, y upward, angles of links from the x axis."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bench.mechanisms import _equations
from bench.mechanisms._scene import Scene

G = 9.81


def ray(angle: Any) -> Array:
    """Unit vectors along angles."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)


# ---- Andrews' squeezer (Schiehlen, Multibody Systems Handbook, 1990) -----------------------------

SQUEEZER = {
    "m1": 0.04325,
    "m2": 0.00365,
    "m3": 0.02373,
    "m4": 0.00706,
    "m5": 0.0705,
    "m6": 0.00706,
    "m7": 0.05498,
    "i1": 2.194e-6,
    "i2": 4.41e-7,
    "i3": 5.255e-6,
    "i4": 5.667e-7,
    "i5": 1.169e-5,
    "i6": 5.667e-7,
    "i7": 1.912e-5,
    "xa": -0.06934,
    "ya": -0.00227,
    "xb": -0.03635,
    "yb": 0.03273,
    "xc": 0.014,
    "yc": 0.072,
    "c0": 4530.0,
    "l0": 0.07785,
    "d": 0.028,
    "da": 0.0115,
    "e": 0.02,
    "ea": 0.01421,
    "rr": 0.007,
    "ra": 0.00092,
    "ss": 0.035,
    "sa": 0.01874,
    "sb": 0.01043,
    "sc": 0.018,
    "sd": 0.02,
    "ta": 0.02308,
    "tb": 0.00916,
    "u": 0.04,
    "ua": 0.01228,
    "ub": 0.00449,
    "zf": 0.02,
    "zt": 0.04,
    "fa": 0.01421,
    "mom": 0.033,
}


def _across(angle: Any) -> Array:
    return jnp.stack([jnp.sin(angle), -jnp.cos(angle)])


def _squeezer_centers(q: Array, p: Any) -> Array:
    beta, theta, _, phi, delta, omega, epsilon = q
    fixed = jnp.stack([p["xa"], p["ya"]])
    second = p["rr"] * ray(beta) - p["da"] * ray(beta + theta)
    fourth = fixed + p["zt"] * ray(delta) + (p["e"] - p["ea"]) * _across(phi + delta)
    sixth = fixed + p["u"] * _across(epsilon) + (p["zf"] - p["fa"]) * ray(omega + epsilon)
    return jnp.stack([second, fourth, sixth])


def squeezer_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Seven bodies, a spring, a constant driving torque."""
    beta, theta, gamma, phi, delta, omega, epsilon = v
    rates = jax.jvp(lambda q: _squeezer_centers(q, p), (q,), (v,))[1]
    masses = jnp.stack([p["m2"], p["m4"], p["m6"]])
    T = masses @ jnp.sum(rates**2, 1)
    T += (p["m1"] * p["ra"] ** 2 + p["i1"]) * beta**2 + p["i2"] * (beta + theta) ** 2
    T += (p["m3"] * (p["sa"] ** 2 + p["sb"] ** 2) + p["i3"]) * gamma**2
    T += (p["m5"] * (p["ta"] ** 2 + p["tb"] ** 2) + p["i5"]) * delta**2
    T += (p["m7"] * (p["ua"] ** 2 + p["ub"] ** 2) + p["i7"]) * epsilon**2
    T += p["i4"] * (phi + delta) ** 2 + p["i6"] * (omega + epsilon) ** 2
    held = jnp.stack([p["xb"], p["yb"]]) + p["sd"] * ray(q[2]) + p["sc"] * _across(q[2])
    stretch = jnp.sqrt(jnp.sum((held - jnp.stack([p["xc"], p["yc"]])) ** 2)) - p["l0"]
    return 0.5 * T - 0.5 * p["c0"] * stretch**2 + p["mom"] * q[0]


def squeezer_loops(t: Any, q: Array, p: Any) -> Array:
    """Three chains end in one point."""
    beta, theta, gamma, phi, delta, omega, epsilon = q
    common = p["rr"] * ray(beta) - p["d"] * ray(beta + theta)
    a, b = jnp.stack([p["xa"], p["ya"]]), jnp.stack([p["xb"], p["yb"]])
    first = common - b - p["ss"] * _across(gamma)
    second = common - a - p["zt"] * ray(delta) - p["e"] * _across(phi + delta)
    third = common - a - p["u"] * _across(epsilon) - p["zf"] * ray(omega + epsilon)
    return jnp.concatenate([first, second, third])


def squeezer() -> Scene:
    """Its published start and end (Mazzia, Magherini, Test Set for IVP Solvers, problem II-9)."""
    q0 = [-0.06171389001427645, 0.0, 0.45527981916307038, 0.22266839016588588]
    q0 += [0.48736497954384255, -0.22266839016588588, 1.2305474445498212]
    end = [15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948]
    end += [0.5244099658805304, 0.5347301163226948, 1.048080741042263]
    names = ("beta", "theta", "gamma", "phi", "delta", "omega", "epsilon")
    return Scene(
        squeezer_lagrangian, names, SQUEEZER, np.array(q0), np.zeros(7), 0.03, 2e-5,
        lambda: np.array(end), squeezer_loops,
    )  # fmt: skip


# ---- Flyball governor on a slider-crank engine ---------------------------------------------------

GOVERNOR = {"r": 0.1, "l": 0.4, "J": 0.02, "m_rod": 0.8, "m_piston": 0.5, "ratio": 1.5, "e": 0.05}
GOVERNOR |= {"a": 0.2, "m_ball": 0.6, "m_sleeve": 0.4, "torque": 3.0, "d": 0.05, "g": G}


def governor_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Crank, rod and piston lie in a horizontal plane; balls swing on a vertical shaft."""
    crank, rod, x, shaft, arm, z = v
    center = lambda q: p["r"] * ray(q[0]) + 0.5 * p["l"] * ray(q[1])  # noqa: E731
    rod_rate = jax.jvp(center, (q,), (v,))[1]
    T = p["J"] * crank**2 + p["m_piston"] * x**2
    T += p["m_rod"] * (rod_rate @ rod_rate + p["l"] ** 2 / 12.0 * rod**2)
    radius = p["e"] + p["a"] * jnp.sin(q[4])
    T += 2.0 * p["m_ball"] * ((p["a"] * arm) ** 2 + (radius * shaft) ** 2) + p["m_sleeve"] * z**2
    V = p["g"] * (p["m_sleeve"] * q[5] - 2.0 * p["m_ball"] * p["a"] * jnp.cos(q[4]))
    return 0.5 * T - V


def governor_rows(t: Any, q: Array, p: Any) -> Array:
    """The slider-crank, the gear, the sleeve at the lower ends of the arms."""
    x, y = p["r"] * ray(q[0]) + p["l"] * ray(q[1])
    return jnp.stack([x - q[2], y, q[3] - p["ratio"] * q[0], q[5] + 2.0 * p["a"] * jnp.cos(q[4])])


def valve(t: Any, q: Array, v: Array, p: Any) -> Array:
    """The torque on the crank decreases as the sleeve rises."""
    torque = -p["torque"] * q[5] / (2.0 * p["a"]) - p["d"] * v[0]
    return jnp.zeros_like(q).at[0].set(torque)


def governor() -> Scene:
    """It starts at 5 rad/s with its arms at 0.5 rad."""
    p, crank, rate, arm = GOVERNOR, 0.7, 5.0, 0.5
    rod = -np.arcsin(p["r"] * np.sin(crank) / p["l"])
    x = p["r"] * np.cos(crank) + p["l"] * np.cos(rod)
    q0 = np.array([crank, rod, x, p["ratio"] * crank, arm, -2.0 * p["a"] * np.cos(arm)])
    rod_rate = -p["r"] * np.cos(crank) * rate / (p["l"] * np.cos(rod))
    x_rate = -p["r"] * np.sin(crank) * rate - p["l"] * np.sin(rod) * rod_rate
    v0 = np.array([rate, rod_rate, x_rate, p["ratio"] * rate, 0.0, 0.0])
    end = partial(_equations.governor, p, crank, rate, arm, 2.0)
    names = ("crank", "rod", "x", "shaft", "arm", "z")
    return Scene(
        governor_lagrangian, names, p, q0, v0, 2.0, 4e-3, end, governor_rows, force=valve
    )  # fmt: skip


# ---- A row of four-bars, all parallelograms (Gonzalez et al., library of benchmarks, 2006) -------


def _bars(n: int) -> tuple[Any, Any]:
    """L and rows of n parallelograms, q: angles of n + 1 cranks, of n couplers."""

    def lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
        rates = p["l"] * v[:, None] * jnp.stack([-jnp.sin(q), jnp.cos(q)], -1)
        couplers = rates[:n] + 0.5 * rates[n + 1 :]
        cranks, spin = jnp.sum(rates[: n + 1] ** 2) / 3.0, jnp.sum(rates[n + 1 :] ** 2) / 12.0
        heights = p["l"] * jnp.sin(q)
        V = jnp.sum(0.5 * heights[: n + 1]) + jnp.sum(heights[:n] + 0.5 * heights[n + 1 :])
        return p["m"] * (0.5 * (cranks + spin + jnp.sum(couplers**2)) - p["g"] * V)

    def closed(t: Any, q: Array, p: Any) -> Array:
        heads = p["l"] * ray(q)
        gap = heads[:n] + heads[n + 1 :] - heads[1 : n + 1]
        return (gap - jnp.stack([p["l"], jnp.zeros_like(p["l"])])).reshape(-1)

    return lagrangian, closed


def four_bars(n: int) -> Scene:
    """The cranks swing about the downward vertical; couplers stay level."""
    p, angle, rate, t1 = {"m": 1.0, "l": 1.0, "g": G}, -1.0, 1.0, 5.0
    lagrangian, closed = _bars(n)
    q0 = np.concatenate([np.full(n + 1, angle), np.zeros(n)])
    v0 = np.concatenate([np.full(n + 1, rate), np.zeros(n)])
    names = (*(f"crank{i}" for i in range(n + 1)), *(f"coupler{i}" for i in range(n)))

    def end() -> np.ndarray:
        crank = _equations.parallelograms(n, p, angle, rate, t1)
        return np.concatenate([np.full(n + 1, crank), np.zeros(n)])

    return Scene(lagrangian, names, p, q0, v0, t1, 1e-2, end, closed)


# ---- Rods in a row, each with its own coordinates ------------------------------------------------


def rods_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Uniform rods, each by its center and its angle."""
    rods, rates = q.reshape(-1, 3), v.reshape(-1, 3)
    T = jnp.sum(rates[:, :2] ** 2) + p["l"] ** 2 / 12.0 * jnp.sum(rates[:, 2] ** 2)
    return p["m"] * (0.5 * T - p["g"] * jnp.sum(rods[:, 1]))


def pins(t: Any, q: Array, p: Any) -> Array:
    """The head of every rod is the tail of the next one; the first one hangs at the origin."""
    rods = q.reshape(-1, 3)
    half = 0.5 * p["l"] * ray(rods[:, 2])
    heads, tails = rods[:, :2] + half, rods[:, :2] - half
    return (tails - jnp.concatenate([jnp.zeros_like(heads[:1]), heads[:-1]])).reshape(-1)


def rods(n: int) -> Scene:
    """They start at rest, bent."""
    p, t1 = {"m": 0.1, "l": 0.1, "g": G}, 1.0
    angles = -0.5 * np.pi + np.linspace(0.6, -0.3, n)
    reach = p["l"] * (np.tril(np.ones((n, n)), -1) + 0.5 * np.eye(n))  # of centers along links

    def placed(angles: np.ndarray) -> np.ndarray:
        centers = reach @ np.stack([np.cos(angles), np.sin(angles)], -1)
        return np.column_stack([centers, angles]).ravel()

    def end() -> np.ndarray:
        spin = np.full(n, p["m"] * p["l"] ** 2 / 12.0)
        links = _equations.Links(reach, np.full(n, p["m"]), spin, p["g"])
        return placed(links.end(angles, np.zeros(n), t1))

    names = tuple(f"{x}{i}" for i in range(n) for x in ("x", "y", "angle"))
    q0 = placed(angles)
    return Scene(rods_lagrangian, names, p, q0, np.zeros(3 * n), t1, 2e-3, end, pins)


# ---- A walker of seven links, standing on one foot -----------------------------------------------

WALKER = {
    "m": np.array([30.0, 7.0, 4.0, 1.0, 7.0, 4.0, 1.0]),  # torso, then thigh, shank, foot, twice
    "l": np.array([0.6, 0.4, 0.4, 0.2, 0.4, 0.4, 0.2]),
    "J": np.array([1.5, 0.1, 0.06, 0.004, 0.1, 0.06, 0.004]),
    "k": np.array([200.0, 100.0, 400.0, 200.0, 100.0, 20.0]),  # hip, knee, ankle, twice
    "g": G,
}
WALKER_REST = np.array([1.6, -1.4, -1.7, 0.0, -1.9, -2.1, -0.5])
JOINTS = ((0, 1), (1, 2), (2, 3), (0, 4), (4, 5), (5, 6))


def _walker_centers(q: Array, p: Any) -> Array:
    """Centers of the links, from the hip (q[0], q[1])."""
    hip, links = q[:2], p["l"][:, None] * ray(q[2:])
    legs = []
    for first in (1, 4):
        knee, ankle = hip + links[first], hip + links[first] + links[first + 1]
        legs += [hip + 0.5 * links[first], knee + 0.5 * links[first + 1]]
        legs += [ankle + 0.5 * links[first + 2]]
    return jnp.stack([hip + 0.5 * links[0], *legs])


def walker_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Links with springs in the joints."""
    rates = jax.jvp(lambda q: _walker_centers(q, p), (q,), (v,))[1]
    T = 0.5 * (p["m"] @ jnp.sum(rates**2, 1) + p["J"] @ v[2:] ** 2)
    first, second = np.array(JOINTS).T
    bent = (q[2:] - WALKER_REST)[first] - (q[2:] - WALKER_REST)[second]
    return T - p["g"] * p["m"] @ _walker_centers(q, p)[:, 1] - 0.5 * p["k"] @ bent**2


def standing(t: Any, q: Array, p: Any) -> Array:
    """The first ankle rests at the origin, and its foot lies flat."""
    ankle = q[:2] + p["l"][1] * ray(q[3]) + p["l"][2] * ray(q[4])
    return jnp.append(ankle, q[5])


def walker() -> Scene:
    """It swings its other leg."""
    p, t1 = WALKER, 1.0
    angles, rates = WALKER_REST + np.array([0.05, 0.1, 0, 0, 0.4, -0.3, 0.2]), np.zeros(7)
    rates[[0, 4, 5]] = 0.3, 2.0, 1.0
    # From the ankle up the first leg, and down the second one.
    m, links = p["m"], p["l"]
    reach = np.zeros((7, 7))
    reach[:, 1], reach[:, 2] = -links[1], -links[2]
    reach[1, 1] += 0.5 * links[1]
    reach[2] = 0.0
    reach[2, 2] = -0.5 * links[2]
    reach[3] = 0.0
    reach[0, 0], reach[4, 4] = 0.5 * links[0], 0.5 * links[4]
    reach[5, 4:6], reach[6, 4:7] = (links[4], 0.5 * links[5]), (*links[4:6], 0.5 * links[6])
    hip = np.array([0.0, -links[1], -links[2], 0.0, 0.0, 0.0, 0.0])

    def placed(angles: np.ndarray) -> np.ndarray:
        return np.array([hip @ np.cos(angles), hip @ np.sin(angles), *angles])

    def springs(angles: np.ndarray) -> np.ndarray:
        torques, bent = np.zeros(7), angles - WALKER_REST
        for k, (i, j) in zip(p["k"], JOINTS, strict=True):
            torques[i] -= k * (bent[i] - bent[j])
            torques[j] += k * (bent[i] - bent[j])
        return torques

    def end() -> np.ndarray:
        turning = _equations.Links(reach, m, p["J"], p["g"], springs, held=(3,))
        return placed(turning.end(angles, rates, t1))

    q0, speed = placed(angles), np.zeros(2)
    speed[:] = -hip @ (np.sin(angles) * rates), hip @ (np.cos(angles) * rates)
    names = ("x", "y", "torso", "thigh1", "shank1", "foot1", "thigh2", "shank2", "foot2")
    v0 = np.array([*speed, *rates])
    return Scene(walker_lagrangian, names, p, q0, v0, t1, 2e-3, end, standing)


def planar_scenes() -> dict[str, Any]:
    """By name."""
    counts: Sequence[int] = (2, 8)
    many = {f"{n} four-bars": partial(four_bars, n) for n in counts}
    return {"squeezer": squeezer, "governor": governor, **many, "20 rods": partial(rods, 20),
            "walker": walker}  # fmt: skip
