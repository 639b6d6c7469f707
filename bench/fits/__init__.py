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

A quick run fits three simulated recordings, and one model each of the single pendulum and the
driven arm, to the data of the whole run. The other parts are left out and named.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from bench._harness.timing import Reference, Report
from bench.fits import _actuated_arm, _cube, _multiarm, _network, _synthetic, _video
from bench.fits._data import folder
from bench.fits._report import Part


class Measured(NamedTuple):
    """Parts that need one folder of recordings.

    Attributes:
        recordings: name of the folder.
        what: name of the part.
        part: its results, from the path of all recordings.
        quick: those of a quick run; None for none.
    """

    recordings: str
    what: str
    part: Callable[[Path], Part]
    quick: Callable[[Path], Part] | None = None


PARTS = (
    Measured(
        "multiarm_pendulum",
        "single pendulum",
        partial(_multiarm.measured, arms=1),
        partial(_multiarm.tested, arms=1, model=_multiarm.QUICK),
    ),
    Measured("multiarm_pendulum", "double pendulum", partial(_multiarm.measured, arms=2)),
    Measured("multiarm_pendulum", "triple pendulum", partial(_multiarm.measured, arms=3)),
    Measured("multiarm_pendulum", "neural network", _network.measured),
    Measured(
        "dfki_simple_pendulum",
        "one driven arm",
        _actuated_arm.arm,
        partial(_actuated_arm.arm, models=_actuated_arm.QUICK),
    ),
    Measured("dfki_double_pendulum", "design A", partial(_actuated_arm.arms, design="A")),
    Measured("dfki_double_pendulum", "design C.1", partial(_actuated_arm.arms, design="C.1")),
    Measured("contactnets_cube", "cube in flight", _cube.measured),
    Measured("ibm_double_pendulum", "video", _video.measured),
)


def run(quick: bool, data: str | None = None) -> Report:
    """All parts, one after the other."""
    path = folder(data)
    found, missing = [_synthetic.part(quick)], []
    for each in PARTS:
        part = each.quick if quick else each.part
        if part is None:
            missing.append(Reference(each.what, "left out of a quick run"))
            continue
        if not (path / each.recordings).is_dir():
            missing.append(Reference(each.recordings, "not in the folder: left out"))
            continue
        try:
            found.append(part(path))
        except FileNotFoundError as error:
            name = f"{each.recordings}/{Path(error.filename).name}"
            missing.append(Reference(name, "not in the folder: its part is left out"))
    rows: list[dict[str, Any]] = [x._asdict() for part in found for x in part.figures]
    targets = [x for part in found for x in part.targets]
    return Report(rows, targets, [x for part in found for x in part.references] + missing)
