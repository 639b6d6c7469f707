"""Tables of modes."""

from typing import NamedTuple

import numpy as np

SHOWN = 4
"""Coordinates of a shape that are written."""
SMALLEST = 5e-3
"""Amplitudes below this part of the largest are not written."""


class Shape(NamedTuple):
    """Amplitudes of one mode: of the coordinates, or of the states if no coordinate moves.

    Attributes:
        names: of what moves.
        amplitudes: complex; NaN for coordinates that drift.
        weights: of these: roots of the inertias, or 1.
    """

    names: tuple[str, ...]
    amplitudes: np.ndarray
    weights: np.ndarray

    def relative(self) -> np.ndarray:
        """Weighted amplitudes over the largest of them; 0 in place of NaN."""
        sizes = np.nan_to_num(self.amplitudes * self.weights)
        largest = np.max(np.abs(sizes), initial=0.0)
        return sizes / largest if largest > 0 else sizes

    def __str__(self) -> str:
        """`theta 1, phi 0.41 at 30 deg`, of the largest amplitudes."""
        sizes = np.abs(self.relative())
        some = np.flatnonzero(sizes > SMALLEST)
        largest = sorted(some[np.argsort(-sizes[some], kind="stable")][:SHOWN])
        found = [f"{self.names[i]} {_polar(complex(self.amplitudes[i]))}" for i in largest]
        left = len(some) - len(largest)
        return ", ".join(found) + (f", and {left} more" if left else "")


class ModeNumbers(NamedTuple):
    """What tables and figures show of the modes of one point.

    Attributes:
        values: eigenvalues; real and imaginary parts below their errors are 0.
        damping: damping ratios.
        simple: whether the eigenvalues are simple.
        shapes: of the modes.
        drifting: names of the coordinates of each that drift.
        verdict: on stability.
    """

    values: np.ndarray
    damping: np.ndarray
    simple: np.ndarray
    shapes: list[Shape]
    drifting: list[list[str]]
    verdict: str

    @property
    def shown(self) -> list[int]:
        """Indices of real modes and of the first of conjugate ones."""
        return [i for i, x in enumerate(self.values) if not np.imag(x) < 0]


def shape_of(
    coordinates: tuple[str, ...],
    inertias: np.ndarray,
    amplitudes: np.ndarray,
    states: tuple[str, ...],
    vector: np.ndarray,
) -> Shape:
    """The shape of one mode.

    Args:
        coordinates: names.
        inertias: their diagonal entries of M.
        amplitudes: of them.
        states: names.
        vector: amplitudes of the states.
    """
    weights = np.sqrt(np.maximum(inertias, 0.0))
    if np.any(np.nan_to_num(np.abs(amplitudes)) * weights > 0):
        return Shape(coordinates, amplitudes, weights)
    return Shape(states, vector, np.ones(len(states)))


def without_noise(values: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Real and imaginary parts below the errors as 0."""
    real, imaginary = np.real(values), np.imag(values)
    real = np.where(np.abs(real) <= errors, 0.0, real)
    return real + 1j * np.where(np.abs(imaginary) <= errors, 0.0, imaginary)


def mode_table(modes: ModeNumbers) -> str:
    """One line per real mode and per pair of conjugate ones."""
    heads = "mode", "eigenvalue", "rad/s", "Hz", "damping ratio", "shape"
    lines: list[tuple[str, ...]] = [heads]
    for i in modes.shown:
        x = modes.values[i]
        real, imaginary = float(np.real(x)), float(np.imag(x))
        label, middle = f"{i + 1}", ("", "", "")
        if imaginary > 0:
            label = f"{i + 1}, {i + 2}"
            ratio = f"{modes.damping[i]:.4g}" if real else "0"
            middle = f"{imaginary:.4g}", f"{imaginary / (2 * np.pi):.4g}", ratio
        shape = "" if np.isnan(real) else str(modes.shapes[i])
        shape += "".join(f", {name} drifts" for name in modes.drifting[i][:SHOWN])
        shape += ", and more drift" * (len(modes.drifting[i]) > SHOWN)
        repeated = not (modes.simple[i] or np.isnan(real))
        lines.append((label, value_text(x), *middle, f"{shape} (repeated)" if repeated else shape))
    widths = [max(len(line[j]) for line in lines) for j in range(len(heads))]
    rows = ["  ".join(x.ljust(w) for x, w in zip(line, widths, strict=True)) for line in lines]
    return "\n".join(row.rstrip() for row in (*rows, modes.verdict))


def value_text(x: complex) -> str:
    """`-1 ± 2i`; of a pair once."""
    real = f"{np.real(x):.4g}"
    return f"{real} ± {np.imag(x):.4g}i" if np.imag(x) > 0 else real


def _polar(x: complex) -> str:
    """An amplitude, with its phase in degrees unless it is 0 or 180."""
    degrees = round(float(np.degrees(np.angle(x))))
    if degrees in (0, 180, -180):
        return f"{abs(x) if degrees == 0 else -abs(x):.3g}"
    return f"{abs(x):.3g} at {degrees} deg"
