"""Figures: panels of curves, one below the other."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike

from systems.catalogue._entry import AbstractEntry


class PlotError(RuntimeError):
    """The figure could not be made; the message says why."""


class Panel(NamedTuple):
    """Curves over one axis.

    Attributes:
        x_label: name of the independent variable, with its unit.
        x: shape (S,).
        y_label: names of the curves, with their unit.
        curves: label -> values, shape (S,).
        mark: a point (x, y) to show, if any.
    """

    x_label: str
    x: ArrayLike
    y_label: str
    curves: Mapping[str, ArrayLike]
    mark: tuple[float, float] | None = None


def by_unit(
    names: Sequence[str], ts: ArrayLike, values: ArrayLike, units: Sequence[str]
) -> list[Panel]:
    """One panel over time for every unit, with the components of `values`, (S, n), in this unit."""
    panels = []
    for unit in dict.fromkeys(units):
        columns = [i for i, own in enumerate(units) if own == unit]
        curves = {names[i]: np.asarray(values)[:, i] for i in columns}
        panels.append(Panel("t [s]", ts, f"{', '.join(curves)} [{unit}]", curves))
    return panels


def save(entry: AbstractEntry, panels: Sequence[Panel], path: Path) -> None:
    """Write the figure to `path`, in the format of its suffix.

    Raises:
        PlotError: matplotlib is missing, or the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        message = '--plot needs matplotlib, which is missing: pip install -e ".[plot]".'
        raise PlotError(message) from error

    figure = Figure(figsize=(8, 2.4 * len(panels) + 0.5), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{entry.name}\n{entry.book}", fontsize=10)
    shared = len({panel.x_label for panel in panels}) == 1
    axes = figure.subplots(len(panels), 1, sharex=shared, squeeze=False)[:, 0]
    for panel, ax in zip(panels, axes, strict=True):
        for label, values in panel.curves.items():
            ax.plot(np.asarray(panel.x), np.asarray(values), label=label)
        if panel.mark is not None:
            ax.plot(*panel.mark, "o", color="black")
            ax.axhline(panel.mark[1], color="black", linewidth=0.8)
        ax.set_ylabel(panel.y_label)
        if not shared or ax is axes[-1]:
            ax.set_xlabel(panel.x_label)
        ax.grid(alpha=0.3)
        ax.margins(x=0)
        if len(panel.curves) > 1:
            ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    figure.align_ylabels(axes)
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise PlotError(f"--plot must name a file that can be written, but {error}.") from error
