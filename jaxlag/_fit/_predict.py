"""Predictions: initial states from the first measurements, motions compared with the later ones."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxlag._core._arguments import by_name, renamed
from jaxlag._core._errors import invalid
from jaxlag._core._status import Status
from jaxlag._fit._experiment import Experiment
from jaxlag._fit._free_parameters import NO_PRIOR, unknowns
from jaxlag._fit._initial_guess import start_freedom
from jaxlag._fit._multiple_shooting import FitVariables, MultipleShooting, moved, search
from jaxlag._fit._plot import plotted
from jaxlag._fit._residuals import Reader, channels_of, rms_of, squares
from jaxlag._fit._segments import SegmentLayout, layout
from jaxlag._fit._setup import (
    FORMER,
    OURS,
    build_shooting,
    check_known_params,
    check_search,
    experiments_of,
    readers_of,
)
from jaxlag._simulation._options._simulate_options import NO_OPTIONS, plain_options
from jaxlag._system._system import System
from jaxlag._tracing._params import check_keys
from jaxlag._tracing._traced_function import warn_of_changes


@final
class Prediction(eqx.Module):
    """Predictions of experiments, compared with the measurements.

    Attributes:
        residuals: for each experiment, channel -> motion minus measurement, (s, k), in its own
            unit; NaN for missing values and failed motions.
        predicted: for each experiment, (s,): samples not used in the fit of the start; all of them
            if all were used.
        starts: for each experiment, (q, v) or (q, u) at its first time.
        failed: experiments whose motion failed, each with its status.
        converged: whether the search for starts met its tolerance.
        experiments: the measurements.
    """

    residuals: tuple[dict[str, np.ndarray], ...]
    predicted: tuple[np.ndarray, ...]
    starts: tuple[np.ndarray, ...]
    failed: tuple[str, ...]
    converged: bool
    experiments: tuple[Experiment, ...]

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all channels."""
        return channels_of(self.residuals)

    def rms(self, channel: str) -> Float[np.ndarray, " k"]:
        """Root mean square of a channel over all predicted samples, in its own unit."""
        own = zip(self.residuals, self.predicted, strict=True)
        parts = [{name: x[samples] for name, x in each.items()} for each, samples in own]
        return rms_of(parts, channel)

    def plot(self) -> Any:
        """A figure as `FitResult.plot`, with a dotted line where predictions begin."""
        return plotted(self.experiments, self.residuals, self.predicted)

    def __str__(self) -> str:
        lines = [
            f"rms of {name}: " + ", ".join(f"{x:.3g}" for x in self.rms(name))
            for name in self.channels
        ]
        return "\n".join([*lines, *self.failed])


@renamed(**FORMER)
def predict(
    system: System,
    experiments: Any,
    params: Any,
    *,
    settle: float | int | None = None,
    channels: Mapping[str, Reader] | None = None,
    noise: Mapping[str, float] | None = None,
    rtol: float = 1e-6,
    atol: float = 1e-6,
    max_steps: int = 100,
    simulate_options: Mapping[str, Any] = NO_OPTIONS,
) -> Prediction:
    """Predictions of experiments with given params; the experiments may be new.

    The start of each experiment is fitted to its first `settle` seconds, with fixed params. The
    motion from there is compared with all measurements.

    Args:
        system: the mechanical system.
        experiments: one `Experiment` or more.
        params: all params.
        settle: s, from the first time of each experiment; None fits its start to all of it.
        channels: as for `jl.fit`.
        noise: channel -> standard deviation, for experiments without sigma: weights of the
            channels in the fit of starts.
        rtol: relative tolerance of the starts and residuals, both of order one.
        atol: absolute tolerance of the same.
        max_steps: bound on the steps of the Levenberg-Marquardt method.
        simulate_options: options of `jl.simulate`, such as `{"method": "tsit5", "rtol": 1e-7}`.

    Raises:
        ValueError: an invalid argument, named; a `settle` with fewer
            measurements than numbers in a start.

    Warns:
        if the search for the starts did not converge, and of each failed motion: its
        samples do not count.

    Example:
        >>> import jax, jax.numpy as jnp, jaxlag as jl, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     return 0.5 * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2
        >>> spring = jl.System(lagrangian, coordinates=("x",))
        >>> ts = np.linspace(0.0, 3.0, 31)
        >>> data = jl.Experiment(ts, {"x": 0.3 * np.cos(2.0 * ts)})
        >>> good, bad = (jl.predict(spring, data, {"k": k}, settle=0.5) for k in (4.0, 4.4))
        >>> print(f"{good.rms('x')[0]:.3f} {bad.rms('x')[0]:.3f}")
        0.000 0.031
    """
    experiments = experiments_of(experiments)
    options = plain_options(simulate_options, "jl.predict", OURS)
    check_search(rtol, atol, max_steps)
    own = by_name("channels", channels, "lambda motion: motion['theta']")
    check_known_params("predict", system, experiments, "params", params)
    check_keys(own, "channels")
    warn_of_changes(system, *(each.inputs for each in experiments))
    fewest = start_freedom(system, params)
    early = tuple(_first(fewest, each, settle) for each in experiments)
    fixed = unknowns(params, (), {})
    shown = readers_of(system, experiments, own, params)

    def posed(these: tuple[Experiment, ...]) -> tuple[MultipleShooting, SegmentLayout]:
        where = layout(these, 1)
        problem, _ = build_shooting(
            system, these, where, fixed, shown, NO_PRIOR, squares, options, noise
        )
        return problem, where

    whole, where = posed(early)
    nowhere = FitVariables(jnp.zeros(0), jnp.zeros(whole.segments.guess.shape))
    found = search(whole, nowhere, jnp.asarray(1.0), jnp.asarray((rtol, atol)), max_steps)
    if not found.converged:
        text = f"The search for initial states did not converge in {int(found.steps)} iterations: "
        warnings.warn(text + "raise max_steps or settle.", stacklevel=2)
    seen = found.seen
    if settle is not None:
        whole, where = posed(experiments)
        whole = eqx.tree_at(lambda p: p.segments.guess, whole, found.starts)
        seen = moved(whole, nowhere)
    status = np.asarray(seen.status)
    failed = tuple(
        f"the motion of {experiments[k].name} ended with {Status(int(status[k])).name}"
        for k in map(int, np.flatnonzero(status != Status.ok))
    )
    for text in failed:
        warnings.warn(f"{text}: it is ignored.", stacklevel=2)
    samples = tuple(
        np.ones(len(each.ts), bool) if settle is None else np.arange(len(each.ts)) >= len(first.ts)
        for each, first in zip(experiments, early, strict=True)
    )
    return Prediction(
        residuals_of(whole, np.asarray(seen.residuals), status, experiments, where),
        samples,
        tuple(np.asarray(found.starts)),
        failed,
        bool(found.converged),
        experiments,
    )


def _first(fewest: int, experiment: Experiment, settle: float | int | None) -> Experiment:
    """The samples to which a start is fitted."""
    if settle is None:
        return experiment
    if not settle > 0:
        raise invalid("settle", "be a positive number of seconds, or None", f"it was {settle!r}")
    samples = int(np.searchsorted(experiment.ts, experiment.ts[0] + settle, side="right"))
    if samples >= len(experiment.ts):
        was = f"it was {settle:g} s of {experiment.ts[-1] - experiment.ts[0]:g} s"
        raise invalid("settle", f"leave samples of {experiment.name} to be predicted", was)
    known = experiment.start_sigma is not None
    numbers = sum(int(np.isfinite(x[:samples]).sum()) for x in experiment.channels.values())
    if samples < 2 or (not known and numbers < fewest):
        must = (
            f"contain {fewest} measurements or more of {experiment.name}, to determine the initial "
            "state"
        )
        raise invalid("settle", must, f"the first {settle:g} s contain {numbers}", "Raise settle.")
    return experiment.part(slice(0, samples))


def residuals_of(
    problem: MultipleShooting,
    weighted: np.ndarray,
    status: np.ndarray,
    experiments: Sequence[Experiment],
    where: SegmentLayout,
) -> tuple[dict[str, np.ndarray], ...]:
    """For each experiment by channel, in the channels' units; NaN for failed segments."""
    weights = np.asarray(problem.segments.weights)
    with np.errstate(divide="ignore", invalid="ignore"):
        raw = np.where(weights > 0, weighted / weights, np.nan)
    raw[status != Status.ok] = np.nan
    found = []
    for i, each in enumerate(experiments):
        own = np.flatnonzero(where.owner == i)
        samples = np.concatenate([raw[k, where.places[k]] for k in own])
        found.append({name: samples[:, where.columns[name]] for name in each.channels})
    return tuple(found)
