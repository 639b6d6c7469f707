"""Parameters from measurements: least squares over motions, by multiple shooting."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxlag._channels import Reader, readers
from jaxlag._errors import bad
from jaxlag._experiment import Experiment
from jaxlag._fit_result import FitResult, summarised
from jaxlag._free import Prior, Unknowns, prior_rows, unknowns
from jaxlag._initial_states import initial_states, typical
from jaxlag._segments import Layout, layout, pack
from jaxlag._shooting import LOSSES, Found, Guess, Shooting, search, squares
from jaxlag._system import System

GAPS = (1e-1, 1e-2, 1e-3, 1e-5)
"""Standard deviations of the gaps between segments, stage by stage, over the states' ranges."""
NOISE_ROUNDS = 3
"""How often noise that was not given is estimated, and the fit repeated with it."""
STATES_FOR_RANGE = 32


def fit(
    system: System,
    experiments: Any,
    params0: Any,
    *,
    free: Sequence[str],
    channels: Mapping[str, Reader] | None = None,
    segments: int = 1,
    transforms: Mapping[str, Any] | None = None,
    priors: Mapping[str, Prior] | None = None,
    loss: str = "squares",
    tolerance: float = 1e-6,
    max_steps: int = 100,
    **options: Any,
) -> FitResult:
    r"""Params, and starts of experiments, for which motions come closest to what was measured.

        min  sum (g(y_i) - m_i)^2 / sigma_i^2 + sum (theta - mean)^2 / sigma^2

    over params theta and starts; y_i is the motion at the times of the measurements, g what a
    channel shows of it. With `segments` above 1, each experiment is cut into so many, whose starts
    are unknown, too, and which are joined in the same least squares, ever more tightly: from a poor
    guess, and over many Lyapunov times, that converges where the one long motion does not. Segments
    are lanes of one batch, and the linear algebra is linear in their number.

    A segment whose solve fails counts as far off, does not move the params, and is named at the
    end. Noise that no experiment states is estimated from the residuals, and the fit repeated.

    Args:
        system: what moves.
        experiments: one `Experiment` or more, of any lengths and rates; those of pieces that are
            not joined, too (`Experiment.windows`).
        params0: all params; where the search starts.
        free: names of leaves to be found: "m", "link.mass", "links[0].mass"; a branch stands for
            all leaves below it.
        channels: name -> function of a `Solution` to what was measured at its rows, (s,) or (s, k);
            beside those that names mean by themselves.
        segments: per experiment; 1 is single shooting.
        transforms: name -> transform of a free leaf.
        priors: name -> `Prior` of a free leaf, in its own unit.
        loss: "squares"; "soft_l1", "huber", "cauchy" count outliers for less (of residuals over
            sigma, so state sigma).
        tolerance: relative and absolute, of unknowns and residuals, both of order one.
        max_steps: of the optimiser, in each stage.
        options: of `jl.simulate`: method, rtol, atol, dt, max_steps, formulation and others.

    Raises:
        ValueError: an argument of wrong form or value, named; fewer measurements than unknowns.

    Warns:
        of a parameter that starts on a bound, one that nothing measured depends on, a channel that
        is constant, segments whose solve fails, a search that did not converge, each by name.

    Source: Bock (1983), see `_shooting`; Schittkowski, Numerical Data Fitting in Dynamical Systems
    (2002).

    Example:
        A mass on a spring: how it swings tells k/m alone.

        >>> import jax, jax.numpy as jnp, jaxlag as jl, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     return 0.5 * params["m"] * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2
        >>> spring = jl.System(lagrangian, coordinates=("x",))
        >>> ts = np.linspace(0.0, 3.0, 31)
        >>> noise = 1e-3 * np.sin(1e3 * ts)
        >>> data = jl.Experiment(ts, {"x": 0.3 * np.cos(2.0 * ts) + noise})
        >>> found = jl.fit(spring, data, {"m": 1.0, "k": 3.0}, free=("k",))
        >>> print(f"{found.params['k']:.2f} {found.converged}")
        4.00 True
    """
    experiments = _experiments(experiments)
    _check(system, segments, loss, options)
    unknown = unknowns(params0, free, dict(transforms or {}))
    names = tuple(dict.fromkeys(name for each in experiments for name in each.channels))
    rows = _row_names(system, params0)
    shown = readers(system, names, channels or {}, rows)
    where = layout(experiments, segments)
    prior = prior_rows(unknown, dict(priors or {}))
    _count(experiments, unknown, len(prior[0]), len(experiments) * 2 * system.size)
    if system.constraints:
        options = {"assemble": True} | options
    _warn_before(experiments, unknown)
    problem, noise = _problem(
        system, experiments, where, unknown, shown, prior, loss, dict(options)
    )
    found = _stages(problem, tolerance, max_steps)
    for _ in range(NOISE_ROUNDS if noise else 0):
        changed = _noise(found, problem, where, noise)
        settled = all(abs(changed[name] / noise[name] - 1) < 0.02 for name in noise)
        noise, problem = changed, _with_noise(problem, where, changed)
        join = jnp.asarray(GAPS[-1] if problem.chained else 1.0)
        found = search(problem, found.guess, join, tolerance, max_steps)
        if settled:
            break
    result = summarised(problem, found, experiments, where, noise)
    _warn_after(result)
    return result


def _experiments(given: Any) -> tuple[Experiment, ...]:
    found = (given,) if isinstance(given, Experiment) else tuple(given)
    if not found or not all(isinstance(x, Experiment) for x in found):
        raise bad("experiments", "be a jl.Experiment or a sequence of them", f"it was {given!r}")
    return found


def _check(system: Any, segments: Any, loss: Any, options: Mapping[str, Any]) -> None:
    if not isinstance(system, System):
        raise bad("system", "be a jl.System", f"it was {system!r}")
    if not isinstance(segments, int | np.integer) or segments < 1:
        raise bad("segments", "be a positive integer", f"it was {segments!r}")
    if loss not in LOSSES:
        raise bad("loss", f"be one of {list(LOSSES)}", f"it was {loss!r}")
    for name in ("save", "throw", "inputs", "q0", "v0", "u0", "ts", "params", "estimate_error"):
        if name in options:
            raise bad(name, "be left to jl.fit", "it was given")


def _row_names(system: System, params: Any) -> tuple[str, ...]:
    if not system.constraints:
        return ()
    return tuple(system.rows(params, jnp.dtype(float)).labels)


def _count(experiments: Sequence[Experiment], free: Unknowns, priors: int, states: int) -> None:
    """Raise where there is less to be known from than is to be known."""
    numbers = sum(int(np.isfinite(x).sum()) for each in experiments for x in each.channels.values())
    if numbers + priors < len(free.u0) + states:
        must = f"hold at least as many numbers as there are unknowns, {len(free.u0) + states}"
        was = f"they held {numbers}"
        raise bad("experiments", must, was, "Measure more, or free fewer parameters.")


def _unstated(experiments: Sequence[Experiment]) -> set[str]:
    """Channels whose noise one experiment or more does not state."""
    without = {name for each in experiments for name in each.channels if name not in each.sigma}
    for name in without & {name for each in experiments for name in each.sigma}:
        was = f"that of {name!r} was given in some"
        raise bad("sigma", "be given in all experiments that measure a channel, or in none", was)
    return without


def _warn_before(experiments: Sequence[Experiment], free: Unknowns) -> None:
    for name in free.on_bound:
        text = f"{name} starts on its bound: moved a hundredth of the range inside."
        warnings.warn(text, stacklevel=3)
    for each in experiments:
        for name, x in each.channels.items():
            if np.all(np.nanmax(x, axis=0) == np.nanmin(x, axis=0)):
                text = f"channel {name!r} of {each.name} is constant: it may be disconnected."
                warnings.warn(text, stacklevel=3)


def _problem(
    system: System,
    experiments: Sequence[Experiment],
    where: Layout,
    free: Unknowns,
    shown: Mapping[str, Reader],
    prior: tuple[np.ndarray, np.ndarray, np.ndarray],
    loss: str,
    options: dict[str, Any],
) -> tuple[Shooting, dict[str, float]]:
    """The problem, and the noise assumed of channels whose noise is not stated."""
    ranges = {
        name: np.concatenate([x.channels[name] for x in experiments if name in x.channels])
        for name in where.columns
    }
    ranges = {name: np.nanstd(x, axis=0) for name, x in ranges.items()}
    ranges = {name: np.where(x > 0, x, 1.0) for name, x in ranges.items()}
    noise = {name: 1e-2 * float(np.max(ranges[name])) for name in _unstated(experiments)}
    guesses, spread = [], []
    params = free.params0
    for i, each in enumerate(experiments):
        rows = where.first[where.owner == i].tolist()
        some = np.linspace(0, len(each.ts) - 1, STATES_FOR_RANGE).astype(int).tolist()
        states = initial_states(system, each, rows + some, params, options)
        guesses.append(states[: len(rows)])
        spread.append(states[len(rows) :])
    segments = pack(system, experiments, where, noise, np.concatenate(guesses))
    problem = Shooting(
        system,
        tuple(sorted(options.items())),
        tuple(shown.items()),
        LOSSES[loss],
        bool(np.any(segments.follows)),
        free,
        segments,
        jnp.asarray(typical(np.concatenate(spread))),
        jnp.asarray(np.concatenate([ranges[name] for name in where.columns])),
        (jnp.asarray(prior[0]), jnp.asarray(prior[1]), jnp.asarray(prior[2])),
    )
    return problem, noise


def _stages(problem: Shooting, tolerance: float, max_steps: int) -> Found:
    """From loosely joined segments to one motion; by squares first, whatever the loss.

    Losses that count outliers for less have minima wherever everything is an outlier.
    """
    guess = Guess(jnp.zeros(len(problem.free.u0)), jnp.zeros(problem.segments.guess.shape))
    by_squares = replace(problem, loss=squares)
    gaps = GAPS if problem.chained else (1.0,)
    for gap in gaps:
        last = gap == gaps[-1] and problem.loss is squares
        rough = tolerance if last else max(tolerance, 1e-4)
        found = search(by_squares, guess, jnp.asarray(gap), rough, max_steps)
        guess = found.guess
    if problem.loss is not squares:
        found = search(problem, guess, jnp.asarray(gaps[-1]), tolerance, max_steps)
    return found


def _noise(
    found: Found, problem: Shooting, where: Layout, noise: Mapping[str, float]
) -> dict[str, float]:
    """Standard deviations of the channels' residuals, m, rad or what they are measured in."""
    measured = np.asarray(problem.segments.weights) > 0
    unknowns = len(problem.free.u0) + np.count_nonzero(~problem.segments.follows) * len(
        problem.states
    )
    share = 1.0 - unknowns / np.count_nonzero(measured)
    ok = (np.asarray(found.seen.status) == 0)[:, None, None]
    changed = {}
    for name, sigma in noise.items():
        part = where.columns[name]
        used = (measured & ok)[:, :, part]
        sum_of_squares = np.sum(
            np.where(used, np.asarray(found.seen.residuals)[:, :, part] ** 2, 0.0)
        )
        mean = sum_of_squares / max(1.0, share * np.count_nonzero(used))
        # Measurements without noise: what is left then is the solver's.
        changed[name] = sigma * max(float(np.sqrt(mean)), 1e-9)
    return changed


def _with_noise(problem: Shooting, where: Layout, noise: Mapping[str, float]) -> Shooting:
    """The problem with other weights of these channels."""
    weights = problem.segments.weights
    for name, sigma in noise.items():
        part = where.columns[name]
        weights = weights.at[:, :, part].set(jnp.where(weights[:, :, part] > 0, 1 / sigma, 0.0))
    return eqx.tree_at(lambda p: p.segments.weights, problem, weights)


def _warn_after(result: FitResult) -> None:
    if not result.converged:
        text = f"The search did not converge in {result.steps} steps: raise max_steps, take more "
        warnings.warn(text + "segments, or start closer.", stacklevel=3)
    for name in result.unused:
        warnings.warn(f"nothing measured depends on {name}: it keeps its value.", stacklevel=3)
    for text in result.failed:
        warnings.warn(f"{text}: it does not count.", stacklevel=3)
