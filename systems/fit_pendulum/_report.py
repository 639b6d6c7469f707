"""Tables and a figure for the fits of a pendulum."""

from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import jaxlag as jl
from systems.fit_pendulum._data import RATE, Recording, data_error
from systems.fit_pendulum._models import (
    EARLY,
    FRICTION,
    Trial,
    choose,
    correlation,
    count,
    estimated,
    samples_each,
)

# Symbol and unit of each parameter if the torque is known, and in a free swing.
DRIVEN = {
    "J": ("J", "kg m^2"),
    "mgl": ("mgl", "N m"),
    "c": ("c", "N m s"),
    "f": ("f", "N m"),
    "k": ("k", "N m s^2"),
    "u0": ("u0", "N m"),
    "zero": ("zero", "rad"),
}
FREE = {
    "mgl": ("mgl/J", "1/s^2"),
    "c": ("c/J", "1/s"),
    "f": ("f/J", "1/s^2"),
    "k": ("k/J", "1"),
    "zero": ("zero", "rad"),
}
# Reference errors, mrad rms: from quick fits by multiple shooting, made when these recordings were
# selected. They are for whole segments of the first, for windows of 1 s of the other two.
TO_BEAT = {
    "single.csv.gz": {"viscous": 7.8, "+ Coulomb": 6.7, "+ quadratic": 2.05},
    "ddp.csv.gz": {"+ Coulomb": 3.3},
    "ilqr.csv.gz": {"+ Coulomb": 26.0},
}
NEEDS_MATPLOTLIB = 'matplotlib is missing: pip install -e ".[plot]"'
SUFFIXES = (".png", ".pdf", ".svg")


def describe(recording: Recording) -> str:
    """A recording in one line."""
    segments = list(recording.segments.values())
    sample_count = sum(len(segment.ts) for segment in segments)
    reach = max(float(np.max(np.abs(segment.channels["q"]))) for segment in segments)
    rate = 1 / recording.spacing
    used = f" (angles used at {RATE:.0f} Hz)" if rate > 1.5 * RATE else ""
    return (
        f"{recording.name}: {'driven' if recording.driven else 'free swing'}, "
        f"{len(segments)} segment{'s' * (len(segments) > 1)}, {sample_count} samples at "
        f"{rate:.0f} Hz{used}, up to {reach:.2f} rad from hanging"
    )


def trials(
    recording: Recording,
    other: Recording | None,
    trials: Mapping[str, Trial],
    truth: Mapping[str, float] | None = None,
) -> Iterator[str]:
    """Lines of the table of models fitted to windows, and its interpretation."""
    symbols = DRIVEN if recording.driven else FREE
    beat_train = TO_BEAT.get(recording.name, {}) if other else {}
    beat_test = TO_BEAT.get(other.name, {}) if other else {}
    rows = list(_head(symbols, ["train", "test", f"from {EARLY:g} s"]))
    if truth:
        rows.append(["truth", *(f"{truth.get(name, 0.0):g}" for name in symbols), *[""] * 3])
    for model, trial in trials.items():
        values, errors = _numbers(trial.fit, model, symbols)
        against = (beat_train.get(model), beat_test.get(model), None)
        pooled = [
            f"{mrad(x):.3f}" + (f" ({figure:g})" if figure else "")
            for x, figure in zip(trial, against, strict=True)
        ]
        rows.append([_name(model, trial.fit), *values, *pooled])
        rows.append(["   +-", *errors, *(f"{mean_mrad(x):.3f}" for x in trial)])
    first = next(iter(trials.values()))
    yield f"windows: {len(first.fit.residuals)} to train, {len(first.test.residuals)} to test"
    yield ""
    yield from _aligned(rows)
    yield ""
    yield (
        "rms in mrad over all samples (in brackets, one to beat, of a fit to that recording); "
        "beneath, the mean of the windows' own rms."
        if beat_train or beat_test
        else "rms in mrad over all samples; beneath, the mean of the windows' own rms."
    )
    yield (
        "test: parameters from the training windows, starts fitted to the test windows; "
        f"from {EARLY:g} s: starts fitted to their first {EARLY:g} s, the rest predicted."
    )
    yield from _judged({model: trial.fit for model, trial in trials.items()}, symbols)
    yield ""


def segments(recording: Recording, fits: Mapping[str, jl.FitResult]) -> Iterator[str]:
    """Lines of the table of models fitted to whole segments."""
    beat = TO_BEAT.get(recording.name, {})
    rows = list(_head(FREE, ["all", *["to beat"] * bool(beat)]))
    for model, fitted in fits.items():
        values, errors = _numbers(fitted, model, FREE)
        figure = [f"{beat[model]:g}" if model in beat else ""] * bool(beat)
        rows.append([_name(model, fitted), *values, f"{mrad(fitted):.3f}", *figure])
        blank = [""] * len(figure)
        rows.append(["   +-", *errors, f"{mean_mrad(fitted):.3f}", *blank])
    first = next(iter(recording.segments.values())).ts
    yield f"whole segments, the first of {first[-1] - first[0]:.3g} s, every one fitted:"
    yield ""
    yield from _aligned(rows)
    yield ""


def mrad(found: jl.FitResult | jl.Prediction) -> float:
    """Root mean square of the angle's residuals over all, or all predicted, samples, mrad."""
    return 1e3 * float(found.rms("q")[0])


def mean_mrad(found: jl.FitResult | jl.Prediction) -> float:
    """Mean over the experiments of each one's own rms, mrad."""
    residuals = [each["q"][:, 0] for each in found.residuals]
    if isinstance(found, jl.Prediction):
        residuals = [x[own] for x, own in zip(residuals, found.predicted, strict=True)]
    return 1e3 * float(np.mean([np.sqrt(np.mean(x**2)) for x in residuals]))


def _head(symbols: Mapping[str, tuple[str, str]], rms_of: list[str]) -> Iterator[list[str]]:
    yield ["model", *(symbol for symbol, _ in symbols.values()), *rms_of]
    yield ["", *(f"[{unit}]" for _, unit in symbols.values()), *["[mrad]"] * len(rms_of)]


def _name(model: str, fitted: jl.FitResult) -> str:
    return model if fitted.converged else f"{model} (not converged)"


def _numbers(
    fitted: jl.FitResult, model: str, symbols: Mapping[str, object]
) -> tuple[list[str], list[str]]:
    """Estimates and standard errors, to two digits of the error; blank if fixed."""
    values, errors = [], []
    for name in symbols:
        if name not in estimated(fitted, model):
            values.append("")
            errors.append("")
            continue
        error = fitted.std[name]
        digits = max(0, 1 - _magnitude(error)) if 0 < error < np.inf else 0
        values.append(f"{fitted.params[name]:.{digits}f}")
        errors.append(f"{error:.{digits}f}")
    return values, errors


def _magnitude(x: float) -> int:
    return int(np.floor(np.log10(x)))


def _aligned(rows: list[list[str]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(row[1:], widths[1:], strict=True)]
        yield "  ".join([f"{row[0]:<{widths[0]}}", *cells]).rstrip()


def _judged(
    fits: Mapping[str, jl.FitResult], symbols: Mapping[str, tuple[str, str]]
) -> Iterator[str]:
    chosen = choose(fits)
    best, richest = fits[chosen], list(fits.values())[-1]
    inflation = float(np.sqrt(samples_each(best)))
    yield (
        "+-: standard errors, if residuals are independent and equally noisy; their correlation "
        f"from sample to sample is {correlation(best):.2f} under {chosen!r}"
        + (f": true errors are about {inflation:.0f} times as large." if inflation > 1.5 else ".")
    )
    yield (
        f"chosen: {chosen!r}, by the Bayesian information criterion with "
        f"{count(richest) / samples_each(richest):.0f} of {count(richest)} residuals counted as "
        "independent."
    )
    for name in FRICTION:
        if best.params[name] < -2 * inflation * best.std[name]:
            yield (
                f"{symbols[name][0]} < 0: no such friction by itself; over the speeds recorded "
                "only the sum of the terms is one."
            )


def can_plot() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def require_figure(path: Path) -> None:
    """Check that a figure can be written, before the fits run.

    Raises:
        DataError: matplotlib is missing, or the folder, or the name ends in another way.
    """
    if not can_plot():
        raise data_error(
            "--plot", "be left out without matplotlib", "it was given", NEEDS_MATPLOTLIB
        )
    if path.suffix not in SUFFIXES or not path.parent.is_dir():
        must = f"name a {', '.join(SUFFIXES)} in a folder that exists"
        raise data_error("--plot", must, f"it was {path}", "Rename it, or make the folder.")


def figure(name: str, trials: Mapping[str, Trial], path: Path) -> None:
    """Measured and simulated angles in some test windows, with the residuals below.

    Raises:
        DataError: the file cannot be written.
    """
    chosen = choose({model: trial.fit for model, trial in trials.items()})
    test = trials[chosen].test
    figure = test.plot()
    figure.suptitle(
        f"{name}, {chosen}: test windows from the best to the worst of {len(test.residuals)}",
        fontsize=11,
    )
    try:
        figure.savefig(path)
    except OSError as error:
        must = "name a file that can be written"
        raise data_error("--plot", must, str(error), "Choose another folder.") from error
