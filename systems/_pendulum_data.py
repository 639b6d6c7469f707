"""Recordings of a swinging pendulum: read from a file, split, cut in windows.

Angles are in rad from the hanging position, positive counterclockwise, not wrapped. A recording
is one or more segments sampled evenly, each with a number of its own; where the shaft is driven,
the motor's torque (N m) is recorded with the angle.
"""

import gzip
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

# Columns of an angle, and the angle at which the pendulum hangs in each (rad).
ANGLES = {"q": 0.0, "theta1": np.pi}
# Columns that are known but not used: velocities there are filtered, the angle is not.
UNUSED = ("v", "omega1")
LONGEST_GAP = 1.5  # between samples, over the median spacing


class DataError(ValueError):
    """A recording that cannot be used, saying which argument, what it must be and what it was."""


class Segment(NamedTuple):
    """One piece of evenly sampled motion.

    Attributes:
        number: which piece of the recording this is.
        t: times (s,), s, strictly increasing.
        q: measured angles (s,), rad, 0 hanging.
        tau: measured torques on the shaft (s,), N m; None for a free swing.
    """

    number: int
    t: np.ndarray
    q: np.ndarray
    tau: np.ndarray | None


@dataclass(frozen=True)
class Recording:
    """Segments of one measurement, in the order of time."""

    name: str
    segments: tuple[Segment, ...]

    @property
    def driven(self) -> bool:
        """Whether a torque was recorded."""
        return self.segments[0].tau is not None

    @property
    def spacing(self) -> float:
        """Median time between samples, s."""
        return float(np.median(np.diff(self.segments[0].t)))

    def only(self, keep: Callable[[int], bool]) -> "Recording":
        """The recording with those segments whose number passes `keep`."""
        return replace(self, segments=tuple(s for s in self.segments if keep(s.number)))


class Windows(NamedTuple):
    """Equally long pieces of motion, w windows of s samples; a pytree.

    Attributes:
        t: times since each window's start (w, s), s.
        q: measured angles (w, s), rad, 0 hanging.
        tau: measured torques (w, s), N m; None for a free swing.
    """

    t: Float[Array | np.ndarray, "*w s"]
    q: Float[Array | np.ndarray, "*w s"]
    tau: Float[Array | np.ndarray, "*w s"] | None

    def every(self, stride: int) -> "Windows":
        """Every `stride`-th sample."""
        return Windows(*(None if x is None else x[..., ::stride] for x in self))

    def first(self, seconds: float) -> "Windows":
        """The samples up to `seconds` after each window's start, at least 5 of them."""
        count = max(5, round(seconds / float(self.t[0, 1])))
        return Windows(*(None if x is None else x[..., :count] for x in self))


def bad(argument: str, must: str, was: str, fix: str) -> DataError:
    """`<argument> must <must>, but <was>. <fix>`."""
    return DataError(f"{argument} must {must}, but {was}. {fix}")


def cut(recording: Recording, seconds: float | None) -> Windows:
    """Windows of `seconds`, side by side from each segment's start; None: whole segments.

    A remainder shorter than a window is left out; segments taken whole are cut to the shortest.

    Raises:
        DataError: a window has fewer than 10 samples, there is no whole window, or nothing moves.
    """
    sizes = [len(segment.t) for segment in recording.segments]
    size = min(sizes) if seconds is None else round(seconds / recording.spacing)
    if size < 10:
        raise bad("--window", "hold 10 samples or more", f"it holds {size}", "Make it longer.")
    if max(sizes) < size:
        raise bad(
            recording.name,
            f"last one window of {size * recording.spacing:.3g} s or more",
            f"its longest segment lasts {max(sizes) * recording.spacing:.3g} s",
            "Record longer, or make --window shorter.",
        )
    pieces = [piece for segment in recording.segments for piece in _pieces(segment, size)]
    # To the nanosecond, so that multiples of the spacing are recognised as such.
    t = np.stack([np.round(piece.t - piece.t[0], 9) for piece in pieces])
    q = np.stack([piece.q for piece in pieces])
    if np.ptp(q) == 0:
        raise bad(recording.name, "move", f"its angle was always {q[0, 0]}", "Let it swing.")
    tau = np.stack([p.tau for p in pieces if p.tau is not None]) if recording.driven else None
    return Windows(t, q, tau)


def split(recording: Recording, seconds: float) -> tuple[Recording, Recording]:
    """(train, test): a third of the segments is test, those whose number is divisible by 3.

    A recording in one segment is first cut into segments of `seconds`.

    Raises:
        DataError: one of the two would be empty.
    """
    if len(recording.segments) == 1:
        size = max(1, round(seconds / recording.spacing))
        pieces = tuple(_pieces(recording.segments[0], size))
        recording = replace(recording, segments=pieces)
    train = recording.only(lambda number: number % 3 != 0)
    test = recording.only(lambda number: number % 3 == 0)
    if not train.segments or not test.segments:
        raise bad(
            recording.name,
            "have windows to train on and windows to test on",
            f"it has {len(recording.segments)} in all",
            "Record longer, make --window shorter, or name another recording by --test.",
        )
    return train, test


def _pieces(segment: Segment, size: int) -> Iterator[Segment]:
    """Pieces of `size` samples, side by side and numbered from 0."""
    for i in range(0, len(segment.t) - size + 1, size):
        t, q, tau = (None if x is None else x[i : i + size] for x in segment[1:])
        yield Segment(i // size, t, q, tau)


def read(path: Path) -> Recording:
    """A recording from a CSV file, gzipped or not.

    Lines that start with # are skipped; the next line names the columns: `t` (s), the angle as
    `q` (rad, 0 hanging) or `theta1` (rad, 0 upright), and optionally `seg` (integer segment
    numbers) and `tau_meas` (N m). Columns `v` and `omega1` are passed over.

    Raises:
        DataError: no such file, or its content is not such a table.
    """
    names, rows = _table(path)
    angle = [name for name in names if name in ANGLES]
    unknown = set(names) - {"t", "seg", "tau_meas", *ANGLES, *UNUSED}
    if len(angle) != 1 or "t" not in names or unknown or len(set(names)) < len(names):
        raise bad(
            f"the header of {path.name}",
            "name t, one angle (q, 0 hanging, or theta1, 0 upright) and at most "
            "seg, tau_meas, v, omega1",
            f"it names {', '.join(names)}",
            "Rename or drop columns.",
        )
    column = dict(zip(names, rows.T, strict=True))
    seg = column.get("seg", np.zeros(len(rows)))
    segments = tuple(
        Segment(
            int(number),
            column["t"][seg == number],
            column[angle[0]][seg == number] - ANGLES[angle[0]],
            column["tau_meas"][seg == number] if "tau_meas" in column else None,
        )
        for number in np.unique(seg)
    )
    for segment in segments:
        _check_times(path.name, segment)
    return Recording(path.name, segments)


def _table(path: Path) -> tuple[list[str], np.ndarray]:
    try:
        with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as file:
            lines = [line for line in file if line.strip() and not line.startswith("#")]
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise bad(
            "the recording",
            "be a CSV file that can be read, gzipped where its name ends in .gz",
            f"{path}: {error}",
            "Check the path.",
        ) from error
    if len(lines) < 3:
        raise bad(
            path.name, "have a header and rows", f"it has {len(lines)} lines", "Check the file."
        )
    try:
        rows = np.loadtxt(lines[1:], delimiter=",", ndmin=2)
    except ValueError as error:
        raise bad(path.name, "be a table of numbers", str(error), "Mend that row.") from error
    names = [name.strip() for name in lines[0].split(",")]
    if rows.shape[1] != len(names):
        raise bad(
            path.name,
            f"have {len(names)} columns as its header says",
            f"its rows have {rows.shape[1]}",
            "Mend the header.",
        )
    if not np.all(np.isfinite(rows)):
        row, column = np.argwhere(~np.isfinite(rows))[0]
        raise bad(
            path.name,
            "hold finite numbers",
            f"column {names[column]} of row {row + 1} was {rows[row, column]}",
            "Drop such rows, and number the pieces on either side in a column seg.",
        )
    return names, rows


def _check_times(name: str, segment: Segment) -> None:
    steps = np.diff(segment.t)
    if len(steps) == 0:
        raise bad(
            f"segment {segment.number} of {name}",
            "have 2 rows or more",
            f"it has {len(segment.t)}",
            "Drop it.",
        )
    if np.min(steps) <= 0:
        i = int(np.argmax(steps <= 0))
        raise bad(
            f"t of {name}",
            "increase strictly within a segment",
            f"{segment.t[i]} s is followed by {segment.t[i + 1]} s",
            "Sort the rows and drop repeated ones.",
        )
    if np.max(steps) > LONGEST_GAP * np.median(steps):
        i = int(np.argmax(steps))
        raise bad(
            f"t of {name}",
            f"be sampled evenly, steps at most {LONGEST_GAP} times their median",
            f"{segment.t[i]} s is followed by {segment.t[i + 1]} s",
            "Number the pieces on either side of a gap in a column seg.",
        )

