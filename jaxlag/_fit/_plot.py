"""Figures of measured against fitted or predicted motions."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxlag._core._errors import unsupported
from jaxlag._fit._experiment import Experiment
from jaxlag._fit._residuals import channels_of, rms_of

MOST = 4
"""Largest number of experiments in a figure."""
DOTS = 60
"""Number of measurements shown for each."""


def plotted(
    experiments: Sequence[Experiment],
    residuals: Sequence[Mapping[str, np.ndarray]],
    predicted: Sequence[np.ndarray] | None = None,
) -> Any:
    """Measurements as dots, motions as lines, residuals beneath; one column per experiment.

    Args:
        experiments: the measurements.
        residuals: for each, channel -> motion minus measurement, (s, k).
        predicted: for each, (s,), samples beyond those of the fit of its start; a line marks
            where they begin.

    Raises:
        ValueError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise unsupported(
            "`plot`", "matplotlib is not installed", 'pip install "jaxlag[plot]"'
        ) from error
    shown = np.arange(len(residuals))
    if len(shown) > MOST:
        best_first = np.argsort([_size(each) for each in residuals], kind="stable")
        shown = best_first[np.linspace(0, len(shown) - 1, MOST).round().astype(int)]
    channels = channels_of(residuals)
    figure = Figure(
        figsize=(1.2 + 3.2 * len(shown), 0.6 + 3.0 * len(channels)), dpi=120, layout="constrained"
    )
    axes = figure.subplots(
        2 * len(channels),
        len(shown),
        squeeze=False,
        sharex="col",
        height_ratios=[3, 2] * len(channels),
    )
    if len(shown) < len(residuals):
        figure.suptitle(f"from the best to the worst of {len(residuals)} experiments", fontsize=11)
    for column, i in zip(axes.T, map(int, shown), strict=True):
        each = experiments[i]
        column[0].set_title(each.name, fontsize=9)
        for j, name in enumerate(channels):
            if name in residuals[i]:
                _channel(column[2 * j], column[2 * j + 1], each, name, residuals[i][name])
        column[-1].set_xlabel("t [s]")
        for ax in column:
            if predicted is not None and not np.all(predicted[i]):
                ax.axvline(each.ts[np.argmax(predicted[i])], color="0.6", linestyle=":")
            ax.grid(alpha=0.3)
            ax.margins(x=0)
    for j, name in enumerate(channels):
        axes[2 * j, 0].set_ylabel(name)
        axes[2 * j + 1, 0].set_ylabel("motion -\nmeasured")
    figure.align_ylabels(axes[:, 0])
    return figure


def _channel(
    above: Any, below: Any, experiment: Experiment, name: str, residuals: np.ndarray
) -> None:
    """One channel of one experiment: (above) dots and lines, (below) residuals."""
    ts, measured = experiment.ts, experiment.channels[name]
    sparse = slice(None, None, max(1, len(ts) // DOTS))
    for k in range(measured.shape[1]):
        color = f"C{k}"
        above.plot(ts, measured[:, k] + residuals[:, k], color=color, linewidth=1)
        above.plot(ts[sparse], measured[sparse, k], "k.", markersize=3)
        below.plot(ts, residuals[:, k], color=color, linewidth=0.8)
    below.axhline(0.0, color="black", linewidth=0.5)


def _size(residuals: Mapping[str, np.ndarray]) -> float:
    """Sort key of experiments: the worst channel's root mean square; NaN comes last."""
    return float(np.max([np.max(rms_of([residuals], name)) for name in residuals]))
