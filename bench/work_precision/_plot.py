"""The diagrams of `work-precision`: time over achieved error, one for each system.

Every jaxlag solver has its own line. It is thick if this solver is jaxlag's fastest at some error.
For diffrax and libraries with several methods, the best method at each error is drawn.
"""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from bench.work_precision._ranking import is_ours
from bench.work_precision._sweep import time_at

ERRORS = 10.0 ** -np.arange(1.0, 14.01, 0.25)
COLORS = {
    "jaxlag": "tab:red",
    "heyoka": "black",
    "numba": "tab:green",
    "diffrax by hand": "tab:blue",
    "diffrax naive": "tab:cyan",
    "SUNDIALS": "tab:purple",
    "CasADi": "tab:brown",
    "scipy": "tab:orange",
    "MuJoCo": "tab:gray",
}
MARKS = "os^vD<>pPXh*d8H"
STYLES = {", no setting": "--", ", jax ": ":"}
Curve = tuple[np.ndarray, np.ndarray]  # errors, us


def name_of(system: str) -> str:
    """The file name of a system's diagram."""
    parts = "".join(x if x.isalnum() or x == "." else " " for x in system).split()
    return f"work-precision-{'-'.join(parts)}.png".lower()


def group_of(line: str) -> str:
    """The group in which a line is drawn: jaxlag's methods separately, the others by library."""
    library = line.split()[0].rstrip(",")
    ending = next((line[line.index(label) :] for label in STYLES if label in line), "")
    if library == "jaxlag":
        return line
    if library == "diffrax":
        return f"diffrax {'naive' if ', naive' in line else 'by hand'}{ending}"
    return library


def curves(rows: Sequence[dict[str, Any]]) -> dict[str, Curve]:
    """The least time at each error by group, for the errors that the group reaches."""
    lines: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in rows:
        lines.setdefault(group_of(row["line"]), {}).setdefault(row["line"], []).append(row)
    found = {}
    for group, members in lines.items():
        pairs = []
        for error in ERRORS:
            # Only within the line: errors above that of its loosest point are not drawn.
            times = [
                time_at(points, error, "min_us")
                for points in members.values()
                if points[0]["error"] > error
            ]
            pairs.append(min((us for us in times if us is not None), default=np.nan))
        us = np.array(pairs)
        reached = np.isfinite(us)
        if np.any(reached):
            found[group] = ERRORS[reached], us[reached]
    return found


def leaders(found: dict[str, Curve]) -> set[str]:
    """The lines of jaxlag that are its fastest at some error."""
    ours = {name: curve for name, curve in found.items() if is_ours(name)}
    best = set()
    for error in ERRORS:
        times = {
            name: us[errors == error][0] for name, (errors, us) in ours.items() if error in errors
        }
        if times:
            best.add(min(times, key=times.__getitem__))
    return best


def save(system: str, rows: Sequence[dict[str, Any]], folder: Path) -> str:
    """Write the diagram of one system; return its name, or why it was not written."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from PIL import Image
    except ImportError as error:
        return f"left out: {error}"
    figure = Figure(figsize=(10, 5.8), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    found = curves(rows)
    first, marks = leaders(found), iter(MARKS * 3)
    for name in sorted(found, key=lambda name: _rank(name, first)):
        errors, us = found[name]
        color = next(c for label, c in COLORS.items() if name.startswith(label))
        style = next((style for label, style in STYLES.items() if label in name), "-")
        thick = name in first or name == "heyoka"
        ours = name.startswith("jaxlag")
        ax.loglog(
            errors,
            us,
            style,
            color=color,
            marker=next(marks) if ours else None,
            markevery=4,
            markersize=5 if thick else 4,
            linewidth=2.2 if thick else 1.2 if not ours else 0.7,
            alpha=1.0 if thick or not ours else 0.6,
            label=name,
            zorder=3 if thick else 2,
        )
    ax.set_xlim(10.0**-1, 10.0**-14)
    ax.set_xlabel("achieved error: largest |q - exact| / (1 + |exact|) at the end")
    ax.set_ylabel("time of one solve [us], least of all runs")
    ax.set_title(system)
    ax.grid(alpha=0.3)
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8)
    path = folder / name_of(system)
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = BytesIO()
    figure.savefig(picture, format="png")
    Image.open(picture).convert("RGB").quantize(255).save(path, optimize=True)
    return path.name


def _rank(name: str, first: set[str]) -> tuple[int, bool, str]:
    library = next(i for i, label in enumerate(COLORS) if name.startswith(label))
    return library, name not in first, name
