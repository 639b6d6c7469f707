"""Set-up of the least squares of a fit: segments, noise, initial guesses."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from inspect import signature
from statistics import NormalDist
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag._core._arguments import positive_integer
from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid, unsupported
from jaxlag._core._status import Status
from jaxlag._fit._covariance import effective_parameters
from jaxlag._fit._experiment import Experiment
from jaxlag._fit._free_parameters import Unknowns
from jaxlag._fit._initial_guess import initial_states, typical
from jaxlag._fit._multiple_shooting import MultipleShooting, SearchResult
from jaxlag._fit._residuals import Reader, readers, squares
from jaxlag._fit._segments import SegmentLayout, pack
from jaxlag._simulation._simulate import simulate
from jaxlag._system._closure_tracers import check_params
from jaxlag._system._system import System
from jaxlag._tracing._params import check_keys

OURS = ("save", "throw", "inputs", "q0", "v0", "u0", "ts", "params", "estimate_error")
"""Arguments of `simulate` that a fit sets itself."""
STATES_FOR_RANGE = 32
"""Number of states of each experiment for the ranges of the states."""
MEDIAN = NormalDist().inv_cdf(0.75)
"""Median of |x| over the standard deviation, for Gaussian x."""
ASSUMED_NOISE = 1e-2
"""Noise over the range of a channel, if neither a sigma nor an estimate is available."""


def experiments_of(given: Any) -> tuple[Experiment, ...]:
    """One experiment or several, as a tuple."""
    if not isinstance(given, Experiment | Iterable):
        raise invalid(
            "experiments", "be a jl.Experiment or a sequence of them", f"it was {given!r}"
        )
    found = (given,) if isinstance(given, Experiment) else tuple(given)
    if not found or not all(isinstance(x, Experiment) for x in found):
        raise invalid(
            "experiments", "be a jl.Experiment or a sequence of them", f"it was {given!r}"
        )
    return found


FORMER = {
    "tolerance": "rtol= and atol=",
    "max_iterations": "max_steps=",
    "project": "simulate_options={'stabilization': ...}",
} | {
    name: f"simulate_options={{{name!r}: ...}}"
    for name in signature(simulate).parameters
    if name not in (*OURS, "system", "rtol", "atol", "max_steps")
}
"""Former keywords of `fit` and `predict`, and those once passed to `simulate`."""


def check_search(rtol: Any, atol: Any, max_steps: Any) -> None:
    """Raise if these are invalid for an optimizer."""
    for name, value in (("rtol", rtol), ("atol", atol)):
        if not isinstance(value, int | float | np.number) or not 0 < value < 1:
            raise invalid(name, "be a number between 0 and 1", f"it was {value!r}")
    positive_integer("max_steps", max_steps)


def check_known_params(
    by: str, system: System, experiments: Sequence[Experiment], argument: str, params: Any
) -> None:
    """Raise on params that are traced, or not finite where a declared function reads them.

    Also on objects that cannot be part of a program's key.

    Raises:
        ValueError: with the path of the leaf.
    """
    if system.states is not None:
        was = f"it had the states {list(system.states.names)}, whose start is in no Experiment"
        fix = "Minimize a loss of jl.simulate(..., x0=) with optimistix or optax."
        raise invalid(f"{by}: system", "be without states=", was, fix)
    if not concrete(params):
        why = "its search runs outside of compiled programs"
        raise unsupported(f"`{by}` inside jit, vmap and grad", why, "Call it outside of these.")
    check_keys(params, argument)
    inputs = experiments[0].inputs_at(params)
    check_params(system, params, jnp.zeros(system.size), inputs, argument)


def readers_of(
    system: System, experiments: Sequence[Experiment], own: Mapping[str, Reader], params: Any
) -> dict[str, Reader]:
    """name -> function of a motion, for every measured channel."""
    names = tuple(dict.fromkeys(name for each in experiments for name in each.channels))
    for name, shape in system.coordinates.shapes.items():
        size = int(np.prod(shape))
        for each in experiments:
            for key in {name, f"{name}'", f"{name}''"} & each.channels.keys() - own.keys():
                if each.channels[key].shape[1] != size:
                    must = f"have {size} columns, as many as the coordinate has numbers"
                    was = f"it had {each.channels[key].shape[1]}"
                    fix = "Fill columns that were not measured with NaN."
                    raise invalid(f"{each.name}: channels[{key!r}]", must, was, fix)
    rows = tuple(system._rows(params, jnp.dtype(float)).labels) if system.constraints else ()
    return readers(system, names, own, rows)


def _unstated(experiments: Sequence[Experiment]) -> set[str]:
    """Channels without sigma in one experiment or more."""
    without = {name for each in experiments for name in each.channels if name not in each.sigma}
    for name in without & {name for each in experiments for name in each.sigma}:
        was = f"that of {name!r} was given in some"
        raise invalid(
            "sigma", "be given in all experiments that measure a channel, or in none", was
        )
    return without


def build_shooting(
    system: System,
    experiments: Sequence[Experiment],
    where: SegmentLayout,
    free: Unknowns,
    shown: Mapping[str, Reader],
    prior: tuple[np.ndarray, np.ndarray, np.ndarray],
    loss: Callable[[Array], Array],
    options: Mapping[str, Any],
    known_noise: Mapping[str, float] | None = None,
) -> tuple[MultipleShooting, dict[str, float]]:
    """The problem, and the noise assumed for channels without sigma.

    Args:
        system: the mechanical system.
        experiments: the measurements.
        where: their segments.
        free: unknowns besides the starts of segments.
        shown: name -> channel as a function of a motion.
        prior: (indices of numbers, means, sigmas).
        loss: one of `LOSSES`.
        options: options of `simulate`.
        known_noise: of channels, from an earlier fit.
    """
    if system.constraints:
        options = {"assemble": True} | dict(options)
    ranges = {
        name: np.concatenate([x.channels[name] for x in experiments if name in x.channels])
        for name in where.columns
    }
    ranges = {name: spreads(x) for name, x in ranges.items()}
    noise = {name: ASSUMED_NOISE * float(np.max(ranges[name])) for name in _unstated(experiments)}
    noise |= {name: x for name, x in (known_noise or {}).items() if name in noise}
    guesses, spread = [], []
    params = free.params0
    for i, each in enumerate(experiments):
        firsts = where.first[where.owner == i].tolist()
        some = np.linspace(0, len(each.ts) - 1, STATES_FOR_RANGE).astype(int).tolist()
        states = initial_states(system, each, firsts + some, params, dict(options))
        guesses.append(states[: len(firsts)])
        spread.append(states[len(firsts) :])
    segments = pack(system, experiments, where, noise, np.concatenate(guesses))
    problem = MultipleShooting(
        system,
        tuple(sorted(options.items())),
        tuple(shown.items()),
        tuple(int(where.columns[name].stop - where.columns[name].start) for name in shown),
        loss,
        bool(np.any(segments.follows)),
        free,
        segments,
        jnp.asarray(typical(np.concatenate(spread))),
        jnp.asarray(np.concatenate([ranges[name] for name in where.columns])),
        prior,
    )
    return problem, noise


def freedom(found: SearchResult, problem: MultipleShooting) -> float:
    """Degrees of freedom: measurements minus effective unknowns, without failed segments."""
    ok = (np.asarray(found.seen.status) == Status.ok)[:, None, None]
    measured = np.count_nonzero((np.asarray(problem.segments.weights) > 0) & ok)
    return measured - effective_parameters(problem, found)


def estimated_noise(
    found: SearchResult, problem: MultipleShooting, where: SegmentLayout, noise: Mapping[str, float]
) -> dict[str, float]:
    """Standard deviations of the channels' residuals, in the channels' units.

    With a loss that gives outliers less weight, from the median of |residual|: outliers
    are not noise.
    """
    ok = (np.asarray(found.seen.status) == Status.ok)[:, None, None]
    measured = (np.asarray(problem.segments.weights) > 0) & ok
    share = freedom(found, problem) / max(1, np.count_nonzero(measured))
    if share <= 0:  # no degrees of freedom, as with a network: as if nothing had been fitted
        share = 1.0
    residuals, changed = np.asarray(found.seen.residuals), dict(noise)
    for name, sigma in noise.items():
        part = where.columns[name]
        own = residuals[:, :, part][measured[:, :, part]]
        if own.size:
            plain = problem.loss is squares
            size = np.sqrt(np.mean(own**2)) if plain else np.median(np.abs(own)) / MEDIAN
            # Measurements without noise: the residuals are then solver errors.
            changed[name] = sigma * max(float(size / np.sqrt(share)), 1e-9)
    return changed


def spreads(x: np.ndarray) -> np.ndarray:
    """Range of each column: its standard deviation, or 1 if that is zero."""
    some = np.isfinite(x).any(axis=0)
    found = np.ones(x.shape[1])
    found[some] = np.nanstd(x[:, some], axis=0)
    return np.where(found > 0, found, 1.0)


def with_noise(
    problem: MultipleShooting, where: SegmentLayout, noise: Mapping[str, float]
) -> MultipleShooting:
    """The problem with new weights of these channels."""
    weights = problem.segments.weights
    for name, sigma in noise.items():
        part = where.columns[name]
        weights = weights.at[:, :, part].set(jnp.where(weights[:, :, part] > 0, 1 / sigma, 0.0))
    return eqx.tree_at(lambda p: p.segments.weights, problem, weights)
