"""Recordings of real machines, from a folder outside this project."""

import gzip
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

import jaxlag as jl

VARIABLE = "JAXLAG_DATA"


class DataError(ValueError):
    """The recordings are not in the given folder."""


def folder(given: str | None) -> Path:
    """The folder of the recordings.

    Args:
        given: the folder; None for that in JAXLAG_DATA.

    Raises:
        DataError: there is no such folder.
    """
    path = given or os.environ.get(VARIABLE)
    if not path:
        must = f"--data must name the folder of recordings, or {VARIABLE} must, but neither did"
        raise DataError(f"{must}. See the docstring of bench.fits for what it holds.")
    if not Path(path).is_dir():
        raise DataError(f"--data must name a folder, but {path} is none.")
    return Path(path)


def table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a gzipped CSV file by name; comments (#), then a line of names are at its top."""
    with gzip.open(path, "rt") as file:
        head = next(line for line in file if not line.startswith("#"))
        samples = np.loadtxt(file, delimiter=",", ndmin=2)
    return dict(zip(head.strip().split(","), samples.T, strict=True))


def pieces(columns: dict[str, np.ndarray], by: str) -> dict[int, dict[str, np.ndarray]]:
    """The samples for each number in the column `by`."""
    numbers = columns[by].astype(int)
    return {
        int(number): {name: x[numbers == number] for name, x in columns.items()}
        for number in np.unique(numbers)
    }


def windows(recordings: Iterable[jl.Experiment], seconds: float) -> list[jl.Experiment]:
    """All windows of the recordings that are at least as long as one window."""
    return [
        window
        for each in recordings
        if each.ts[-1] - each.ts[0] + np.median(np.diff(each.ts)) >= (1 - 1e-9) * seconds
        for window in each.windows(seconds)
    ]
