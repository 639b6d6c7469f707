"""What the fits of a pendulum say: tables and a figure."""

from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from systems._pendulum_data import Recording, bad
from systems._pendulum_fit import EARLY, MRAD, NAMES, Fit, rms
from systems._pendulum_trials import Trial, choose, mean_rms

# Symbol and unit of each parameter where the torque is known, and in a free swing.
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
# Figures to beat, mrad rms: quick fits by multiple shooting, made when these recordings were
# chosen; in whole segments of the first, in windows of 1 s of the other two.
TO_BEAT = {
    "single.csv.gz": {"viscous": 7.8, "+ Coulomb": 6.7, "+ quadratic": 2.05},
    "ddp.csv.gz": {"+ Coulomb": 3.3},
    "ilqr.csv.gz": {"+ Coulomb": 26.0},
}
NEEDS_MATPLOTLIB = 'matplotlib is missing: pip install -e ".[plot]"'
COLOURS = ("tab:orange", "tab:green", "tab:blue")
SUFFIXES = (".png", ".pdf", ".svg")
SHOWN = 4  # windows in the figure


def describe(recording: Recording) -> str:
    """A recording in one line."""
    segments = recording.segments
    rows = sum(len(segment.t) for segment in segments)
    reach = max(float(np.max(np.abs(segment.q))) for segment in segments)
    return (
        f"{recording.name}: {'driven' if recording.driven else 'free swing'}, "
        f"{len(segments)} segment{'s' * (len(segments) > 1)}, {rows} samples at "
        f"{1 / recording.spacing:.0f} Hz, up to {reach:.2f} rad from hanging"
    )


def trials(
    recording: Recording,
    other: Recording | None,
    trials: Mapping[str, Trial],
    truth: Mapping[str, float] | None = None,
) -> Iterator[str]:
    """Lines of the table of models fitted to windows, and what it means."""
    symbols = DRIVEN if recording.driven else FREE
    beat_train = TO_BEAT.get(recording.name, {}) if other else {}
    beat_test = TO_BEAT.get(other.name, {}) if other else {}
    heads = ["train", "test", f"from {EARLY:g} s"]
    rows = list(_head(symbols, heads))
    if truth:
        rows.append(["truth", *(f"{truth.get(name, 0.0):g}" for name in symbols), *[""] * 3])
    for model, trial in trials.items():
        values, errors = _numbers(trial.fit, symbols)
        against = (beat_train.get(model), beat_test.get(model), None)
        pooled = [
            f"{rms(x):.3f}" + (f" ({figure:g})" if figure else "")
            for x, figure in zip(trial[1:4], against, strict=True)
        ]
        rows.append([_name(model, trial.fit), *values, *pooled])
        rows.append(["   +-", *errors, *(f"{mean_rms(x):.3f}" for x in trial[1:4])])
    count = [len(x) for x in next(iter(trials.values()))[1:3]]
    yield f"windows: {count[0]} to train, {count[1]} to test"
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
        f"from {EARLY:g} s: starts fitted to their first {EARLY:g} s."
    )
    yield from _judged({model: trial.fit for model, trial in trials.items()}, symbols)
    yield ""


def segments(recording: Recording, fits: Mapping[str, Fit]) -> Iterator[str]:
    """Lines of the table of models fitted to whole segments."""
    beat = TO_BEAT.get(recording.name, {})
    rows = list(_head(FREE, ["all", *["to beat"] * bool(beat)]))
    for model, fitted in fits.items():
        values, errors = _numbers(fitted, FREE)
        figure = [f"{beat[model]:g}"] if model in beat else []
        rows.append([_name(model, fitted), *values, f"{rms(fitted.residuals):.3f}", *figure])
        blank = [""] * len(figure)
        rows.append(["   +-", *errors, f"{mean_rms(fitted.residuals):.3f}", *blank])
    length = len(recording.segments[0].t) * recording.spacing
    yield f"whole segments of {length:.3g} s, every one fitted:"
    yield ""
    yield from _aligned(rows)
    yield ""


def _head(symbols: Mapping[str, tuple[str, str]], rms_of: list[str]) -> Iterator[list[str]]:
    yield ["model", *(symbol for symbol, _ in symbols.values()), *rms_of]
    yield ["", *(f"[{unit}]" for _, unit in symbols.values()), *["[mrad]"] * len(rms_of)]


def _name(model: str, fitted: Fit) -> str:
    return model if fitted.converged else f"{model} (not converged)"


def _numbers(fitted: Fit, symbols: Mapping[str, object]) -> tuple[list[str], list[str]]:
    """Estimates and standard errors, to two figures of the error; blank where held."""
    values, errors = [], []
    for name in symbols:
        error = fitted.errors.get(name)
        digits = 0 if not error or not np.isfinite(error) else max(0, 1 - _magnitude(error))
        values.append("" if error is None else f"{fitted.values[name]:.{digits}f}")
        errors.append("" if error is None else f"{error:.{digits}f}")
    return values, errors


def _magnitude(x: float) -> int:
    return int(np.floor(np.log10(x)))


def _aligned(rows: list[list[str]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(row[1:], widths[1:], strict=True)]
        yield "  ".join([f"{row[0]:<{widths[0]}}", *cells]).rstrip()


def _judged(fits: Mapping[str, Fit], symbols: Mapping[str, tuple[str, str]]) -> Iterator[str]:
    chosen = choose(fits)
    best, richest = fits[chosen], list(fits.values())[-1]
    inflation = float(np.sqrt(best.samples_each))
    count = np.count_nonzero(richest.used)
    yield (
        "+-: standard errors, if residuals are independent and equally noisy; their correlation "
        f"from sample to sample is {best.correlation:.2f} under {chosen!r}"
        + (f": true errors are about {inflation:.0f} times as large." if inflation > 1.5 else ".")
    )
    yield (
        f"chosen: {chosen!r}, by the Bayesian information criterion with "
        f"{count / richest.samples_each:.0f} of {count} residuals counted as independent."
    )
    for name in NAMES:
        if name in "cfk" and best.values[name] < -2 * inflation * best.errors.get(name, np.inf):
            yield (
                f"{symbols[name][0]} < 0: no such friction by itself; over the speeds recorded "
                "only the sum of the terms is one."
            )


def can_plot() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def require_figure(path: Path) -> None:
    """Complain before the work begins.

    Raises:
        DataError: matplotlib is missing, or the folder, or the name ends in another way.
    """
    if not can_plot():
        raise bad("--plot", "be left out without matplotlib", "it was given", NEEDS_MATPLOTLIB)
    if path.suffix not in SUFFIXES or not path.parent.is_dir():
        must = f"name a {', '.join(SUFFIXES)} in a folder that exists"
        raise bad("--plot", must, f"it was {path}", "Rename it, or make the folder.")


def figure(name: str, trials: Mapping[str, Trial], path: Path) -> None:
    """Measured against simulated angles in some test windows, residuals of all models beneath.

    Raises:
        DataError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    chosen = choose({model: trial.fit for model, trial in trials.items()})
    windows, residuals = trials[chosen].tested, trials[chosen].test
    best_first = np.argsort([rms(row) for row in residuals])
    shown = best_first[np.unique(np.linspace(0, len(best_first) - 1, SHOWN).round().astype(int))]
    colours = dict(zip(trials, COLOURS, strict=True))
    figure = Figure(figsize=(2.9 * len(shown) + 0.8, 5.4), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(
        f"{name}: test windows from the best to the worst of {len(residuals)}, starts fitted",
        fontsize=11,
    )
    axes = figure.subplots(2, len(shown), sharex=True, squeeze=False, height_ratios=[3, 2])
    for (above, below), i in zip(axes.T, shown, strict=True):
        t, q = windows.t[i], windows.q[i]
        sparse = slice(None, None, max(1, len(t) // 40))
        simulated = q + MRAD * residuals[i]
        above.plot(t, simulated, color=colours[chosen], label=f"simulated, {chosen}")
        above.plot(t[sparse], q[sparse], "k.", markersize=3, label="measured")
        above.set_title(f"window {i + 1}: {rms(residuals[i]):.2f} mrad rms", fontsize=9)
        for model, trial in trials.items():
            below.plot(
                t,
                trial.test[i],
                color=colours[model],
                linewidth=1,
                label=f"{model}, {rms(trial.test):.2f} mrad rms over all",
            )
        below.sharey(axes[1, 0])
        below.axhline(0.0, color="black", linewidth=0.5)
        below.set_xlabel("t [s]")
        for ax in (above, below):
            ax.grid(alpha=0.3)
            ax.margins(x=0)
    axes[0, 0].set_ylabel("q [rad]")
    axes[1, 0].set_ylabel("residual [mrad]")
    figure.align_ylabels(axes[:, 0])
    labelled = [ax.get_legend_handles_labels() for ax in axes[:, 0]]
    handles, labels = ([*above, *below] for above, below in zip(*labelled, strict=True))
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=8)
    try:
        figure.savefig(path)
    except OSError as error:
        must = "name a file that can be written"
        raise bad("--plot", must, str(error), "Choose another folder.") from error
