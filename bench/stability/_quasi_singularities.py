"""Motions through states with singular quasi-velocities, and motions that stay away from them.

If dU/dv loses rank, u does not determine v. The motions are known in closed form, or are computed
with other quasi-velocities. A motion counts as wrong if its status is ok and its error of q or v is
above a thousand tolerances, or above 1e-3 with fixed steps of 0.05 s. A motion that stays away from
singular states also counts if it is refused.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._cases import Cases, Found, names

STARTS, QUICK_STARTS = 500, 50
STEP, COARSE = 0.05, 1e-3
BOUND = 1e3  # tolerances
WAYS: tuple[dict[str, Any], ...] = (
    {"rtol": 1e-12, "method": "prince9"},
    {"rtol": 1e-9},
    {"rtol": 1e-6},
    {"rtol": 1e-6, "method": "kvaerno5"},
    {"rtol": 1e-6, "method": "tsit5"},
    {"rtol": 1e-3, "method": "tsit5"},
    {"dt": STEP, "method": "dopri5"},
    {"dt": STEP, "method": "dopri8"},
)
QUICK_WAYS = (WAYS[1], WAYS[5], WAYS[7])

cases = Cases()


class Starts(NamedTuple):
    """Starts and spans; the first axis is that of the motions."""

    q0: Any
    v0: Any
    span: Any


Exact = Callable[[Any, Any, Any], tuple[Any, Any]]
Draw = Callable[[np.random.Generator, int], Starts]


def counted(
    system: jl.System,
    exact: Exact,
    starts: Starts,
    params: Any,
    clear: bool,
    ways: Sequence[dict[str, Any]],
) -> Found:
    """Number of motions that are wrong with the status ok, plus, if `clear`, of refused ones."""
    wrong, statuses, details = 0, set[str](), []
    right = [np.asarray(x) for x in exact(*map(np.asarray, starts))]
    for way in ways:
        if clear and "dt" in way:
            continue
        tolerance = way.get("rtol")
        options = way if tolerance is None else way | {"atol": tolerance}

        def one(q0: Array, v0: Array, span: Array, options: dict[str, Any] = options) -> Any:
            ts = jnp.stack([0.0 * span, span])
            given = {"params": params, "formulation": "quasi"} | options
            motion = jl.simulate(system, q0, v0, ts, **given)
            return motion.q[-1], motion.v[-1], motion.ok, motion.status

        *found, ok, status = map(np.asarray, jax.jit(jax.vmap(one))(*map(jnp.asarray, starts)))
        off = [
            np.max(np.abs(x - y) / (1.0 + np.abs(y)), axis=1)
            for x, y in zip(found, right, strict=True)
        ]
        bound = COARSE if tolerance is None else BOUND * tolerance
        silent = ok & ~(np.maximum(*off) <= bound)
        wrong += int(np.sum(silent)) + (int(np.sum(~ok)) if clear else 0)
        statuses |= set(names(status)) - {"kinematics_singular"}
        details.append(f"{options}: {np.sum(silent)} silent, {np.sum(~ok)} refused")
    return Found(float(wrong), tuple(sorted(statuses)), "; ".join(details))


def row(
    name: str, system: jl.System, draw: Draw, clear: bool = False, params: Any = None
) -> Callable[[Exact], Exact]:
    """A decorator that adds a case; the function returns the exact final (q, v) of its motions."""

    def added(exact: Exact) -> Exact:
        def run(quick: bool) -> Found:
            count, ways = (QUICK_STARTS, QUICK_WAYS) if quick else (STARTS, WAYS)
            starts = draw(np.random.default_rng(len(name)), count)
            return counted(system, exact, starts, params, clear, ways)

        what = "silent or refused motions" if clear else "silent motions"
        cases.add(f"singular quasi-velocities: {name}", what, 0.0)(run)
        return exact

    return added


def free(t: Any, q: Array, v: Array, params: Any) -> Array:
    return 0.5 * (v @ v)


# ---- A weight cos(y)^k of x', y past 90 degrees ------------------------------------------------

DRAG = 0.1
drag = jl.Rayleigh(lambda t, q, v, params: 0.5 * DRAG * (v @ v), "drag")


def weighted(power: int) -> jl.System:
    def U(t: Any, q: Array, v: Array, params: Any) -> Array:
        return jnp.stack([jnp.cos(q[1]) ** power * v[0], v[1]])

    quasi = jl.QuasiVelocities(U, ("a", "b"))
    return jl.System(free, ("x", "y"), quasi=quasi, forces=(drag,))


def past(rng: np.random.Generator, count: int) -> Starts:
    y, fast = rng.uniform(-1, 1, count), rng.uniform(0.5, 2, (2, count))
    q0 = np.stack([np.zeros(count), y], axis=1)
    v0 = np.stack([rng.choice([-1, 1], count) * fast[0], 0.5 + fast[1]], axis=1)
    return Starts(q0, v0, rng.uniform(0.5, 4, count))


def dragged(q0: Any, v0: Any, span: Any) -> tuple[Any, Any]:
    left = np.exp(-DRAG * span)[:, None]
    return q0 + v0 * (1 - left) / DRAG, v0 * left


row("cos(y) x', crossed", weighted(1), past)(dragged)
row("cos(y)^2 x', touched", weighted(2), past)(dragged)


# ---- The same, y swinging beyond 90 degrees and back, or just below ----------------------------


def swinging(t: Any, q: Array, v: Array, params: Any) -> Array:
    return 0.5 * (v @ v) - 0.5 * q[1] ** 2


def cosine(t: Any, q: Array, v: Array, params: Any) -> Array:
    return jnp.stack([jnp.cos(q[1]) * v[0], v[1]])


def swung(q0: Any, v0: Any, span: Any) -> tuple[Any, Any]:
    c, s = np.cos(span), np.sin(span)
    (x, y), (vx, vy) = q0.T, v0.T
    q = np.stack([x + vx * span, y * c + vy * s], axis=1)
    return q, np.stack([vx, vy * c - y * s], axis=1)


def swings(low: float, high: float, beyond: int) -> Draw:
    """Amplitudes of y that differ from 90 degrees by 10^low to 10^high."""

    def draw(rng: np.random.Generator, count: int) -> Starts:
        size = np.pi / 2 + beyond * 10 ** rng.uniform(low, high, count)
        phase = rng.uniform(-1.2, 1.2, count)
        vx = rng.choice([-1, 1], count) * rng.uniform(0.5, 2, count)
        q0 = np.stack([np.zeros(count), size * np.sin(phase)], axis=1)
        v0 = np.stack([vx, size * np.cos(phase)], axis=1)
        return Starts(q0, v0, rng.uniform(np.pi, 8, count))

    return draw


swing = jl.System(swinging, ("x", "y"), quasi=jl.QuasiVelocities(cosine, ("a", "b")))
row("cos(y) x', crossed twice at a turn", swing, swings(-3, -0.5, 1))(swung)
row("cos(y) x', 1e-3 to 0.3 rad away", swing, swings(-3, -0.5, -1), clear=True)(swung)


# ---- A two-wheeler by its rear speed, steered through 90 degrees -------------------------------

PARAMS = {"m": 20.0, "J": 0.8, "K": 2.0, "b": 0.4, "l": 1.0}
WHEELS = ("x", "y", "yaw", "steer")


def wheeled(t: Any, q: Array, v: Array, params: Any) -> Array:
    """L of a two-wheeler with its mass center at b ahead of the rear axle."""
    x = v[0] - params["b"] * jnp.sin(q[2]) * v[2]
    y = v[1] + params["b"] * jnp.cos(q[2]) * v[2]
    turning = params["J"] * v[2] ** 2 + params["K"] * (v[2] + v[3]) ** 2
    return 0.5 * params["m"] * (x * x + y * y) + 0.5 * turning


def slips(q: Array, v: Array, params: Any) -> Array:
    ahead = q[2] + q[3]
    rear = -jnp.sin(q[2]) * v[0] + jnp.cos(q[2]) * v[1]
    front = -jnp.sin(ahead) * v[0] + jnp.cos(ahead) * v[1]
    return jnp.stack([rear, front + params["l"] * jnp.cos(q[3]) * v[2]])


def by(speed: Callable[[Array, Array, Any], Array]) -> jl.System:
    def U(t: Any, q: Array, v: Array, params: Any) -> Array:
        return jnp.concatenate([jnp.stack([speed(q, v, params), v[3]]), slips(q, v, params)])

    named = ("speed", "turn", "rear", "front")
    return jl.System(wheeled, WHEELS, quasi=jl.QuasiVelocities(U, named, ("rear", "front")))


@by
def by_rear(q: Array, v: Array, params: Any) -> Array:
    return jnp.cos(q[2]) * v[0] + jnp.sin(q[2]) * v[1]


@by
def by_front(q: Array, v: Array, params: Any) -> Array:
    ahead = q[2] + q[3]
    along = jnp.cos(ahead) * v[0] + jnp.sin(ahead) * v[1]
    return along + params["l"] * jnp.sin(q[3]) * v[2]


def from_rear(t: Any, q: Array, u: Array, params: Any) -> Array:
    turning = jnp.tan(q[3]) / params["l"] * u[0]
    return jnp.stack([jnp.cos(q[2]) * u[0], jnp.sin(q[2]) * u[0], turning, u[1]])


by_kinematics = jl.System(
    wheeled,
    WHEELS,
    quasi=jl.QuasiVelocities(kinematics=from_rear, names=("speed", "turn")),
    constraints=(jl.Pfaffian(lambda t, q, v, params: slips(q, v, params), ("rear", "front")),),
)


def steered(rng: np.random.Generator, count: int) -> Starts:
    yaw, steer = rng.uniform(-3, 3, count), rng.uniform(-1.2, 1.2, count)
    front = rng.choice([-1, 1], count) * rng.uniform(0.3, 1.5, count)
    zero, rear = np.zeros(count), front * np.cos(steer)
    along = [rear * np.cos(yaw), rear * np.sin(yaw), front * np.sin(steer) / PARAMS["l"]]
    steer_rate = rng.choice([-1, 1], count) * rng.uniform(1, 4, count)
    q0 = np.stack([zero, zero, yaw, steer], axis=1)
    return Starts(q0, np.stack([*along, steer_rate], axis=1), rng.uniform(1, 4, count))


def by_front_speed(q0: Any, v0: Any, span: Any) -> tuple[Any, Any]:
    def one(q0: Array, v0: Array, span: Array) -> tuple[Array, Array]:
        ts = jnp.stack([0.0 * span, span])
        motion = jl.simulate(by_front, q0, v0, ts, PARAMS, method="prince9", rtol=1e-13, atol=1e-13)
        return motion.q[-1], motion.v[-1]

    q, v = jax.jit(jax.vmap(one))(*map(jnp.asarray, (q0, v0, span)))
    return q, v


row("rear speed of a two-wheeler", by_rear, steered, params=PARAMS)(by_front_speed)
row("rear speed, kinematics given", by_kinematics, steered, params=PARAMS)(by_front_speed)


# ---- A ball in yaw, pitch and roll, by its body rates ------------------------------------------


def body(t: Any, q: Array, v: Array, params: Any) -> Array:
    rates = jl.rotation.yaw_pitch_roll.body_rates(q, v)
    return 0.5 * (rates @ rates)


def from_body(t: Any, q: Array, u: Array, params: Any) -> Array:
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    across = (s * u[1] + c * u[2]) / jnp.cos(q[1])
    return jnp.stack([across, c * u[1] - s * u[2], u[0] + jnp.sin(q[1]) * across])


def rates_of(t: Any, q: Array, v: Array, params: Any) -> Array:
    return jl.rotation.yaw_pitch_roll.body_rates(q, v)


ANGLES = ("yaw", "pitch", "roll")
RATES = ("wx", "wy", "wz")
ball = jl.System(body, ANGLES, quasi=jl.QuasiVelocities(rates_of, RATES))
ball_by_kinematics = jl.System(
    body, ANGLES, quasi=jl.QuasiVelocities(kinematics=from_body, names=RATES)
)


def pitching(rng: np.random.Generator, count: int) -> Starts:
    q0 = rng.uniform(-1, 1, (count, 3))
    zero, pitch = np.zeros(count), rng.choice([-1, 1], count) * rng.uniform(0.5, 2, count)
    return Starts(q0, np.stack([zero, pitch, zero], axis=1), rng.uniform(0.5, 4, count))


def straight(q0: Any, v0: Any, span: Any) -> tuple[Any, Any]:
    return q0 + v0 * span[:, None], v0


row("gimbal lock", ball, pitching)(straight)
row("gimbal lock, kinematics given", ball_by_kinematics, pitching)(straight)


# ---- A point in spherical coordinates, past the pole -------------------------------------------


def spherical(t: Any, q: Array, v: Array, params: Any) -> Array:
    across = q[0] * jnp.sin(q[1]) * v[2]
    return 0.5 * (v[0] ** 2 + (q[0] * v[1]) ** 2 + across**2)


def frame(t: Any, q: Array, v: Array, params: Any) -> Array:
    return jnp.stack([v[0], q[0] * v[1], q[0] * jnp.sin(q[1]) * v[2]])


point = jl.System(
    spherical, ("r", "theta", "phi"), quasi=jl.QuasiVelocities(frame, ("out", "south", "east"))
)


def spherical_state(x: Any, y: Any, z: Any, speed: Any) -> tuple[Any, Any]:
    """(q, v) of a point at (x, y, z) that moves along x; y >= 0, and x < 0 beyond the pole."""
    aside = np.where(y > 0, np.hypot(x, y), x)
    r, along = np.hypot(aside, z), speed * x / aside
    q = np.stack([r, np.arctan2(aside, z), np.where(y > 0, np.arctan2(y, x), 0.0)], axis=1)
    out, south = along * aside / r, along * z / r**2
    return q, np.stack([out, south, -speed * y / aside**2], axis=1)


def lines(low: float | None = None, high: float = 0.0) -> Draw:
    """Straight lines over the pole, or with an offset of 10^low to 10^high of their height."""

    def draw(rng: np.random.Generator, count: int) -> Starts:
        x, z = rng.uniform(0.3, 2, count), rng.uniform(0.5, 2, count)
        side = np.zeros(count) if low is None else z * 10 ** rng.uniform(low, high, count)
        speed = -rng.uniform(0.5, 2, count)
        span = -x / speed * rng.uniform(0.7, 2.5, count)
        return Starts(*spherical_state(x, side, z, speed), span)

    return draw


def after_straight_line(q0: Any, v0: Any, span: Any) -> tuple[Any, Any]:
    (r, theta, phi), (out, south, east) = q0.T, v0.T
    aside, z = r * np.sin(theta), r * np.cos(theta)
    along = out * np.sin(theta) + r * south * np.cos(theta)
    x, y = aside * np.cos(phi), aside * np.sin(phi)
    speed = along * np.cos(phi) - aside * east * np.sin(phi)
    return spherical_state(x + speed * span, y, z, speed)


row("past the pole", point, lines())(after_straight_line)
row("beside the pole", point, lines(-2, 0), clear=True)(after_straight_line)
