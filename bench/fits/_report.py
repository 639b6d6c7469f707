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
        recording: what was measured, or simulated.
        model: what it was fitted with.
        quantity: what was found.
        unit: of the numbers; "SI" where the model says it.
        value: of the quantity.
        low: of its 95 % interval, where it has one.
        high: likewise.
        other: the number to read it by.
        whose: that number is.
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
    """What one recording gives."""

    figures: list[Figure]
    targets: list[Target]
    references: list[Reference]


def timed(
    recording: str, model: str, fit: Callable[[], jl.FitResult], turns: int = 2
) -> tuple[jl.FitResult, list[Figure]]:
    """A fit, and what it cost: the last time, when all programs are compiled, and the first."""
    seconds = []
    for _ in range(turns):
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
    rows = []
    for name, value in zip(found.names, found.values.tolist(), strict=True):
        low, high = intervals[name]
        other = others.get(name)
        own = None if other is None else whose
        rows.append(Figure(recording, model, name, "SI", value, low, high, other, own))
    return rows


def missed(prediction: jl.Prediction, channel: str) -> Float[np.ndarray, " k"]:
    """Root mean square of what a prediction misses; inf where a motion failed."""
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
    """Root mean squares of angles, given in rad, as mrad; those of others in mrad."""
    rows = []
    for i, value in enumerate(rms):
        other = others[i] if len(others) else None
        name = f"{quantity}, angle {i + 1}"
        own = None if other is None else whose
        rows.append(Figure(recording, model, name, "mrad", 1e3 * value, None, None, other, own))
    return rows
