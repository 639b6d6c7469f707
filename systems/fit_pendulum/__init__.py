"""Identify a pendulum from measured motion: `python -m systems fit-pendulum [CSV.gz]`.

    J q'' = -m g l sin(q - zero) - c q' - f sign(q') - k q'|q'| + torque

The motion is cut into windows of 1 s, each with its own free start (q, q'). The parameters are
common to all windows. Models differ in friction: none, viscous (c), + Coulomb (f), + quadratic (k).
Measured velocities are not used, because they are filtered. Parameters are fitted to the training
windows alone. On the test windows only the starts are fitted (`jl.fit`, `FitResult.predict`).

A free swing identifies only m g l, c, f and k divided by J. A measured torque identifies J too.
"""

import sys
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

import jaxlag as jl
from systems.fit_pendulum import _report as report
from systems.fit_pendulum._data import DataError, Recording, segment
from systems.fit_pendulum._data import read as read
from systems.fit_pendulum._data import split as split
from systems.fit_pendulum._models import MODELS as MODELS
from systems.fit_pendulum._models import NAMES, driven, free
from systems.fit_pendulum._models import choose as choose
from systems.fit_pendulum._models import fit as fit
from systems.fit_pendulum._models import fit_segments as fit_segments
from systems.fit_pendulum._models import guess as guess
from systems.fit_pendulum._models import try_models as try_models

# For a synthetic recording: divided by J, as in a free swing.
TRUTH = {"J": 1.0, "mgl": 60.0, "c": 0.05, "f": 0.2, "zero": 0.01}
NOISE = 2e-3  # rad


def main(argv: Sequence[str]) -> int:
    """Fit a recording, or a synthetic one, and print the results; 0 if successful."""
    arguments = _parser().parse_args(argv)
    try:
        _run(arguments.recording, arguments.test, arguments.window, arguments.plot)
    except DataError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        prog="python -m systems fit-pendulum",
        description="Identify a pendulum from measured motion; without a file, from a simulated "
        "one with noise.",
    )
    parser.add_argument(
        "recording",
        nargs="?",
        type=Path,
        metavar="CSV.gz",
        help="columns t [s]; q [rad, 0 hanging] or theta1 [rad, 0 upright]; perhaps seg (numbers "
        "of segments) and tau_meas [N m]",
    )
    parser.add_argument(
        "--test",
        type=Path,
        metavar="CSV.gz",
        help="recording to test on; by default a third of the first one",
    )
    parser.add_argument(
        "--window", type=float, default=1.0, metavar="S", help="length of the windows [s] (1)"
    )
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="where to write the figure (fit-pendulum.png, if matplotlib is installed)",
    )
    return parser


def _run(path: Path | None, test: Path | None, seconds: float, plot: Path | None) -> None:
    if plot is not None:
        report.require_figure(plot)
    truth = TRUTH if path is None else None
    recording = synthetic(TRUTH, False, NOISE) if path is None else read(path)
    other = None if test is None else read(test)
    print(report.describe(recording))
    if truth:
        print(f"  simulated by jaxlag, Gaussian noise of {1e3 * NOISE:g} mrad rms on the angle")
    if other is not None:
        print(f"tested on {report.describe(other)}")
    trials = try_models(recording, other, seconds)
    print(*report.trials(recording, other, trials, truth), sep="\n")
    if path is not None and not recording.driven and len(recording.segments) > 1:
        print(*report.segments(recording, fit_segments(recording, trials)), sep="\n")
    if plot is None and not report.can_plot():
        print(f"figure left out: {report.NEEDS_MATPLOTLIB}")
        return
    plot = plot or Path("fit-pendulum.png")
    report.figure((other or recording).name, trials, plot)
    print(f"figure {plot}")


def synthetic(
    values: Mapping[str, float], torque: bool, noise: float, segments: int = 6, seed: int = 0
) -> Recording:
    """A simulated pendulum with Gaussian noise on its angle.

    Each segment lasts 5 s at 100 Hz and starts at rest, each closer to hanging than the previous
    one.

    Args:
        values: parameters by name; those left out are 0.
        torque: whether a torque of two sines drives the shaft and is recorded.
        noise: its rms, rad.
        segments: their number.
        seed: of the noise.
    """
    generator = np.random.default_rng(seed)
    t = np.arange(500) / 100.0
    u = 0.4 * values["mgl"] * (np.sin(2.1 * t) + np.sin(5.3 * t)) if torque else None
    system = driven if torque else free
    inputs = None if u is None else {"torque": jl.LinearInterpolation(t, u)}
    params = dict.fromkeys(NAMES, 0.0) | dict(values)
    pieces = {}
    for number in range(segments):
        start = [2.4 - 2.0 * number / segments]
        motion = jl.simulate(system, start, [0.0], t, params, inputs=inputs, rtol=1e-10, atol=1e-10)
        q = np.asarray(motion["q"]) + noise * generator.standard_normal(len(t))
        pieces[number] = segment(f"segment {number}", t, q, u)
    return Recording("synthetic pendulum", pieces)
