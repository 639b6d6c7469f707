"""Params from real measurements, beside what others found from the same ones.

The recordings lie in a folder outside this project, which `--data` names, or the environment
variable JAXLAG_DATA: multiarm_pendulum/{single,double,triple}.csv.gz (columns seg, t, theta1, ...),
dfki_double_pendulum/design*.csv.gz (t, q1, q2, tau_meas1, tau_meas2), dfki_simple_pendulum/
{ddp,ilqr}.csv.gz (t, q, tau_meas), contactnets_cube/tosses.csv.gz (toss, t, x, y, z, qw, qx, qy,
qz, vx, vy, vz, wx, wy, wz), ibm_double_pendulum/{2,13,17}.csv.gz (six columns of pixels). One that
is missing is left out and named. The last part is simulated and needs none.

`value` is what was found, in `unit`; `low` and `high` bound its 95 % interval, which holds for
noise that is independent from sample to sample (residuals of dry friction are not: intervals are
too narrow there). `other` is the number to read it by, and `whose` says whose it is. Test data
give their own starts and nothing else.

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

# Folder of the recordings -> what is found from them, by (path, quick).
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
