"""What a fit found: estimates, how well they are known, and how well they predict."""

from collections.abc import Mapping
from statistics import NormalDist
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import stdtrit

from jaxlag._core._errors import invalid
from jaxlag._core._status import Status
from jaxlag._fit._covariance import Spectrum, distance, linearised, saturated
from jaxlag._fit._dissipation import feeding
from jaxlag._fit._experiment import Experiment
from jaxlag._fit._free_parameters import Unknowns, paths
from jaxlag._fit._multiple_shooting import MultipleShooting, SearchResult
from jaxlag._fit._plot import plotted
from jaxlag._fit._predict import Prediction, predict, residuals_of
from jaxlag._fit._residuals import Reader, channels_of, rms_of
from jaxlag._fit._segments import SegmentLayout
from jaxlag._fit._setup import freedom
from jaxlag._simulation._jump_times import names_of
from jaxlag._system._system import System

SHOWN = 40
"""Estimates in a result's text."""
INSENSITIVE = 1e-12
"""A column of round-off, over the largest, of unknowns of order one: nothing measured depends on
its number."""


class Model(NamedTuple):
    """What moves, what is measured of it, and by which options it is simulated."""

    system: System
    channels: tuple[tuple[str, Reader], ...]
    options: tuple[tuple[str, Any], ...]


@final
class FitResult(eqx.Module):
    """Estimates with their uncertainty.

    Attributes:
        params: all params, those that were free at their estimates.
        names: of the numbers found, "m", "I[1,0]".
        values: their estimates, in their own units.
        freedom: how many more numbers were measured than went into unknowns, 0 if no segment has a
            solution.
        covariance: of `values`, (e, e), from the derivatives at the estimates (Cramer-Rao); inf
            for numbers that take part in what is not determined. It holds for noise that is
            independent from sample to sample. NaN after a `Descent` of more than 200 numbers, where
            derivatives at the estimates are not finite, and of numbers on a bound.
        singular_values: of the weighted derivatives by relative changes of `values` that are on no
            bound, states eliminated, falling: a relative change of eps along the i-th direction
            moves the weighted residuals by eps times the i-th. NaN where there is no covariance.
        unidentifiable: null directions, in words: which numbers change together without a trace.
        determined: what is known of those: "g/l".
        unused: numbers that nothing measured depends on.
        jumps: numbers that nothing shows but where a force or a row jumps, which derivatives do not
            see, and the line where each is compared: no fit moves them.
        feeding: forces that at the estimates give energy somewhere along what was measured, and
            should take it, as friction does, each with the numbers that it depends on: `Rayleigh`
            forces, and others that vanish at rest and give none with the first params.
        on_bound: numbers that ended on a bound of their transform; the covariance of the others is
            that with these held there.
        noise: channel -> standard deviation of its noise, where it was estimated.
        residuals: of each experiment, channel -> motion less measurement, (s, k), in its own unit;
            NaN where nothing was measured or the segment failed.
        starts: of each experiment, (q, v) or (q, u) at its first time.
        gap: largest gap between segments, over the range of the states; of those with a solution.
        distance: from the estimates to where derivatives lead, in standard deviations, all numbers
            together; NaN where there is no covariance. Far below 1 where a search has converged;
            more, where errors of the solver hide what params do.
        converged: whether the optimizer met its tolerance; of a `Descent`, whether costs are finite
            and lower than at first.
        iterations: how many it took in the last stage; of a `Descent`, epochs.
        solves: motions of segments, each with its derivatives, that the search took in all; line
            searches of a descent are not counted.
        cost: half the weighted sum of squares.
        failed: segments without a solution, each with its status.
        costs: of a `Descent`, mean cost of the steps of each epoch; else empty.
        experiments: what was measured.
    """

    params: Any
    names: tuple[str, ...]
    values: Float[np.ndarray, " e"]
    freedom: float
    covariance: Float[np.ndarray, "e e"]
    singular_values: Float[np.ndarray, " k"]
    unidentifiable: tuple[str, ...]
    determined: tuple[str, ...]
    unused: tuple[str, ...]
    jumps: dict[str, str]
    feeding: dict[str, tuple[str, ...]]
    on_bound: tuple[str, ...]
    noise: dict[str, float]
    residuals: tuple[dict[str, np.ndarray], ...]
    starts: tuple[np.ndarray, ...]
    gap: float
    distance: float
    converged: bool
    iterations: int
    solves: int
    cost: float
    failed: tuple[str, ...]
    costs: Float[np.ndarray, " epochs"]
    experiments: tuple[Experiment, ...]
    _model: "Model" = eqx.field(static=True)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all channels."""
        return channels_of(self.residuals)

    def predict(self, experiments: Any, settle: float | int | None = None) -> Prediction:
        """How well the estimates predict other experiments: `jl.predict` with them."""
        model = self._model
        return predict(
            model.system,
            experiments,
            self.params,
            settle=settle,
            channels=dict(model.channels),
            noise=self.noise,
            simulate_options=dict(model.options),
        )

    def plot(self) -> Any:
        """A figure of measurements and motions, residuals beneath.

        One column for every experiment, of more than four those from the best to the worst; needs
        matplotlib, from the extra "plot".

        Returns:
            A `matplotlib.figure.Figure`.
        """
        return plotted(self.experiments, self.residuals)

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of each estimate, in its own unit."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def interval(self, level: float | int = 0.95) -> dict[str, tuple[float, float]]:
        """Of each estimate, the interval that holds the truth with this probability.

        By Student's t where noise was estimated, with `freedom`; else by the normal distribution.

        Args:
            level: between 0 and 1.
        """
        if not 0 < level < 1:
            raise invalid("level", "be between 0 and 1", f"it was {level}", "Write 0.95 for 95 %.")
        width = NormalDist().inv_cdf(0.5 + level / 2)
        if self.noise and self.freedom > 0:
            width = float(stdtrit(self.freedom, 0.5 + level / 2))
        return {
            name: (value - width * self.std[name], value + width * self.std[name])
            for name, value in zip(self.names, self.values.tolist(), strict=True)
        }

    def rms(self, channel: str) -> Float[np.ndarray, " k"]:
        """Root mean square of a channel's residuals over all experiments, in its own unit."""
        return rms_of(self.residuals, channel)

    def __str__(self) -> str:
        lines = []
        interval = self.interval()
        for name, value in list(zip(self.names, self.values.tolist(), strict=True))[:SHOWN]:
            low, high = interval[name]
            known = f"95 % in [{low:.6g}, {high:.6g}]" if np.isfinite(low) else "not determined"
            known = "no covariance" if np.isnan(low) else known
            known = "on its bound" if name in self.on_bound else known
            lines.append(f"{name:<12} {value:.6g}   {known}")
        lines += [f"and {len(self.names) - SHOWN} more"] * (len(self.names) > SHOWN)
        lines += [f"unknown: {text}" for text in self.unidentifiable]
        lines += [f"known: {text}" for text in self.determined]
        lines += [f"gives energy: {name}" for name in self.feeding]
        for name in self.channels:
            lines.append(f"rms of {name}: " + ", ".join(f"{x:.3g}" for x in self.rms(name)))
        lines += list(self.failed)
        turns = "epochs" if self.costs.size else "iterations"
        ended = "converged" if self.converged else "not converged"
        lines.append(f"{ended} in {self.iterations} {turns}")
        return "\n".join(lines)


def summarised(
    problem: MultipleShooting,
    found: SearchResult,
    experiments: tuple[Experiment, ...],
    where: SegmentLayout,
    noise: dict[str, float],
    own: Mapping[str, Reader],
    costs: Float[np.ndarray, " epochs"],
    solves: int,
    compared: Mapping[str, str],
) -> FitResult:
    """The result of a search.

    Args:
        problem: the least squares.
        found: where the search ended.
        experiments: what was measured.
        where: their segments.
        noise: that was estimated.
        own: channels of the caller.
        costs: of the epochs of a descent.
        solves: what it took.
        compared: names of leaves that a jump depends on, and the line where each is compared.
    """
    z = found.guess.z
    params, values = _at(problem.free, z)
    firsts = np.flatnonzero(where.first == 0)
    status = np.asarray(found.seen.status)
    known = _uncertainty(problem, found, np.asarray(values))
    named = zip(problem.free.names, problem.free.places, strict=True)
    jumps = {name: compared[leaf.name] for name, (leaf, _) in named if leaf.name in compared}
    alive = bool(np.any(status == Status.ok)) and bool(np.isfinite(found.cost))
    return FitResult(
        jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, params),
        problem.free.names,
        np.asarray(values),
        freedom(found, problem) if alive else 0.0,
        known.covariance,
        known.singular_values,
        known.unidentifiable,
        known.determined,
        tuple(name for name in known.unused if name not in jumps),
        {name: jumps[name] for name in known.unused if name in jumps},
        _feeding(problem, params, known.covariance, experiments) if alive else {},
        known.on_bound,
        noise,
        residuals_of(problem, np.asarray(found.seen.residuals), status, experiments, where),
        tuple(np.asarray(found.starts)[firsts]),
        float(np.nanmax(_gaps(found, problem), initial=0.0)),
        known.distance,
        bool(found.converged) and alive,
        int(found.steps),
        solves,
        float(found.cost),
        tuple(
            f"the segment of {experiments[where.owner[k]].name} that starts at"
            f" t = {problem.segments.ts[k, 0]:g} s ended with {_how_it_ended(problem, z, found, k)}"
            for k in map(int, np.flatnonzero(status != Status.ok))
        ),
        costs,
        experiments,
        Model(problem.system, tuple(own.items()), problem.options),
    )


def _feeding(
    problem: MultipleShooting,
    params: Any,
    covariance: np.ndarray,
    experiments: tuple[Experiment, ...],
) -> dict[str, tuple[str, ...]]:
    """Forces that give energy and should not, with the numbers found that they depend on."""
    free = problem.free
    spread = np.sqrt(np.diag(covariance))
    moved = []
    for (leaf, at), by in zip(free.places, spread, strict=True):
        if np.isfinite(by):
            leaves, form = jax.tree.flatten(params)
            leaves[leaf.index] = np.array(leaves[leaf.index])
            leaves[leaf.index][at] += by
            moved.append(jax.tree.unflatten(form, leaves))
    given = feeding(problem.system, experiments, free.params0, params, moved, dict(problem.options))
    names = dict(zip(names_of(free.params0), paths(free.params0), strict=True))
    found = {}
    for force, reads in given.items():
        read = {names[leaf] for leaf in reads}
        pairs = zip(free.names, free.places, strict=True)
        found[force] = tuple(name for name, (leaf, _) in pairs if leaf.name in read)
    return {force: numbers for force, numbers in found.items() if numbers}


class _Uncertainty(NamedTuple):
    """How well estimates are known: attributes of a `FitResult`."""

    covariance: np.ndarray
    singular_values: np.ndarray
    unidentifiable: tuple[str, ...]
    determined: tuple[str, ...]
    unused: tuple[str, ...]
    on_bound: tuple[str, ...]
    distance: float


def _uncertainty(
    problem: MultipleShooting, found: SearchResult, values: np.ndarray
) -> _Uncertainty:
    names = np.array(problem.free.names)
    unknown = np.full((len(names), len(names)), np.nan)
    nothing = _Uncertainty(unknown, np.full(len(names), np.nan), (), (), (), (), np.nan)
    if found.rows is None:
        return nothing
    factor, by_z, at_first = map(np.asarray, linearised(problem.free, found))
    if not np.all(np.isfinite(factor)) or not np.all(np.isfinite(by_z)):
        return nothing
    told = np.linalg.norm(factor, axis=0) > INSENSITIVE * np.linalg.norm(factor)
    held = problem.free.at_limit(found.guess.z) & told
    moves = ~(saturated(factor, by_z, at_first) | held)
    own = np.ix_(moves, moves)
    by_value = np.linalg.solve(by_z[own].T, np.where(told, factor, 0.0)[:, moves].T).T
    spectrum = Spectrum(tuple(names[moves].tolist()), values[moves], by_value)
    unknown[own] = spectrum.covariance()
    return _Uncertainty(
        unknown,
        spectrum.singular_values,
        spectrum.unidentifiable,
        spectrum.determined,
        tuple(names[moves & ~told].tolist()),
        tuple(names[~moves].tolist()),
        float(distance(found, jnp.asarray(moves & told))),
    )


@eqx.filter_jit  # one program: operation by operation they took seconds to compile
def _at(free: Unknowns, z: Float[Array, " p"]) -> tuple[Any, Array]:
    """(all params, the numbers found)."""
    return free.params(z), free.numbers(z)


def _how_it_ended(problem: MultipleShooting, z: Any, found: SearchResult, k: int) -> str:
    """The status of a segment that failed, or the channel that is not finite."""
    segment = jax.tree.map(lambda x: x[k], problem.segments)
    start = jnp.asarray(found.starts)[k]
    params = problem.free.params(z)
    motion = problem.motion(params, start, segment.ts, segment.inputs.at(params, segment.ts))
    if motion.ok:
        for name, show in problem.channels:
            if not np.all(np.isfinite(np.asarray(show(motion)))):
                return f"a channel that is not finite: {name!r}"
    return Status(int(motion.status)).name


def _gaps(found: SearchResult, problem: MultipleShooting) -> np.ndarray:
    """Ends less the starts that follow, over the range of the states."""
    apart = np.abs(found.seen.ends - np.roll(found.starts, -1, axis=0)) / problem.states[None]
    ok = np.asarray(found.seen.status == Status.ok)[:, None]
    return np.where(problem.segments.follows[:, None], np.where(ok, apart, np.nan), 0.0)
