"""Recordings of a swinging pendulum: read from a file, cut into windows.

Angles are in rad from the hanging position, positive counterclockwise, not wrapped. A recording
consists of one or more evenly sampled segments, each with its own number. If the shaft is driven,
the motor's torque (N m) is recorded with the angle.
"""

import gzip
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

import jaxlag as jl

# Columns of an angle, and the value of each for the hanging pendulum (rad).
ANGLES = {"q": 0.0, "theta1": np.pi}
# Columns that may exist but are not used: recorded velocities are filtered, angles are not.
UNUSED = ("v", "omega1")
LONGEST_STEP = 0.5  # s, median between samples: at 2 Hz a pendulum of 1 m has 4 in a period
LONGEST_GAP = 1.5  # between samples, over their median spacing
FEWEST_SAMPLES = 10  # in a window
SHORTEST = 0.2  # s, of a window
# Hz, of the angles that are used. All samples of a free swing at 1 kHz changed its parameters by
# 0.2 of the standard errors at 100 Hz. Torques are used as recorded.
RATE = 100.0


class DataError(ValueError):
    """A recording cannot be used; the message names the argument, the requirement and the value."""


class Recording(NamedTuple):
    """One measurement.

    Attributes:
        name: of the file.
        segments: evenly sampled motion by number: channel "q" (rad, 0 hanging) and, if the shaft
            is driven, input "torque" (N m).
    """

    name: str
    segments: dict[int, jl.Experiment]

    @property
    def driven(self) -> bool:
        """Whether a torque was recorded."""
        return any(segment.inputs for segment in self.segments.values())

    @property
    def spacing(self) -> float:
        """Median time between samples, s."""
        return float(np.median(np.diff(next(iter(self.segments.values())).ts)))

    def thinned(self) -> "Recording":
        """The recording thinned to RATE; unchanged if its own rate is not higher."""
        every = slice(None, None, max(1, round(1 / (RATE * self.spacing))))
        return Recording(self.name, {n: each.part(every) for n, each in self.segments.items()})


class Split(NamedTuple):
    """Windows for the fit of the parameters, and windows for their test."""

    train: list[jl.Experiment]
    test: list[jl.Experiment]


def data_error(argument: str, must: str, was: str, fix: str) -> DataError:
    """`<argument> must <must>, but <was>. <fix>`."""
    return DataError(f"{argument} must {must}, but {was}. {fix}")


def segment(
    name: str,
    t: Float[np.ndarray, " s"],
    q: Float[np.ndarray, " s"],
    torque: Float[np.ndarray, " s"] | None = None,
) -> jl.Experiment:
    """One piece of evenly sampled motion.

    The torque is interpolated linearly between its samples. These come from a motor current, which
    is continuous; commands would be held between samples. (A zero-order hold increased the rms by
    1 % in a recording at 500 Hz, by 4 % in one at 50 Hz.)

    Args:
        name: of the piece.
        t: times, s.
        q: angles, rad, 0 hanging.
        torque: on the shaft, N m; None for a free swing.
    """
    inputs = None if torque is None else {"torque": jl.LinearInterpolation(t, torque)}
    return jl.Experiment(t, {"q": q}, inputs=inputs, name=name)


def cut(recording: Recording, seconds: float) -> dict[int, list[jl.Experiment]]:
    """Adjacent windows of `seconds` from each segment's start, by the segment's number.

    A remainder shorter than a window is left out.

    Raises:
        DataError: a window would be too short, all segments are shorter than a window, or angle or
            torque never change.
    """
    spacing = recording.spacing
    least = max(SHORTEST, FEWEST_SAMPLES * spacing)
    if not seconds >= 0.999 * least or not np.isfinite(seconds):
        must = f"last {least:.3g} s or more"
        raise data_error("--window", must, f"it was {seconds:g} s", "Make it longer.")
    pieces = list(recording.segments.values())
    lengths = {n: _length(each, spacing) for n, each in recording.segments.items()}
    if max(lengths.values()) < 0.999 * seconds:
        raise data_error(
            recording.name,
            f"last one window of {seconds:.3g} s or more",
            f"its longest segment lasts {max(lengths.values()):.3g} s",
            "Record longer, or make --window shorter.",
        )
    q = np.concatenate([each.channels["q"] for each in pieces])
    if np.ptp(q) == 0:
        raise data_error(
            recording.name, "move", f"its angle was always {q[0, 0]:g}", "Let it swing."
        )
    torques = [np.asarray(each.inputs["torque"].values) for each in pieces if each.inputs]
    if torques and np.ptp(np.concatenate(torques)) == 0:
        raise data_error(
            f"tau_meas of {recording.name}",
            "vary",
            f"it was always {torques[0][0]:g}",
            "Drop the column if the pendulum swings freely.",
        )
    return {
        number: list(each.windows(min(seconds, lengths[number])))
        for number, each in recording.segments.items()
        if lengths[number] >= 0.999 * seconds
    }


def _length(piece: jl.Experiment, spacing: float) -> float:
    """Duration in seconds, including the interval after the last sample."""
    return float(piece.ts[-1] - piece.ts[0]) + spacing


def split(recording: Recording, other: Recording | None, seconds: float) -> Split:
    """Windows of `recording` to train on, and of `other`, or a third of `recording`, to test on.

    That third consists of the segments whose number is divisible by 3, or of every third window if
    there is only one segment.

    Raises:
        DataError: the recordings are too short, or only one of them has a torque.
    """
    pieces = cut(recording, seconds)
    own = [window for each in pieces.values() for window in each]
    if other is not None:
        if other.driven != recording.driven:
            raise data_error(
                "--test",
                f"name a recording {'with' if recording.driven else 'without'} tau_meas, "
                f"like {recording.name}",
                f"{other.name} is one {'with' if other.driven else 'without'} it",
                "Train and test on one kind.",
            )
        return Split(own, [window for each in cut(other, seconds).values() for window in each])
    if len(recording.segments) > 1:
        held = [number % 3 == 0 for number, each in pieces.items() for _ in each]
    else:
        held = [i % 3 == 0 for i in range(len(own))]
    if all(held) or not any(held):
        raise data_error(
            recording.name,
            "have windows to train on and windows to test on",
            f"it has {len(held)}, in segments {sorted(pieces)}",
            "Record longer, make --window shorter, or name another recording by --test.",
        )
    train = [window for window, out in zip(own, held, strict=True) if not out]
    return Split(train, [window for window, out in zip(own, held, strict=True) if out])


def read(path: Path) -> Recording:
    """A recording from a CSV file, gzipped if its name ends in .gz.

    Lines that start with # are skipped; the next line names the columns: `t` (s), the angle as
    `q` (rad, 0 hanging) or `theta1` (rad, 0 upright), and optionally `seg` (integer segment
    numbers) and `tau_meas` (N m). Columns `v` and `omega1` are ignored.

    Raises:
        DataError: no such file, or its content is not such a table.
    """
    names, samples = _table(path)
    angles = [name for name in names if name in ANGLES]
    unknown = set(names) - {"t", "seg", "tau_meas", *ANGLES, *UNUSED}
    if len(angles) != 1 or "t" not in names or unknown or len(set(names)) < len(names):
        raise data_error(
            f"the header of {path.name}",
            "name t, one angle (q, 0 hanging, or theta1, 0 upright) and at most "
            "seg, tau_meas, v, omega1 besides",
            f"it names {', '.join(names)}",
            "Rename or drop columns.",
        )
    columns = dict(zip(names, samples.T, strict=True))
    numbers = columns.get("seg", np.zeros(len(samples)))
    if np.any(numbers != np.round(numbers)):
        was = f"one was {numbers[numbers != np.round(numbers)][0]:g}"
        raise data_error(f"seg of {path.name}", "hold integers", was, "Number the segments.")
    q = columns[angles[0]] - ANGLES[angles[0]]
    torque = columns.get("tau_meas")
    segments = {}
    for number in np.unique(numbers):
        own, n = numbers == number, int(number)
        t = columns["t"][own]
        _check_times(path.name, n, t)
        name = f"segment {n}" if "seg" in columns else path.name
        segments[n] = segment(name, t, q[own], None if torque is None else torque[own])
    return Recording(path.name, segments)


def _table(path: Path) -> tuple[list[str], np.ndarray]:
    try:
        with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as file:
            lines = [text for text in (line.partition("#")[0].strip() for line in file) if text]
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise data_error(
            "the recording",
            "be a CSV file that can be read, gzipped if its name ends in .gz",
            f"{path}: {getattr(error, 'strerror', None) or error}",
            "Check the path.",
        ) from error
    if len(lines) < 3:
        raise data_error(
            path.name, "have a header and rows", f"it has {len(lines)} lines", "Fill it."
        )
    header = lines[0].strip()
    if "," not in header and len(header.replace(";", " ").split()) > 1:
        was = f"its header was {header!r}"
        raise data_error(path.name, "separate its columns by commas", was, "Write t,q.")
    names = [name.strip() for name in header.split(",")]
    rows = [[field.strip() for field in line.split(",")] for line in lines[1:]]
    for number, row in enumerate(rows, 1):
        if len(row) != len(names):
            raise data_error(
                path.name,
                f"have as many columns as its header names, {len(names)}",
                f"row {number} has {len(row)}",
                "Mend the header, or that row.",
            )
    try:
        samples = np.array(rows, float)
    except ValueError as error:
        number, name, was = next(_not_numbers(names, rows))
        raise data_error(
            path.name,
            "be a table of numbers",
            f"{name} was {was!r} in row {number}",
            "Mend that row.",
        ) from error
    if not np.all(np.isfinite(samples)):
        index, column = np.argwhere(~np.isfinite(samples))[0]
        raise data_error(
            path.name,
            "hold finite numbers",
            f"{names[column]} was {samples[index, column]} in row {index + 1}",
            "Drop such rows, and number the pieces between them in a column seg.",
        )
    return names, samples


def _not_numbers(
    names: Sequence[str], rows: Sequence[Sequence[str]]
) -> Iterator[tuple[int, str, str]]:
    """(row, counted from 1 below the header; column; text) of what is no number."""
    for number, row in enumerate(rows, 1):
        for name, field in zip(names, row, strict=True):
            try:
                float(field)
            except ValueError:
                yield number, name, field


def _check_times(name: str, number: int, t: np.ndarray) -> None:
    if len(t) < 2:
        raise data_error(
            name,
            "have 2 rows or more in every segment",
            f"segment {number} has {len(t)}",
            "Drop it.",
        )
    steps = np.diff(t)
    if np.median(steps) > LONGEST_STEP:
        raise data_error(
            f"t of {name}",
            f"be in s, with a sample each {LONGEST_STEP:g} s or more often",
            f"samples are {np.median(steps):g} apart",
            "Divide milliseconds by 1000.",
        )
    if np.min(steps) <= 0:
        i = int(np.argmax(steps <= 0))
        raise data_error(
            f"t of {name}",
            "increase strictly within a segment",
            f"{t[i]} s is followed by {t[i + 1]} s",
            "Sort the rows and drop repeated ones.",
        )
    if np.max(steps) > LONGEST_GAP * np.median(steps):
        i = int(np.argmax(steps))
        raise data_error(
            f"t of {name}",
            f"be sampled evenly, no step longer than {LONGEST_GAP} times the median",
            f"{t[i]} s is followed by {t[i + 1]} s",
            "Number the pieces on either side of a gap in a column seg.",
        )
