"""Fits with little information or params of different size, by `jl.fit` and by optimistix."""

import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
import optimistix
from jax import Array

import jaxlag as jl
from bench.stability._cases import TIGHT, Cases, Found, run
from bench.stability._extremes import SPRING

TIMES = np.linspace(0.0, 6.0, 41)

cases = Cases()


# ---- jl.fit ------------------------------------------------------------------------------------


def measured(x: Any, sigma: float) -> jl.Experiment:
    """Positions of a motion from x = 1 at rest."""
    start: dict[str, Any] = {"q0": [1.0], "v0": [0.0], "start_sigma": 0.0}
    return jl.Experiment(TIMES, {"x": np.asarray(x)}, sigma={"x": sigma}, **start)


def searched(system: jl.System, data: jl.Experiment, guess: dict[str, float]) -> jl.FitResult:
    """A fit with all params free."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about a search that stopped early: the status shows it
        return jl.fit(
            system, data, guess, free=tuple(guess), simulate_options={"rtol": 1e-12, "atol": 1e-12}
        )


def ending(found: jl.FitResult) -> tuple[str, ...]:
    """The end of a fit as a status."""
    if found.failed:
        return ("segments failed",)
    return ("ok" if found.converged and found.distance < 0.3 else "not converged",)


def ratio(scale: float) -> Found:
    """k / m of a spring, the only quantity that the motion determines; the result must name it."""
    guess = {"m": 0.7 * scale, "k": 1.3 * scale}
    found = searched(SPRING, measured(np.cos(TIMES), 1e-6), guess)
    named = found.determined in (("k/m",), ("m/k",)) and np.all(np.isinf(list(found.std.values())))
    statuses = ending(found) if named else ("the ratio is not named",)
    value = float(found.params["k"] / found.params["m"])
    return Found(abs(value - 1.0), statuses, f"determined {found.determined}")


# Positions are exact to some 1e-12, and so is the frequency determined from them.
@cases.add("jl.fit: k / m alone", "error of k / m", 1e-11)
def fit_ratio(quick: bool) -> Found:
    return ratio(1.0)


@cases.add("jl.fit: k / m alone, at 1e9 kg", "error of k / m", 1e-11)
def fit_heavy_ratio(quick: bool) -> Found:
    return ratio(1e9)


def soft(t: Any, q: Array, v: Array, params: Any) -> Array:
    """A spring with a cubic part of 1e-6."""
    return 0.5 * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2 - 0.25e-6 * params["c"] * q[0] ** 4


SOFT = jl.System(soft, ("x",))


def soft_motion() -> np.ndarray:
    return np.asarray(run(SOFT, [1.0], [0.0], TIMES, {"k": 1.0, "c": 1.0}, **TIGHT)["x"])


# c changes the frequency by 3/8e-6. Its effect differs from that of k by 1e-6 / 16 only. So errors
# of 1e-12 in the positions are errors of 1e-5 in c.
@cases.add("jl.fit: sensitivities 1e6 apart", "relative error of the weak one", 1e-5)
def fit_weak(quick: bool) -> Found:
    found = searched(SOFT, measured(soft_motion(), 1e-9), {"k": 0.8, "c": 3.0})
    return Found(abs(float(found.params["c"]) - 1.0), ending(found), f"std {found.std['c']:.2g}")


# A normal distribution exceeds 4 standard deviations once in 16 000 times.
@cases.add("jl.fit: the same with noise of 1e-8", "error over its standard deviation", 4.0)
def fit_noisy(quick: bool) -> Found:
    noise = 1e-8 * np.random.default_rng(4).normal(size=len(TIMES))
    found = searched(SOFT, measured(soft_motion() + noise, 1e-8), {"k": 0.8, "c": 3.0})
    errors = [abs(float(found.params[name]) - 1.0) / found.std[name] for name in ("k", "c")]
    return Found(max(errors), ending(found), f"std {found.std['k']:.2g}, {found.std['c']:.2g}")


def heavy(t: Any, q: Array, v: Array, params: Any) -> Array:
    """1e9 kg on a spring, under gravity g."""
    return 0.5e9 * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2 + 1e9 * params["g"] * q[0]


# Positions are exact to some 1e-12; relative changes of both params change them by as much.
@cases.add("jl.fit: parameters 1e9 apart in size", "largest relative error", 1e-11)
def fit_apart(quick: bool) -> Found:
    system, true = jl.System(heavy, ("x",)), {"k": 2e9, "g": 0.5}
    x = run(system, [1.0], [0.0], TIMES, true, **TIGHT)["x"]
    found = searched(system, measured(x, 1e-6), {"k": 1.6e9, "g": 1.0})
    errors = [abs(float(found.params[name]) / true[name] - 1.0) for name in true]
    return Found(max(errors), ending(found))


# ---- optimistix --------------------------------------------------------------------------------


def fitted(scale: Array, least: float) -> tuple[Array, bool]:
    """(m, k) of a spring from 40 exact positions, by Levenberg-Marquardt from wrong values.

    The motion determines k / m only: the normal equations are singular in every iteration.
    """
    ts = jnp.asarray(TIMES)

    def residual(logs: Array, _: Any) -> Array:
        m, k = jnp.exp(logs) * scale
        return run(SPRING, [1.0], [0.0], ts, {"m": m, "k": k}, **TIGHT).q[1:, 0] - jnp.cos(ts[1:])

    solver = optimistix.LevenbergMarquardt(rtol=least, atol=least)
    start = jnp.log(jnp.array([0.7, 1.3]))
    found = optimistix.least_squares(residual, solver, start, max_steps=100, throw=False)
    return jnp.exp(found.value) * scale, bool(found.result == optimistix.RESULTS.successful)


# Positions are exact to some 1e-12, and so is the frequency determined from them.
@cases.add("optimistix: k / m alone", "error of k / m", 1e-11)
def ratio_alone(quick: bool) -> Found:
    (m, k), ended = fitted(jnp.ones(2), 1e-12)
    return Found(abs(float(k / m) - 1.0), ("ok" if ended else "not converged",))


@cases.add("optimistix: k / m alone, at 1e9 kg", "error of k / m", 1e-11)
def heavy_ratio(quick: bool) -> Found:
    (m, k), ended = fitted(jnp.full(2, 1e9), 1e-12)
    return Found(abs(float(k / m) - 1.0), ("ok" if ended else "not converged",))


# As with jl.fit.
@cases.add("optimistix: sensitivities 1e6 apart", "relative error of the weak one", 1e-5)
def weak_parameter(quick: bool) -> Found:
    """Stiffness and cubic stiffness, which is 1e-6 times as large."""

    def positions(p: Any) -> Array:
        return run(SOFT, [1.0], [0.0], TIMES, {"k": p[0], "c": p[1]}, **TIGHT).q[1:, 0]

    data = positions(jnp.array([1.0, 1.0]))
    solver = optimistix.LevenbergMarquardt(rtol=1e-13, atol=1e-13)
    found = optimistix.least_squares(
        lambda p, _: 1e6 * (positions(p) - data),
        solver,
        jnp.array([0.8, 3.0]),
        max_steps=200,
        throw=False,
    )
    ended = bool(found.result == optimistix.RESULTS.successful)
    return Found(abs(float(found.value[1]) - 1.0), ("ok" if ended else "not converged",))
