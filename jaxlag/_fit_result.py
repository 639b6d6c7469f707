"""What a fit found: estimates, how well they are known, and how well they predict."""

from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxlag._elimination import eliminate
from jaxlag._experiment import Experiment
from jaxlag._identifiability import Spectrum
from jaxlag._segments import Layout
from jaxlag._shooting import Found, Shooting
from jaxlag._status import Status

FAINT = 1e-20
"""Damping, in squares of unknowns of order one, that keeps starts regular that are not observed."""


@final
class FitResult(eqx.Module):
    """Estimates with their uncertainty.

    Attributes:
        params: all params, those that were free at their estimates.
        names: of the numbers found, "m", "I[1,0]".
        values: their estimates, in their own units.
        covariance: of `values`, (e, e), from the derivatives at the estimates (Cramer-Rao); inf
            for numbers that take part in what is not determined. It holds for noise that is
            independent from sample to sample.
        singular_values: of the weighted derivatives by relative changes of `values`, states
            eliminated, falling: a relative change of eps along the i-th direction moves the
            weighted residuals by eps times the i-th.
        unidentifiable: null directions, in words: which numbers change together without a trace.
        determined: what is known of those: "g/l".
        unused: numbers that nothing measured depends on.
        noise: channel -> standard deviation of its noise, where it was estimated.
        residuals: of each experiment, channel -> motion less measurement, (s, k), in its own unit;
            NaN where nothing was measured or the segment failed.
        starts: of each experiment, (q, v) or (q, u) at its first time.
        gap: largest gap between segments, over the range of the states.
        converged: whether the optimiser met its tolerance.
        steps: how many it took in the last stage.
        cost: half the weighted sum of squares.
        failed: segments without a solution, each with its status.
    """

    params: Any
    names: tuple[str, ...]
    values: Float[np.ndarray, " e"]
    covariance: Float[np.ndarray, "e e"]
    singular_values: Float[np.ndarray, " e"]
    unidentifiable: tuple[str, ...]
    determined: tuple[str, ...]
    unused: tuple[str, ...]
    noise: dict[str, float]
    residuals: tuple[dict[str, np.ndarray], ...]
    starts: tuple[np.ndarray, ...]
    gap: float
    converged: bool
    steps: int
    cost: float
    failed: tuple[str, ...]
    experiments: tuple[Experiment, ...]

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of each estimate, in its own unit."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Of each estimate, the interval that holds the truth with this probability."""
        width = NormalDist().inv_cdf(0.5 + level / 2)
        return {
            name: (value - width * self.std[name], value + width * self.std[name])
            for name, value in zip(self.names, self.values.tolist(), strict=True)
        }

    def rms(self, channel: str) -> Float[np.ndarray, " k"]:
        """Root mean square of a channel's residuals over all experiments, in its own unit."""
        return root_mean_square(self.residuals, channel)

    def __str__(self) -> str:
        lines = []
        for name, value in zip(self.names, self.values.tolist(), strict=True):
            low, high = self.interval()[name]
            known = f"95 % in [{low:.6g}, {high:.6g}]" if np.isfinite(low) else "not determined"
            lines.append(f"{name:<12} {value:.6g}   {known}")
        lines += [f"unknown: {text}" for text in self.unidentifiable]
        lines += [f"known: {text}" for text in self.determined]
        channels = dict.fromkeys(name for each in self.residuals for name in each)
        for name in channels:
            lines.append(f"rms of {name}: " + ", ".join(f"{x:.3g}" for x in self.rms(name)))
        lines += list(self.failed)
        lines.append(f"{'converged' if self.converged else 'not converged'} in {self.steps} steps")
        return "\n".join(lines)


def root_mean_square(residuals: Sequence[dict[str, np.ndarray]], channel: str) -> np.ndarray:
    """Over all rows that have a number."""
    rows = np.concatenate([each[channel] for each in residuals if channel in each])
    return np.sqrt(np.nanmean(rows**2, axis=0))


def summarised(
    problem: Shooting,
    found: Found,
    experiments: tuple[Experiment, ...],
    where: Layout,
    noise: dict[str, float],
) -> FitResult:
    """The result of a search."""
    z = found.guess.z
    values = np.asarray(problem.free.numbers(z))
    by_z = np.asarray(jax.jacfwd(problem.free.numbers)(z))
    factor = np.asarray(eliminate(_without_failed(found, problem), jnp.asarray(FAINT)).params)
    factor = factor[:-1, :-1]
    by_value = np.linalg.solve(by_z.T, factor.T).T
    names = problem.free.names
    # A column of round-off: nothing depends on it, whatever it is divided by.
    sizes = np.linalg.norm(by_value * np.where(values == 0, 1.0, values), axis=0)
    least = 1e-9 * max(sizes, default=0.0)
    unused = tuple(n for n, x in zip(names, sizes, strict=True) if x <= least)
    spectrum = Spectrum(names, values, by_value)
    firsts = np.flatnonzero(where.first == 0)
    status = np.asarray(found.seen.status)
    return FitResult(
        jax.tree.map(np.asarray, problem.free.params(z)),
        names,
        values,
        spectrum.covariance(),
        spectrum.singular_values,
        spectrum.unidentifiable,
        spectrum.determined,
        unused,
        noise,
        residuals_of(problem, np.asarray(found.seen.residuals), status, experiments, where),
        tuple(np.asarray(found.starts)[firsts]),
        float(np.max(_gaps(found, problem), initial=0.0)),
        bool(found.converged),
        int(found.steps),
        float(found.cost),
        tuple(
            f"the segment of {experiments[where.owner[k]].name} that starts at"
            f" t = {problem.segments.ts[k, 0]:g} s ended with {_how_it_ended(problem, z, found, k)}"
            for k in map(int, np.flatnonzero(status != Status.ok))
        ),
        experiments,
    )


def _how_it_ended(problem: Shooting, z: Any, found: Found, k: int) -> str:
    """The status of a segment that failed, with all that can be said of it."""
    segment = jax.tree.map(lambda x: x[k], problem.segments)
    start = jnp.asarray(found.starts)[k]
    motion = problem.motion(problem.free.params(z), start, segment.ts, segment.inputs)
    return Status(int(motion.status)).name


def _gaps(found: Found, problem: Shooting) -> np.ndarray:
    """Ends less the starts that follow, over the range of the states."""
    apart = np.abs(found.seen.ends - np.roll(found.starts, -1, axis=0)) / problem.states
    return np.where(problem.segments.follows[:, None], apart, 0.0)


def _without_failed(found: Found, problem: Shooting) -> Any:
    """The linear problem without rows of segments that failed."""
    ok = (found.seen.status == Status.ok)[:, None, None]
    rows = found.rows
    joined = None if rows.joined is None else jnp.where(ok, rows.joined, 0.0)
    following = None if rows.next is None else jnp.where(ok[:, :, 0], rows.next, 0.0)
    return rows._replace(measured=jnp.where(ok, rows.measured, 0.0), joined=joined, next=following)


def residuals_of(
    problem: Shooting,
    weighted: np.ndarray,
    status: np.ndarray,
    experiments: Sequence[Experiment],
    where: Layout,
) -> tuple[dict[str, np.ndarray], ...]:
    """Of each experiment by channel, in the channels' units."""
    weights = np.asarray(problem.segments.weights)
    with np.errstate(divide="ignore", invalid="ignore"):
        raw = np.where(weights > 0, weighted / weights, np.nan)
    raw[status != Status.ok] = np.nan
    found = []
    for i, each in enumerate(experiments):
        own = np.flatnonzero(where.owner == i)
        rows = np.concatenate([raw[k, where.places[k]] for k in own])
        found.append({name: rows[:, where.columns[name]] for name in each.channels})
    return tuple(found)
