"""Parameters identified from real measurements, compared with published values.

The recordings are in a folder outside this project, given by `--data` or by the environment
variable JAXLAG_DATA: multiarm_pendulum/{single,double,triple}.csv.gz (columns seg, t, theta1, ...),
dfki_double_pendulum/design*.csv.gz (t, q1, q2, tau_meas1, tau_meas2), dfki_simple_pendulum/
{ddp,ilqr}.csv.gz (t, q, tau_meas), contactnets_cube/tosses.csv.gz (toss, t, x, y, z, qw, qx, qy,
qz, vx, vy, vz, wx, wy, wz), ibm_double_pendulum/{2,13,17}.csv.gz (six columns of pixels). A missing
recording is left out and named. One part is simulated and needs no recording.

`value` is the estimate, in `unit`. `low` and `high` are the limits of its 95 % interval. The
interval is valid for noise that is independent between samples. Residuals of dry friction are not
independent: there the intervals are too narrow. `other` is a value for comparison, `whose` its
source. On test data only the initial states are fitted.

A quick run takes a few windows of each recording.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from bench._harness.timing import Reference, Report
from bench.fits import _actuated_arm, _cube, _multiarm, _network, _synthetic, _video
from bench.fits._data import folder
from bench.fits._report import Part

# Folder of the recordings, and the function of (path, quick) that evaluates them.
PARTS: tuple[tuple[str, Callable[..., Part]], ...] = (
    ("multiarm_pendulum", partial(_multiarm.measured, arms=1)),
    ("multiarm_pendulum", partial(_multiarm.measured, arms=2)),
    ("multiarm_pendulum", partial(_multiarm.measured, arms=3)),
    ("multiarm_pendulum", _network.measured),
    ("dfki_simple_pendulum", _actuated_arm.arm),
    ("dfki_double_pendulum", partial(_actuated_arm.arms, design="A")),
    ("dfki_double_pendulum", partial(_actuated_arm.arms, design="C.1")),
    ("contactnets_cube", _cube.measured),
    ("ibm_double_pendulum", _video.measured),
)


def run(quick: bool, data: str | None = None) -> Report:
    """All parts, one after the other."""
    path = folder(data)
    found, missing = [_synthetic.part(quick)], []
    for recordings, part in PARTS:
        if not (path / recordings).is_dir():
            missing.append(Reference(recordings, "not in the folder: left out"))
            continue
        try:
            found.append(part(path=path, quick=quick))
        except FileNotFoundError as error:
            name = f"{recordings}/{Path(error.filename).name}"
            missing.append(Reference(name, "not in the folder: its part is left out"))
    rows: list[dict[str, Any]] = [x._asdict() for part in found for x in part.figures]
    targets = [x for part in found for x in part.targets]
    return Report(rows, targets, [x for part in found for x in part.references] + missing)
