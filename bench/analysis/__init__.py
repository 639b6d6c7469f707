"""Linearization: `jl.linearize` beside central differences and sympy's linearizer.

Every side linearizes the same scene in a fresh process. `first_s` is the time to the first A beyond
imports: deriving and compiling, or symbolic derivation. `later_us` is the time of A at another
state: a compiled program, or substitution into sympy's equations. `apart` is the largest difference
from jaxlag's A over the largest entry. Differences are those of jaxlag's accelerations along the
directions of its states. sympy's LagrangesMethod refuses rows on velocities (its linear system is
singular), and the bicycle is too long for it.
"""

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from bench._harness.timing import Reference, Report, Target
from bench._harness.workers import fresh_process
from bench.analysis._scenes import BICYCLE, SCENES

ONE_PROCESS = str(Path(__file__).with_name("_one_process.py"))
SIDES = ("jaxlag", "differences", "sympy")
LONGEST_S = 600
SLOW_FIRST_S = 5.0
"""Bound on the first linearization of the bicycle."""
ROUNDING, TRUNCATION = 1e-12, 1e-6


def run(quick: bool) -> Report:
    """All sides of all scenes, one process after the other."""
    scenes = ["double pendulum"] if quick else [*SCENES, BICYCLE]
    rows = [row for scene in scenes for row in _of(scene)]
    return Report(rows, _targets(rows), _references(rows))


def _of(scene: str) -> list[dict[str, Any]]:
    """The rows of one scene."""
    answers = {side: _answer(side, scene) for side in SIDES if (side, scene) != ("sympy", BICYCLE)}
    A, rows = np.asarray(answers["jaxlag"]["A"]), []
    for side, answer in answers.items():
        apart = None
        if answer:
            apart = float(np.max(np.abs(np.asarray(answer["A"]) - A)) / np.max(np.abs(A)))
        figures = {key: answer.get(key) for key in ("first_s", "later_us")}
        rows.append({"scene": scene, "side": side, **figures, "apart": apart})
    return rows


def _answer(side: str, scene: str) -> dict[str, Any]:
    """What the process prints; nothing if it fails or is too slow."""
    try:
        done = fresh_process(ONE_PROCESS, side, scene, limit_s=LONGEST_S)
    except subprocess.TimeoutExpired:
        if side != "sympy":
            raise
        return {}
    if done.returncode and side != "sympy":
        raise RuntimeError(f"{side} on {scene!r} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1]) if not done.returncode else {}


def _by(rows: list[dict[str, Any]], side: str, key: str) -> dict[str, float]:
    """Figures of one side, by scene."""
    found = {row["scene"]: row[key] for row in rows if row["side"] == side}
    return {scene: x for scene, x in found.items() if x is not None}


def _targets(rows: list[dict[str, Any]]) -> list[Target]:
    sympy, differences = (_by(rows, side, "apart") for side in SIDES[:0:-1])
    claims = [
        Target("largest difference from sympy's A", max(sympy.values()), "<=", ROUNDING),
        Target("largest difference from differences", max(differences.values()), "<=", TRUNCATION),
        Target("differences over linearize, later", _ratio(rows, "differences"), ">=", 1.0),
    ]
    first = _by(rows, "jaxlag", "first_s")
    if BICYCLE in first:
        claims.append(Target("bicycle, first A [s]", first[BICYCLE], "<=", SLOW_FIRST_S))
    return claims


def _ratio(rows: list[dict[str, Any]], side: str, key: str = "later_us") -> float:
    """Geometric mean over the scenes of the times of one side over those of jaxlag."""
    own, other = _by(rows, "jaxlag", key), _by(rows, side, key)
    return float(np.exp(np.mean([np.log(other[scene] / own[scene]) for scene in other])))


def _references(rows: list[dict[str, Any]]) -> list[Reference]:
    later, first = (_ratio(rows, "sympy", key) for key in ("later_us", "first_s"))
    return [
        Reference(f"{later:.3g}", "times the time of linearize takes sympy at another state"),
        Reference(f"{first:.3g}", "times its time takes sympy for the first A"),
    ]
