"""One part of a report on fits."""

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

import jaxlag as jl
from bench._harness.timing import Reference, Target


class Figure(NamedTuple):
    """One number of a report.

    Attributes:
        recording: the recording, or the simulated system.
        model: the fitted model.
        quantity: name of the quantity.
        unit: of the values; "SI" if the model defines it.
        value: of the quantity.
        low: lower limit of its 95 % interval, if it has one.
        high: upper limit of this interval.
        other: a value for comparison.
        whose: source of `other`.
    """

    recording: str
    model: str
    quantity: str
    unit: str
    value: float
    low: float | None = None
    high: float | None = None
    other: float | None = None
    whose: str | None = None


class Part(NamedTuple):
    """The results for one recording."""

    figures: list[Figure]
    targets: list[Target]
    references: list[Reference]


def timed(
    recording: str, model: str, fit: Callable[[], jl.FitResult], repeats: int = 2
) -> tuple[jl.FitResult, list[Figure]]:
    """A fit and its cost: run time with all programs compiled, and that of the first run."""
    seconds = []
    for _ in range(repeats):
        begun = perf_counter()
        found = fit()
        seconds.append(perf_counter() - begun)
    again = [Figure(recording, model, "run time of the fit", "s", x) for x in seconds[1:]]
    return found, [
        *again,
        Figure(recording, model, "run time the first time, compiling", "s", seconds[0]),
        Figure(recording, model, "motions with derivatives", "1", float(found.solves)),
    ]


def estimates(
    recording: str, model: str, found: jl.FitResult, others: Mapping[str, float], whose: str
) -> list[Figure]:
    """Estimates with their 95 % intervals."""
    intervals = found.interval()
    figures = []
    for name, value in zip(found.names, found.values.tolist(), strict=True):
        low, high = intervals[name]
        other = others.get(name)
        own = None if other is None else whose
        figures.append(Figure(recording, model, name, "SI", value, low, high, other, own))
    return figures


def missed(prediction: jl.Prediction, channel: str) -> Float[np.ndarray, " k"]:
    """Root mean square of the errors of a prediction; inf if a motion failed."""
    rms = prediction.rms(channel)
    return np.full_like(rms, np.inf) if prediction.failed else rms


def errors(
    recording: str,
    model: str,
    quantity: str,
    rms: Sequence[float],
    others: Sequence[float] = (),
    whose: str = "",
) -> list[Figure]:
    """Root mean squares of angles, given in rad, as figures in mrad; `others` are in mrad."""
    figures = []
    for i, value in enumerate(rms):
        other = others[i] if len(others) else None
        name = f"{quantity}, angle {i + 1}"
        own = None if other is None else whose
        figures.append(Figure(recording, model, name, "mrad", 1e3 * value, None, None, other, own))
    return figures
