"""FitResult: estimates, their uncertainties, and their predictions."""

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
from jaxlag._fit._covariance import Spectrum, distance, linearized, saturated
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
"""Number of estimates in a result's text."""
INSENSITIVE = 1e-12
"""Relative column norm below which a parameter does not affect any measurement."""


class Model(NamedTuple):
    """The system, its measured channels, and the options of its simulation."""

    system: System
    channels: tuple[tuple[str, Reader], ...]
    options: tuple[tuple[str, Any], ...]


@final
class FitResult(eqx.Module):
    """Estimates with their uncertainty.

    Attributes:
        params: all params, with estimates of the free ones.
        names: names of the estimated numbers, "m", "I[1,0]".
        values: their estimates, in their own units.
        freedom: degrees of freedom: measurements minus effective unknowns; 0 if no segment has a
            solution.
        covariance: of `values`, (e, e), from the derivatives at the estimates (Cramer-Rao); inf
            for numbers in unidentifiable directions. It holds for noise that is
            independent from sample to sample. NaN after a `Descent` of more than 200 numbers, if
            derivatives at the estimates are nonfinite, and for numbers on a bound.
        singular_values: of the weighted derivatives by relative changes of `values` that are not on
            a bound, states eliminated, descending: a relative change of eps along the i-th
            direction changes the weighted residuals by eps times the i-th. NaN without covariance.
        unidentifiable: null directions, as text: numbers that change together without effect.
        determined: the identifiable combinations of these: "g/l".
        unused: numbers without effect on any measurement.
        jumps: numbers with an effect only at jumps of a force or a row, which derivatives do not
            contain, and the line of each comparison: a fit does not change them.
        feeding: dissipative forces that supply energy at the estimates somewhere along the
            measurements, each with the numbers on which it depends. These are `Rayleigh`
            forces, and others that vanish at rest and supply no energy with the initial params.
        on_bound: numbers that ended on a bound of their transform; the covariance of the others is
            that with these held there.
        noise: channel -> standard deviation of its noise, if it was estimated.
        residuals: for each experiment, channel -> motion minus measurement, (s, k), in its own
            unit; NaN for missing values and failed segments.
        starts: for each experiment, (q, v) or (q, u) at its first time.
        gap: largest gap between segments, over the range of the states, without failed ones.
        distance: length of the Newton step at the estimates, in standard deviations, all numbers
            together; NaN without covariance. Far below 1 for a converged search;
            larger if solver errors exceed the effect of params.
        converged: whether the optimizer met its tolerance; for a `Descent`, whether costs are
            finite and lower than at first.
        iterations: number in the last stage; epochs for a `Descent`.
        solves: total number of segment motions, each with its derivatives; line
            searches of a descent are not counted.
        cost: half the weighted sum of squares.
        failed: segments without a solution, each with its status.
        costs: for a `Descent`, mean cost of the steps of each epoch; else empty.
        experiments: the measurements.
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
        """Predictions of other experiments with the estimates, by `jl.predict`."""
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

        One column for every experiment; of more than four a selection from the best to the worst.
        Needs matplotlib, from the extra "plot".

        Returns:
            A `matplotlib.figure.Figure`.
        """
        return plotted(self.experiments, self.residuals)

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of each estimate, in its own unit."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def interval(self, level: float | int = 0.95) -> dict[str, tuple[float, float]]:
        """For each estimate, the interval that contains the true value with this probability.

        By Student's t with `freedom` if noise was estimated, else by the normal distribution.

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
        lines += [f"adds energy: {name}" for name in self.feeding]
        for name in self.channels:
            lines.append(f"rms of {name}: " + ", ".join(f"{x:.3g}" for x in self.rms(name)))
        lines += list(self.failed)
        unit = "epochs" if self.costs.size else "iterations"
        ended = "converged" if self.converged else "not converged"
        lines.append(f"{ended} in {self.iterations} {unit}")
        return "\n".join(lines)


def summarized(
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
        found: the result of the search.
        experiments: the measurements.
        where: their segments.
        noise: estimated noise.
        own: channels of the caller.
        costs: of the epochs of a descent.
        solves: number of solves.
        compared: names of leaves that a jump depends on, and the line of each comparison.
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
    """Dissipative forces that supply energy, with the estimated numbers on which they depend."""
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
    """Uncertainty of estimates: attributes of a `FitResult`."""

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
    factor, by_z, at_first = map(np.asarray, linearized(problem.free, found))
    if not np.all(np.isfinite(factor)) or not np.all(np.isfinite(by_z)):
        return nothing
    sensitive = np.linalg.norm(factor, axis=0) > INSENSITIVE * np.linalg.norm(factor)
    held = problem.free.at_limit(found.guess.z) & sensitive
    moves = ~(saturated(factor, by_z, at_first) | held)
    block = np.ix_(moves, moves)
    by_value = np.linalg.solve(by_z[block].T, np.where(sensitive, factor, 0.0)[:, moves].T).T
    spectrum = Spectrum(tuple(names[moves].tolist()), values[moves], by_value)
    unknown[block] = spectrum.covariance()
    return _Uncertainty(
        unknown,
        spectrum.singular_values,
        spectrum.unidentifiable,
        spectrum.determined,
        tuple(names[moves & ~sensitive].tolist()),
        tuple(names[~moves].tolist()),
        float(distance(found, jnp.asarray(moves & sensitive))),
    )


@eqx.filter_jit  # one program: separate operations took seconds to compile
def _at(free: Unknowns, z: Float[Array, " p"]) -> tuple[Any, Array]:
    """(all params, the estimated numbers)."""
    return free.params(z), free.numbers(z)


def _how_it_ended(problem: MultipleShooting, z: Any, found: SearchResult, k: int) -> str:
    """The status of a failed segment, or its nonfinite channel."""
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
    """Ends minus the following starts, over the range of the states."""
    gaps = np.abs(found.seen.ends - np.roll(found.starts, -1, axis=0)) / problem.states[None]
    ok = np.asarray(found.seen.status == Status.ok)[:, None]
    return np.where(problem.segments.follows[:, None], np.where(ok, gaps, np.nan), 0.0)
