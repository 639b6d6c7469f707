"""Short, stiff forces: walls, contacts, cords and barriers that a step could miss.

Twelve potentials, 1,000 starts each, three tolerances, by the default method. A motion counts as
wrong if its status is ok and its energy error is above two limits: 1 %, and three times the largest
error of `tsit5` for this potential and tolerance. In `tsit5` all stages contribute to the error
estimate, so its error is the one that the tolerance allows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._cases import Cases, Found, names

STARTS, QUICK_STARTS = 1000, 100
TOLERANCES = (1e-9, 1e-7, 1e-5)
GRAVITY = 9.81

cases = Cases()


class Starts(NamedTuple):
    """Starts and parameters of a potential; the first axis is that of the motions."""

    q0: Any
    v0: Any
    span: Any
    params: dict[str, Any]


Draw = Callable[[np.random.Generator, int], Starts]


def silent(potential: Callable[[Array, Any], Array], starts: Starts) -> Found:
    """Number of motions with the status ok and an energy error above the limits."""
    size = starts.q0.shape[1]

    def lagrangian(t: Any, q: Array, v: Array, params: Any) -> Array:
        return 0.5 * (v @ v) - potential(q, params)

    system = jl.System(lagrangian, tuple(f"q{i}" for i in range(size)))

    def energy(q: Array, v: Array, params: Any) -> Array:
        return 0.5 * (v @ v) + potential(q, params)

    def ended(method: str) -> Callable:
        def one(start: Starts, tolerance: Array) -> tuple[Array, Array]:
            motion = jl.simulate(
                system,
                start.q0,
                start.v0,
                jnp.stack([0.0 * start.span, start.span]),
                start.params,
                method=method,
                rtol=tolerance,
                atol=tolerance,
                max_steps=100_000,
            )
            before = energy(start.q0, start.v0, start.params)
            after = energy(motion.q[-1], motion.v[-1], start.params)
            scale = jnp.maximum(jnp.abs(before), 0.5 * (start.v0 @ start.v0))
            return jnp.abs(after - before) / scale, motion.status

        return jax.jit(jax.vmap(one, in_axes=(0, None)))

    given = jax.tree.map(jnp.asarray, starts)
    default, plain = ended("auto"), ended("tsit5")
    wrong, statuses, details = 0, set[str](), []
    for tolerance in TOLERANCES:
        off, status = map(np.asarray, default(given, tolerance))
        excused = max(0.01, 3.0 * float(np.max(plain(given, tolerance)[0])))
        wrong += int(np.sum(~(off <= excused) & (status == jl.Status.ok)))
        statuses |= set(names(status))
        details.append(f"{tolerance:.0e}: worst {np.nanmax(off):.1e}, excused {excused:.1e}")
    return Found(float(wrong), tuple(sorted(statuses)), "; ".join(details))


def row(name: str, draw: Draw) -> Callable[[Callable], Callable]:
    """A decorator that adds a case; the function is its potential."""

    def added(potential: Callable[[Array, Any], Array]) -> Callable:
        def run(quick: bool) -> Found:
            rng = np.random.default_rng(len(name))
            return silent(potential, draw(rng, QUICK_STARTS if quick else STARTS))

        cases.add(f"sharp: {name}", "silent motions", 0.0)(run)
        return potential

    return added


def decades(rng: np.random.Generator, low: float, high: float, count: int) -> Any:
    """Random numbers, uniform in their logarithm."""
    return 10.0 ** rng.uniform(low, high, count)


def beyond(x: Array) -> Array:
    """max(x, 0)^2 / 2."""
    return 0.5 * jnp.maximum(x, 0.0) ** 2


# ---- A ball that falls on a floor, six flights -------------------------------------------------


def ball(draw: Callable[[np.random.Generator, Any], dict[str, Any]]) -> Draw:
    def starts(rng: np.random.Generator, count: int) -> Starts:
        height = decades(rng, -1, 2, count)
        return Starts(
            height[:, None],
            np.zeros((count, 1)),
            6 * np.sqrt(2 * height / GRAVITY),
            draw(rng, height),
        )

    return starts


def stiff(low: float, high: float) -> Callable[[np.random.Generator, Any], dict[str, Any]]:
    return lambda rng, height: {"k": decades(rng, low, high, len(height))}


@row("one-sided spring", ball(stiff(4, 8)))
def spring(q: Array, params: Any) -> Array:
    return GRAVITY * q[0] + params["k"] * beyond(-q[0])


@row("Hertz contact", ball(stiff(5, 9)))
def hertz(q: Array, params: Any) -> Array:
    depth = jnp.maximum(-q[0], 0.0)
    power = jnp.where(depth > 0, depth, 1.0) ** 2.5
    return GRAVITY * q[0] + params["k"] * jnp.where(depth > 0, power, 0.0) / 2.5


def soft(rng: np.random.Generator, height: Any) -> dict[str, Any]:
    count = len(height)
    return {
        "f": GRAVITY * decades(rng, 1.5, 4, count),
        "w": np.minimum(height, 1.0) * decades(rng, -3.5, -2, count),
    }


@row("softplus wall", ball(soft))
def softplus(q: Array, params: Any) -> Array:
    return GRAVITY * q[0] + params["f"] * params["w"] * jax.nn.softplus(-q[0] / params["w"])


def thin(low: float, high: float) -> Callable[[np.random.Generator, Any], dict[str, Any]]:
    return lambda rng, height: {"w": np.minimum(height, 1.0) * decades(rng, low, high, len(height))}


@row("exponential barrier", ball(thin(-4, -2)))
def exponential(q: Array, params: Any) -> Array:
    return GRAVITY * q[0] + jnp.exp(-q[0] / params["w"])


@row("barrier of 1/x^12", ball(thin(-2, -1)))
def twelve(q: Array, params: Any) -> Array:
    return GRAVITY * q[0] + (params["w"] / q[0]) ** 12


# ---- Walls on several sides --------------------------------------------------------------------


def in_box(rng: np.random.Generator, count: int) -> Starts:
    speed = decades(rng, -0.5, 1, count)
    sign = rng.choice([-1.0, 1.0], count)
    q0, k = rng.uniform(0.05, 0.95, count), decades(rng, 4, 8, count)
    return Starts(q0[:, None], (sign * speed)[:, None], 6 / speed, {"k": k})


@row("between two walls", in_box)
def box(q: Array, params: Any) -> Array:
    return params["k"] * (beyond(-q[0]) + beyond(q[0] - 1.0))


def around(radius: Any, angle: Any) -> Any:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def in_ring(rng: np.random.Generator, count: int) -> Starts:
    angle, heading = rng.uniform(0, 2 * np.pi, (2, count))
    speed, k = decades(rng, -0.5, 1, count), decades(rng, 4, 8, count)
    q0 = around(rng.uniform(0, 0.8, count), angle)
    return Starts(q0, around(speed, heading), 10 / speed, {"k": k})


@row("inside a ring", in_ring)
def ring(q: Array, params: Any) -> Array:
    return params["k"] * beyond(jl.math.norm(q) - 1.0)


def on_cord(rng: np.random.Generator, count: int) -> Starts:
    q0, v0 = rng.uniform(-0.65, 0.65, (count, 2)), rng.uniform(-1, 1, (count, 2))
    return Starts(q0, v0, rng.uniform(2, 5, count), {"k": decades(rng, 3, 8, count)})


@row("cord that goes taut", on_cord)
def cord(q: Array, params: Any) -> Array:
    return GRAVITY * q[1] + params["k"] * beyond(jl.math.norm(q) - 1.0)


def with_play(rng: np.random.Generator, count: int) -> Starts:
    play, first = decades(rng, -2, 0, count), rng.uniform(-1, 1, count)
    q0 = np.stack([first, first + play * rng.uniform(-0.9, 0.9, count)], axis=1)
    params = {"s": decades(rng, 0, 2, count), "k": decades(rng, 4, 7, count), "play": play}
    return Starts(q0, rng.uniform(-1, 1, (count, 2)), rng.uniform(3, 8, count), params)


@row("backlash", with_play)
def backlash(q: Array, params: Any) -> Array:
    gap = jnp.abs(q[0] - q[1]) - params["play"]
    return 0.5 * params["s"] * q[0] ** 2 + params["k"] * beyond(gap)


def to_stop(rng: np.random.Generator, count: int) -> Starts:
    params = {"k": decades(rng, 4, 8, count), "at": rng.uniform(-0.2, 0.5, count)}
    q0 = rng.uniform(-3, -0.3, (count, 1))
    return Starts(q0, np.zeros((count, 1)), rng.uniform(3, 8, count), params)


@row("pendulum against a stop", to_stop)
def stop(q: Array, params: Any) -> Array:
    return -GRAVITY * jnp.cos(q[0]) + params["k"] * beyond(q[0] - params["at"])


# ---- Bodies that meet --------------------------------------------------------------------------


def apart(rng: np.random.Generator, count: int) -> Starts:
    q0 = np.stack([rng.uniform(-2, -0.5, count), rng.uniform(0.5, 2, count)], axis=1)
    params = {"s": decades(rng, -2, -0.5, count), "e": decades(rng, -3, 0, count)}
    return Starts(q0, rng.uniform(-1, 1, (count, 2)), rng.uniform(5, 10, count), params)


@row("Lennard-Jones", apart)
def lennard_jones(q: Array, params: Any) -> Array:
    s = (params["s"] / (q[1] - q[0])) ** 6
    return 4 * params["e"] * (s**2 - s) + 0.5 * (q @ q)


def among_bumps(rng: np.random.Generator, count: int) -> Starts:
    q0 = 0.5 + rng.uniform(-0.2, 0.2, (count, 2))
    v0 = around(1.0, rng.uniform(0, 2 * np.pi, count))
    params = {"a": decades(rng, 0, 2, count), "w": decades(rng, -1.5, -0.8, count)}
    return Starts(q0, v0, rng.uniform(5, 10, count), params)


@row("lattice of bumps", among_bumps)
def bumps(q: Array, params: Any) -> Array:
    x = q - jnp.round(q)
    return params["a"] * jnp.exp(-(x @ x) / (2 * params["w"] ** 2))
