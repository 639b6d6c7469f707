"""Stress: long runs, extremes and singular states, each with a bound and one verdict.

A case must end with the status ok and its figure within a bound written down beforehand ("within"),
or with the status that names its singularity ("named"). "silent" is a result beyond its bound with
the status ok. "failed" is a status that is not expected. Long runs take a million steps from 20
starts, orbits for Brouwer's law 100 000 or more from 128. A quick run takes some of the cases. Its
long runs have 30 000 steps from 8 and 32 starts. Most of its time is compilation.
"""

import math
from collections import Counter
from collections.abc import Sequence
from time import perf_counter
from typing import Any

from bench._harness.timing import Reference, Report, Target
from bench.stability import (
    _chaos,
    _drifts,
    _equilibria,
    _extremes,
    _fits,
    _gradients,
    _long_runs,
    _quasi_singularities,
    _redundant_rows,
    _single_precision,
    _singular_states,
    _stiff_forces,
)
from bench.stability._cases import Case, Found, verdict

PARTS = (
    _drifts,
    _long_runs,
    _singular_states,
    _extremes,
    _chaos,
    _single_precision,
    _gradients,
    _fits,
    _stiff_forces,
    _quasi_singularities,
    _redundant_rows,
    _equilibria,
)
CASES = [case for part in PARTS for case in part.cases.cases]
LEAST = 25  # cases that must end within their bounds
QUICK = {
    "energy over a million steps, splitting4",
    "energy over a million steps, splitting8",
    "Brouwer's law: energy, splitting8",
    "Brouwer's law: phase, splitting8",
    "there and back, splitting8",
    "angular momentum of orbits, splitting8",
    "Kepler, e = 0.99",
    "falling from upright, 1e-9 rad",
    "masses 1 : 1e-8, both bobs",
    "t0 = 1e9 s, pushed",
    "float32: double pendulum",
    "chaos: errors of order 8 up to the horizon",
    "gradient at stiffness 0",
    "jl.fit: k / m alone",
    "springs over 12 decades",
    "a force that jumps",
    "stiffness 0",
    "mass and stiffness 1e12",
    "gradient of a start balanced upright",
    "a force that becomes nan",
    "fewer steps than it takes",
    "steps far too long for a stiff spring",
    "sharp: one-sided spring",
    "sharp: exponential barrier",
    "singular quasi-velocities: cos(y) x', crossed",
    "reactions beside redundant rows, levers to 10 nm",
    "rows that are 0 = 0 but for rounding",
    "rest of closed linkages: four-bars in angles",
}


def run(quick: bool) -> Report:
    """All cases, one after the other."""
    cases = [case for case in CASES if not quick or case.name in QUICK]
    rows = [judged(case, quick) for case in cases]
    successes = sum(not case.statuses for case in cases)
    shown = [{key: x for key, x in row.items() if key != "details"} for row in rows]
    return Report(rows, *conclusions(rows, min(LEAST, successes)), shown)


def judged(case: Case, quick: bool) -> dict[str, Any]:
    """Run one case; its table row."""
    case = case.in_quick(quick)
    start = perf_counter()
    try:
        found = case.run(quick)
    except Exception as error:  # an error in one case must not stop the others
        found = Found(math.nan, (f"raised {type(error).__name__}: {error}"[:200],))
    return row(case, found) | {"seconds": perf_counter() - start}


def row(case: Case, found: Found) -> dict[str, Any]:
    """The table row: the result of a case, with its bound and verdict."""
    return {
        "row": case.name,
        "figure": found.figure,
        "bound": case.bound,
        "what": case.figure,
        "statuses": ", ".join(dict.fromkeys(found.statuses)),
        "verdict": verdict(case, found),
        "details": found.details,
    }


def conclusions(rows: Sequence[dict[str, Any]], least: int) -> tuple[list[Target], list[Reference]]:
    """Targets, and the names of the cases that miss them."""
    count = Counter(row["verdict"] for row in rows)
    targets = [
        Target("rows within their bounds", count["within"], ">=", least),
        Target("silent wrong answers", count["silent"], "<=", 0),
        Target("rows that failed without need", count["failed"], "<=", 0),
    ]
    named = [row for row in rows if row["verdict"] in ("silent", "failed")]
    return targets, [Reference(row["verdict"], row["row"]) for row in named]
