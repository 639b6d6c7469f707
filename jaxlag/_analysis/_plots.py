"""Figures: root loci, shapes of modes, Bode diagrams."""

from typing import Any

import numpy as np

from jaxlag._analysis._mode_table import SMALLEST, ModeNumbers, value_text
from jaxlag._core._errors import unsupported

MOST = 6
"""Largest number of shapes, and of responses, in a figure."""


def plotted_loci(values: np.ndarray) -> Any:
    """Eigenvalues of a batch (..., k) in the complex plane, one colour per point.

    Raises:
        ValueError: matplotlib is not installed.
    """
    figure = _figure(6.0, 4.5)
    points = np.arange(values.size // values.shape[-1])
    _plane(figure.add_subplot(), values, np.repeat(points, values.shape[-1]))
    return figure


def plotted_modes(modes: ModeNumbers) -> Any:
    """Eigenvalues in the complex plane, beside it one compass per shape.

    Raises:
        ValueError: matplotlib is not installed.
    """
    figure = _figure(10.0, 4.5)
    halves = figure.add_gridspec(1, 2)
    _plane(figure.add_subplot(halves[0]), modes.values, np.zeros(len(modes.values)))
    shown = modes.shown[:MOST]
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    grid = halves[1].subgridspec(rows, columns)
    drawn: dict[str, Any] = {}
    for j, i in enumerate(shown):
        ax = figure.add_subplot(grid[j // columns, j % columns], projection="polar")
        for name, x in zip(modes.shapes[i].names, modes.shapes[i].relative(), strict=True):
            if abs(x) > SMALLEST:
                colour = drawn[name].get_color() if name in drawn else f"C{len(drawn)}"
                ends = [np.angle(x)] * 2, [0.0, abs(x)]
                (line,) = ax.plot(*ends, "o-", ms=3, color=colour)
                drawn.setdefault(name, line)
        ax.set_rmax(1.05)
        ax.set_xticklabels([])
        ax.set_yticklabels([])
        ax.set_title(value_text(modes.values[i]), fontsize=8)
    figure.legend(drawn.values(), drawn.keys(), fontsize=8, loc="outside lower right", ncols=6)
    if len(shown) < len(modes.shown):
        figure.suptitle(f"shapes of the first {len(shown)} of {len(modes.shown)}", fontsize=10)
    return figure


def plotted_responses(
    w: np.ndarray, response: np.ndarray, outputs: tuple[str, ...], inputs: tuple[str, ...]
) -> Any:
    """Amplitudes and phases of responses (w, outputs, inputs) over w.

    Raises:
        ValueError: matplotlib is not installed.
    """
    figure = _figure(6.0, 5.0)
    amplitude, phase = figure.subplots(2, 1, sharex=True)
    pairs = list(np.ndindex(response.shape[1:]))
    for i, j in pairs[:MOST]:
        y = response[:, i, j]
        amplitude.loglog(w, np.abs(y), lw=1, label=f"{outputs[i]} by {inputs[j]}")
        phase.semilogx(w, np.degrees(_unwrapped(np.angle(y))), lw=1)
    amplitude.set(ylabel="amplitude ratio")
    amplitude.legend(fontsize=8)
    phase.set(xlabel="angular frequency in rad/s", ylabel="phase in degrees")
    if len(pairs) > MOST:
        figure.suptitle(f"the first {MOST} of {len(pairs)} responses", fontsize=10)
    return figure


def _plane(ax: Any, values: np.ndarray, colours: np.ndarray) -> None:
    ax.scatter(np.real(values).ravel(), np.imag(values).ravel(), 12, colours, cmap="viridis")
    ax.axvline(0.0, color="0.6", lw=0.8)
    ax.axhline(0.0, color="0.6", lw=0.8)
    ax.set(xlabel="Re eigenvalue in 1/s", ylabel="Im eigenvalue in 1/s")
    ax.locator_params(axis="x", nbins=6)


def _unwrapped(angles: np.ndarray) -> np.ndarray:
    """Without jumps of 2 pi; NaN stays where it is."""
    known = np.isfinite(angles)
    found = np.full_like(angles, np.nan)
    found[known] = np.unwrap(angles[known])
    return found


def _figure(width: float, height: float) -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise unsupported(
            "`plot`", "matplotlib is not installed", 'pip install "jaxlag[plot]"'
        ) from error
    return Figure(figsize=(width, height), dpi=120, layout="constrained")
