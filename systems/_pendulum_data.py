"""Recordings of a swinging pendulum: read from a file, cut in windows.

Angles are in rad from the hanging position, positive counterclockwise, not wrapped. A recording
is one or more segments sampled evenly, each with a number of its own; where the shaft is driven,
the motor's torque (N m) is recorded with the angle.
"""

import gzip
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

# Columns of an angle, and what each shows where the pendulum hangs (rad).
ANGLES = {"q": 0.0, "theta1": np.pi}
# Columns that may be there but are not used: recorded velocities are filtered, angles are not.
UNUSED = ("v", "omega1")
LONGEST_GAP = 1.5  # between samples, over their median spacing
FEWEST_SAMPLES = 10  # in a window
SHORTEST = 0.2  # s, of a window


class DataError(ValueError):
    """A recording that cannot be used: which argument, what it must be, what it was."""


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

    def part(self, rows: np.ndarray | slice) -> "Segment":
        """Some of its rows."""
        tau = None if self.tau is None else self.tau[rows]
        return Segment(self.number, self.t[rows], self.q[rows], tau)


class Recording(NamedTuple):
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


class Windows(NamedTuple):
    """Equally long pieces of motion, w windows of s samples, or one; a pytree, traced by JAX.

    Attributes:
        t: times since each window's start (w, s), s.
        q: measured angles (w, s), rad, 0 hanging.
        tau: measured torques (w, s), N m; None for a free swing.
    """

    t: Float[np.ndarray, "*w s"]
    q: Float[np.ndarray, "*w s"]
    tau: Float[np.ndarray, "*w s"] | None

    def every(self, stride: int) -> "Windows":
        """Every `stride`-th sample."""
        tau = None if self.tau is None else self.tau[..., ::stride]
        return Windows(self.t[..., ::stride], self.q[..., ::stride], tau)


def bad(argument: str, must: str, was: str, fix: str) -> DataError:
    """`<argument> must <must>, but <was>. <fix>`."""
    return DataError(f"{argument} must {must}, but {was}. {fix}")


def cut(
    recording: Recording, seconds: float | None = None
) -> tuple[Windows, Int[np.ndarray, " w"]]:
    """Windows of `seconds`, side by side from each segment's start, and their segments' numbers.

    A remainder shorter than a window is left out. Without `seconds` every segment is one window,
    cut to the length of the shortest.

    Raises:
        DataError: a window would be too short, no segment is as long as one, or angle or torque
            never change.
    """
    sizes = [len(segment.t) for segment in recording.segments]
    size = min(sizes)
    if seconds is not None:
        size = round(seconds / recording.spacing) if np.isfinite(seconds) else 0
    length, least = size * recording.spacing, max(SHORTEST, FEWEST_SAMPLES * recording.spacing)
    if length < 0.999 * least:
        raise bad(
            f"every segment of {recording.name}" if seconds is None else "--window",
            f"last {least:.3g} s or more",
            f"one lasts {length:.3g} s" if seconds is None else f"it was {seconds:g} s",
            "Drop short segments." if seconds is None else "Make it longer.",
        )
    if max(sizes) < size:
        raise bad(
            recording.name,
            f"last one window of {length:.3g} s or more",
            f"its longest segment lasts {max(sizes) * recording.spacing:.3g} s",
            "Record longer, or make --window shorter.",
        )
    pieces = [
        segment.part(slice(i, i + size))
        for segment in recording.segments
        for i in range(0, len(segment.t) - size + 1, size)
    ]
    # To the nanosecond, so that multiples of the spacing are recognised as such.
    t = np.stack([np.round(piece.t - piece.t[0], 9) for piece in pieces])
    q = np.stack([piece.q for piece in pieces])
    tau = np.stack([p.tau for p in pieces if p.tau is not None]) if recording.driven else None
    if np.ptp(q) == 0:
        raise bad(recording.name, "move", f"its angle was always {q[0, 0]:g}", "Let it swing.")
    if tau is not None and np.ptp(tau) == 0:
        raise bad(
            f"tau_meas of {recording.name}",
            "vary",
            f"it was always {tau[0, 0]:g}",
            "Drop the column if the pendulum swings freely.",
        )
    return Windows(t, q, tau), np.array([piece.number for piece in pieces])


def held_out(recording: Recording, numbers: Int[np.ndarray, " w"]) -> Bool[np.ndarray, " w"]:
    """Which windows are kept for the test: a third.

    Those of the segments whose number is divisible by 3; every third window where there is one
    segment only.

    Raises:
        DataError: that leaves none to train on, or none to test on.
    """
    test = numbers % 3 == 0 if len(recording.segments) > 1 else np.arange(len(numbers)) % 3 == 0
    if test.all() or not test.any():
        raise bad(
            recording.name,
            "have windows to train on and windows to test on",
            f"it has {len(numbers)}, in segments {sorted(set(numbers.tolist()))}",
            "Record longer, make --window shorter, or name another recording by --test.",
        )
    return test


def read(path: Path) -> Recording:
    """A recording from a CSV file, gzipped if its name ends in .gz.

    Lines that start with # are skipped; the next line names the columns: `t` (s), the angle as
    `q` (rad, 0 hanging) or `theta1` (rad, 0 upright), and optionally `seg` (integer segment
    numbers) and `tau_meas` (N m). Columns `v` and `omega1` are passed over.

    Raises:
        DataError: no such file, or its content is not such a table.
    """
    names, rows = _table(path)
    angles = [name for name in names if name in ANGLES]
    unknown = set(names) - {"t", "seg", "tau_meas", *ANGLES, *UNUSED}
    if len(angles) != 1 or "t" not in names or unknown or len(set(names)) < len(names):
        raise bad(
            f"the header of {path.name}",
            "name t, one angle (q, 0 hanging, or theta1, 0 upright) and at most "
            "seg, tau_meas, v, omega1 besides",
            f"it names {', '.join(names)}",
            "Rename or drop columns.",
        )
    columns = dict(zip(names, rows.T, strict=True))
    numbers = columns.get("seg", np.zeros(len(rows)))
    q = columns[angles[0]] - ANGLES[angles[0]]
    segments = tuple(
        Segment(int(number), columns["t"], q, columns.get("tau_meas")).part(numbers == number)
        for number in np.unique(numbers)
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
            "be a CSV file that can be read, gzipped if its name ends in .gz",
            f"{path}: {getattr(error, 'strerror', None) or error}",
            "Check the path.",
        ) from error
    if len(lines) < 3:
        raise bad(path.name, "have a header and rows", f"it has {len(lines)} lines", "Fill it.")
    try:
        rows = np.loadtxt(lines[1:], delimiter=",", ndmin=2)
    except ValueError as error:
        was = str(error).rstrip(".")
        raise bad(path.name, "be a table of numbers", was, "Mend that row.") from error
    names = [name.strip() for name in lines[0].split(",")]
    if rows.shape[1] != len(names):
        raise bad(
            path.name,
            f"have as many columns as its header names, {len(names)}",
            f"its rows have {rows.shape[1]}",
            "Mend the header.",
        )
    if not np.all(np.isfinite(rows)):
        row, column = np.argwhere(~np.isfinite(rows))[0]
        raise bad(
            path.name,
            "hold finite numbers",
            f"{names[column]} was {rows[row, column]} in row {row + 1}",
            "Drop such rows, and number the pieces between them in a column seg.",
        )
    return names, rows


def _check_times(name: str, segment: Segment) -> None:
    if len(segment.t) < 2:
        raise bad(
            name,
            "have 2 rows or more in every segment",
            f"segment {segment.number} has {len(segment.t)}",
            "Drop it.",
        )
    steps = np.diff(segment.t)
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
            f"be sampled evenly, no step longer than {LONGEST_GAP} times the median",
            f"{segment.t[i]} s is followed by {segment.t[i + 1]} s",
            "Number the pieces on either side of a gap in a column seg.",
        )
