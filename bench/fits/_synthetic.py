"""A chaotic double pendulum with known params: how often a fit finds them, and how often its
intervals contain them.

Two point masses on massless rods; angles are absolute, 0 hanging. They are measured 100 times per
second with noise of a given standard deviation, over five Lyapunov times. m1 and g are known. l1,
l2 and m2 are fitted. Their initial values are 50 % too large or too small, at random.
"""

from statistics import NormalDist
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench._harness.timing import Reference, Target
from bench.fits._report import Figure, Part
from jaxlag._fit._covariance import linearized
from jaxlag._fit._fit import last_gap
from jaxlag._fit._free_parameters import NO_PRIOR, unknowns
from jaxlag._fit._multiple_shooting import FitVariables, MultipleShooting, search
from jaxlag._fit._residuals import squares
from jaxlag._fit._segments import layout
from jaxlag._fit._setup import build_shooting, readers_of

TRUE = {"l1": 1.0, "l2": 0.8, "m2": 0.7, "m1": 1.0, "g": 9.81}
FREE = ("l1", "l2", "m2")
NOISE = 5e-3  # rad
NAME = "simulated double pendulum"
RATE = 100.0  # 1/s
START = np.array([2.0, 2.6])  # rad, at rest
TIMES = 5.0  # Lyapunov times
SEGMENTS = 10
OPTIONS = {"simulate_options": {"method": "tsit5", "rtol": 1e-8, "atol": 1e-8}}
TRUTH = {"rtol": 1e-11, "atol": 1e-11}
SETTLING, STRETCHES = 20, 400  # s
NEAR = 0.01


def lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """L = T - V of two point masses."""
    both = p["m1"] + p["m2"]
    T = 0.5 * both * (p["l1"] * v[0]) ** 2 + 0.5 * p["m2"] * (p["l2"] * v[1]) ** 2
    T += p["m2"] * p["l1"] * p["l2"] * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return T + p["g"] * (both * p["l1"] * jnp.cos(q[0]) + p["m2"] * p["l2"] * jnp.cos(q[1]))


PENDULUM = jl.System(lagrangian, {"theta": (2,)})


@jax.jit
def lyapunov_exponent() -> Array:
    """The largest Lyapunov exponent, 1/s: mean growth per second of an infinitesimal change."""

    def after(y: Array) -> Array:
        motion = jl.simulate(PENDULUM, y[:2], y[2:], [0.0, 1.0], TRUE, rtol=1e-9, atol=1e-9)
        return jnp.concatenate([motion.q[-1], motion.v[-1]])

    def second(carry: Any, _: Any) -> Any:
        y, change = carry
        y, change = jax.jvp(after, (y,), (change,))
        size = jnp.linalg.norm(change)
        return (y, change / size), jnp.log(size)

    begin = jnp.concatenate([jnp.asarray(START), jnp.zeros(2)]), jnp.ones(4) / 2
    _, growth = jax.lax.scan(second, begin, length=SETTLING + STRETCHES)
    return jnp.mean(growth[SETTLING:])


def times(exponent: float) -> np.ndarray:
    """Sample times over five Lyapunov times, s."""
    return np.arange(int(TIMES / exponent * RATE) + 1) / RATE


def truth(ts: np.ndarray) -> np.ndarray:
    """Angles without noise."""
    return np.asarray(jl.simulate(PENDULUM, START, np.zeros(2), ts, TRUE, **TRUTH).q)


def measured(ts: np.ndarray, exact: np.ndarray, seed: int) -> jl.Experiment:
    """Angles with noise."""
    noise = NOISE * np.random.default_rng(seed).normal(size=exact.shape)
    return jl.Experiment(ts, {"theta": exact + noise}, sigma={"theta": NOISE})


def wrong(seed: int) -> dict[str, float]:
    """Params, those to be fitted wrong by 50 %."""
    signs = np.random.default_rng([seed, 1]).choice([-0.5, 0.5], len(FREE))
    return TRUE | {name: TRUE[name] * (1 + x) for name, x in zip(FREE, signs.tolist(), strict=True)}


class Tally(NamedTuple):
    """Results of many fits.

    Attributes:
        found: number of fits with all params within 1 % and inside their 99 % intervals.
        near: number of fits with all params within 1 %.
        worst: largest relative error of the fits in `near`.
        solves: median number of motions with derivatives.
    """

    found: int
    near: int
    worst: float
    solves: float


def recovered(ts: np.ndarray, seeds: int, segments: int) -> Tally:
    """How often fits from wrong initial values find the true params."""
    exact = truth(ts)
    found, errors, solves = 0, [], []
    for seed in range(seeds):
        data = measured(ts, exact, seed)
        fitted = jl.fit(
            PENDULUM,
            data,
            wrong(seed),
            free=FREE,
            segments=segments,
            transforms=dict.fromkeys(FREE, jl.transforms.Positive()),
            **OPTIONS,
        )
        error = max(abs(fitted.params[x] / TRUE[x] - 1) for x in FREE)
        interval = fitted.interval(0.99)
        inside = all(interval[x][0] <= TRUE[x] <= interval[x][1] for x in FREE)
        found += error <= NEAR and inside
        errors.append(error)
        solves.append(fitted.solves)
    near = [x for x in errors if x <= NEAR]
    return Tally(int(found), len(near), float(max(near, default=np.nan)), float(np.median(solves)))


def posed(ts: np.ndarray, exact: np.ndarray) -> MultipleShooting:
    """The least-squares problem, with measurements without noise."""
    data = (jl.Experiment(ts, {"theta": exact}, sigma={"theta": NOISE}),)
    shown = readers_of(PENDULUM, data, {}, TRUE)
    free, where = unknowns(TRUE, FREE, {}), layout(data, SEGMENTS)
    return build_shooting(
        PENDULUM, data, where, free, shown, NO_PRIOR, squares, OPTIONS["simulate_options"]
    )[0]


def coverage(ts: np.ndarray, fits: int, seed: int = 0) -> np.ndarray:
    """Share of 95 % intervals that contain the true value, per param; all fits in one batch."""
    problem = posed(ts, truth(ts))
    segments = problem.segments
    rng = np.random.default_rng(seed)
    noise = NOISE * rng.normal(size=(fits, *segments.values.shape))
    values = segments.values + jnp.where(segments.weights > 0, noise, 0.0)
    guess = FitVariables(jnp.zeros((fits, len(FREE))), jnp.zeros((fits, *segments.guess.shape)))

    def one(values: Array, guess: FitVariables, join: Array) -> tuple[FitVariables, Array, Array]:
        own = eqx.tree_at(lambda x: x.segments.values, problem, values)
        found = search(own, guess, join, jnp.full(2, 1e-6), 50)
        factor, by_z, _ = linearized(problem.free, found)
        root = by_z @ jnp.linalg.inv(factor)
        return found.guess, problem.free.numbers(found.guess.z), jnp.linalg.norm(root, axis=1)

    batch = jax.jit(jax.vmap(one, (0, 0, None)))
    for join in (1e-5, last_gap(problem)):
        guess, numbers, std = batch(values, guess, jnp.asarray(join))
    true = np.array([TRUE[name] for name in FREE])
    within = NormalDist().inv_cdf(0.975) * np.asarray(std)
    return np.mean(np.abs(np.asarray(numbers) - true) <= within, axis=0)


def part(quick: bool) -> Part:
    """Recovery of the params; without segments and with coverage unless `quick`."""
    ts = times(exponent := float(lyapunov_exponent()))
    figures = [
        Figure(NAME, "", "largest Lyapunov exponent", "1/s", exponent),
        Figure(NAME, "", "horizon", "s", float(ts[-1])),
    ]
    noise = Reference(f"{1e3 * NOISE:g} mrad at {RATE:g} Hz", f"noise of the {NAME}")
    if quick:
        parts = [_recovery(ts, 3, SEGMENTS)]
    else:
        parts = [_recovery(ts, 100, SEGMENTS), _recovery(ts, 100, 1), _covered(ts, 1000)]
    figures += [x for each in parts for x in each.figures]
    return Part(figures, [x for each in parts for x in each.targets], [noise])


def _recovery(ts: np.ndarray, seeds: int, segments: int) -> Part:
    tally = recovered(ts, seeds, segments)
    values = {
        f"of {seeds}: within 1 % and the 99 % interval": float(tally.found),
        f"of {seeds}: within 1 %": float(tally.near),
        "largest error of those": tally.worst,
        "motions with derivatives, median": tally.solves,
    }
    model = f"{segments} segments" if segments > 1 else "single shooting"
    figures = [Figure(NAME, model, what, "1", value) for what, value in values.items()]
    claim = f"% of {seeds} starts wrong by half that end within 1 % and the 99 % interval"
    target = Target(claim, 100.0 * tally.found / seeds, ">=", 95.0)
    return Part(figures, [target] if segments > 1 else [], [])


def _covered(ts: np.ndarray, fits: int) -> Part:
    figures, targets, model = [], [], f"{SEGMENTS} segments, from the truth"
    for param, share in zip(FREE, coverage(ts, fits).tolist(), strict=True):
        figures.append(Figure(NAME, model, f"coverage of 95 %, {param}", "1", share))
        claim = f"% of {fits} intervals of 95 % hold {param}"
        targets += [Target(claim, 100.0 * share, ">=", 93.0)]
        targets += [Target(claim, 100.0 * share, "<=", 97.0)]
    return Part(figures, targets, [])
