"""Figures of a motion: coordinates by unit, and energy, against time."""

from pathlib import Path

import numpy as np

import jaxlag as jl
from systems._entry import Entry


class PlotError(RuntimeError):
    """A figure that could not be made, saying why."""


def save(entry: Entry, motion: jl.Solution, path: Path) -> None:
    """Write the figure of a motion to `path`, in the format of its suffix.

    Raises:
        PlotError: matplotlib is missing, or the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        message = '--plot needs matplotlib, which is missing: pip install -e ".[plot]".'
        raise PlotError(message) from error

    units = tuple(dict.fromkeys(entry.coordinate_units))
    panels = len(units) + 1
    figure = Figure(figsize=(8, 2.4 * panels + 0.5), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{entry.name}\n{entry.book}", fontsize=10)
    axes = figure.subplots(panels, 1, sharex=True)

    ts = np.asarray(motion.ts)
    for unit, ax in zip(units, axes, strict=False):
        names = [
            name
            for name, own in zip(entry.coordinates, entry.coordinate_units, strict=True)
            if own == unit
        ]
        for name in names:
            ax.plot(ts, motion[name], label=name)
        ax.set_ylabel(f"{', '.join(names)} [{unit}]")

    T, V = np.asarray(motion.kinetic), np.asarray(motion.potential)
    energy = axes[-1]
    energy.plot(ts, T, label="T kinetic")
    energy.plot(ts, V, label="V potential")
    energy.plot(ts, T + V, color="black", label="E = T + V")
    energy.set_ylabel("energy [J]")
    energy.set_xlabel("t [s]")
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.margins(x=0)
        if len(ax.lines) > 1:
            ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    figure.align_ylabels(axes)
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise PlotError(f"--plot must name a file that can be written, but {error}.") from error
