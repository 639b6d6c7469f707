"""The figure of the benchmark `constraints`: residuals and energy over the number of steps."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

PANELS = {
    "position": "|phi| / |A| [m; rad]",
    "velocity": "|A v + b| / |A| [m/s; rad/s]",
    "energy": "|H - H0| / T0",
}
COLORS = {"none": "tab:red", "Baumgarte": "tab:blue", "projection": "tab:green"}
LINES = {"multipliers": "-", "null_space": ":", "quasi": "--"}
FLOOR = 1e-18  # shown for 0


def save(records: Mapping[tuple[str, str, str], Any], path: Path) -> str:
    """Write the figure: one column per mechanism, curves of the running maximum.

    Args:
        records: (mechanism, formulation, stabilization) -> an object with the attributes `steps`
            and those of `PANELS`, (saves,) each. A curve ends at the first nan.
        path: the file, whose folder is created.

    Returns:
        The name of the file, or why it was not written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return "left out: matplotlib cannot be imported"
    names = list(dict.fromkeys(key[0] for key in records))
    figure = Figure(figsize=(4.5 * len(names) + 2.5, 8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(PANELS), len(names), sharex=True, sharey="row", squeeze=False)
    for (name, formulation, stabilization), record in records.items():
        column = axes[:, names.index(name)]
        for (panel, label), ax in zip(PANELS.items(), column, strict=True):
            largest = np.maximum.accumulate(np.abs(getattr(record, panel)))
            ax.loglog(
                record.steps[1:],
                np.maximum(largest, FLOOR)[1:],
                LINES[formulation],
                color=COLORS[stabilization],
                label=f"{stabilization}, {formulation}",
            )
            ax.set_ylabel(label)
            ax.grid(alpha=0.3)
            ax.label_outer()
        column[0].set_title(name)
        column[-1].set_xlabel("steps")
    figure.suptitle("Largest so far")
    shown = {
        label: line
        for ax in axes[0]
        for line, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    axes[0, -1].legend(
        shown.values(), shown, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path.name
