"""Chaos: how long motions stay accurate at a tolerance, compared with the growth of perturbations.

Eight double pendulums are released at rest from large angles. Their errors are compared with
tolerance times growth up to the horizon, the time at which the error reaches 1e-2 rad. Beyond the
horizon motions are independent of each other.
"""

import warnings
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from bench.stability._cases import Cases, Found, names
from bench.stability._long_runs import ARMS

SPAN, SAVES, COUNT = 22.0, 441, 8
TOLERANCES = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
LOST = 1e-2  # rad

cases = Cases()


def solved_to(tolerance: float, method: str) -> jl.Solution:
    """The eight motions."""
    q0 = jnp.asarray(np.random.default_rng(5).uniform(1.8, 2.6, (COUNT, 2)))
    ts = np.linspace(0.0, SPAN, SAVES)
    options: dict[str, Any] = {
        "rtol": tolerance,
        "atol": tolerance,
        "method": method,
        "max_steps": 100_000,
        "throw": False,
    }
    return jax.vmap(lambda q: jl.simulate(ARMS, q, jnp.zeros(2), ts, {}, **options))(q0)


class Exact(NamedTuple):
    """The accurate motions for comparison.

    Attributes:
        q: (starts, saves, 2), angles.
        kappa: (starts, saves), growth of perturbations from any earlier time.
        exponent: (starts,), largest Lyapunov exponents, 1/s.
        error: (starts,), their standard errors.
        statuses: of all motions.
    """

    q: np.ndarray
    kappa: np.ndarray
    exponent: np.ndarray
    error: np.ndarray
    statuses: tuple[str, ...]


@cache
def exact() -> Exact:
    """Motions with rounding errors only, which grow to 1e-3 rad at the end, and their growth."""
    motions = solved_to(3e-14, "auto")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the horizon
        growth = jl.lyapunov(motions)
    statuses = names(motions.status) + names(growth.status)
    return Exact(
        np.asarray(motions.q),
        np.asarray(growth.kappa),
        np.asarray(growth.exponent),
        np.asarray(growth.exponent_error),
        statuses,
    )


class Held(NamedTuple):
    """Horizons of motions, and errors before them: (tolerances, starts) each."""

    horizons: np.ndarray
    errors: np.ndarray
    statuses: tuple[str, ...]


@cache
def held(method: str) -> Held:
    """Horizons, s, and largest errors before them, divided by tolerance and growth."""
    true = exact()
    ts, statuses = np.linspace(0.0, SPAN, SAVES), true.statuses
    horizons, errors = [], []
    for tolerance in TOLERANCES:
        motions = solved_to(tolerance, method)
        off = np.abs(np.asarray(motions.q) - true.q)
        lost = np.max(off, -1) > LOST
        first = np.where(np.any(lost, 1), np.argmax(lost, 1), SAVES - 1)
        over = np.max(off / (tolerance * (1.0 + np.abs(true.q))), -1) / true.kappa
        before = np.arange(SAVES) < first[:, None]
        horizons.append(ts[first])
        errors.append(np.max(np.where(before, over, 0.0), 1))
        statuses = statuses + names(motions.status)
    return Held(np.array(horizons), np.array(errors), statuses)


def worst(method: str) -> Found:
    """The largest error of all motions and tolerances."""
    motions = held(method)
    middle = float(np.median(motions.errors))
    return Found(float(np.max(motions.errors)), motions.statuses, f"median {middle:.2g}")


# The error of a step is about its estimate, so at most about the tolerance. The errors of a
# Lyapunov time (ten steps or fewer) may have one sign; earlier errors have grown by the same kappa.
@cases.add("chaos: errors of order 5 up to the horizon", "error over tolerance and growth", 10.0)
def fifth_order(quick: bool) -> Found:
    return worst("dopri5")


# Steps of order 8 are accepted by an estimate of lower order, at least ten times their error.
@cases.add("chaos: errors of order 8 up to the horizon", "error over tolerance and growth", 1.0)
def eighth_order(quick: bool) -> Found:
    return worst("auto")


# With a tolerance 1e4 times tighter, horizons are longer by ln(1e4) / exponent, which is 9 e-folds.
# An exponent from 22 s has an error of a quarter, both horizons one of an e-fold: 30 % for each
# motion, 10 % for the mean of 8; the bound is three standard errors of that. If a tight tolerance
# were missed by a factor of 100, the gain would be half as long.
@cases.add("chaos: horizons against the Lyapunov exponent", "|mean gain over ln(1e4) / l - 1|", 0.3)
def horizons(quick: bool) -> Found:
    motions, true = held("auto"), exact()
    gained = motions.horizons[-1] - motions.horizons[0]
    ratios = gained * true.exponent / np.log(TOLERANCES[0] / TOLERANCES[-1])
    mean, error = np.mean(ratios), np.std(ratios, ddof=1) / np.sqrt(COUNT)
    exponents = f"{np.min(true.exponent):.2f} to {np.max(true.exponent):.2f} 1/s"
    details = f"{mean:.3f} +- {error:.3f}, exponents {exponents}, gains {np.mean(gained):.2f} s"
    # Without positive exponents beyond their errors there is no horizon.
    sure = bool(np.all(true.exponent > 3.0 * true.error))
    return Found(abs(float(mean) - 1.0) if sure else np.inf, motions.statuses, details)
