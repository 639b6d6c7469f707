"""Seconds from a declared motion to its first result, in fresh processes.

Nine systems at tolerance 1e-9, each with 2 save times, 101 save times, a gradient, 256 lanes and
their gradients. "cold" is a process with an empty compile cache, "warm" the next one with the same
cache. The time to import jaxlag is given separately. For comparison: diffrax's Dopri8 on equations
written by hand, cold, and heyoka (building its Taylor integrator and running it once). The table
has the shortest time of all rounds. Final states are compared with those of diffrax.
"""

import json
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bench._harness.timing import Reference, Report, Target
from bench._harness.workers import fresh_process
from bench.first_result._one_process import CASES

SMALL = ("simple pendulum", "double pendulum", "cart pendulum", "rotating body")
LARGE = ("chain of 8", "chain of 12", "5 bodies", "network potential")
SCENES = (*SMALL[:3], "quadcopter", SMALL[3], *LARGE)
ROUNDS = 2
SOLVES = CASES[:2]
# Run by its path: as a module of this package it would import jax before the timing starts.
ONE_PROCESS = str(Path(__file__).with_name("_one_process.py"))
# Of final states, over 1 + their size. The tolerance is 1e-9 per step, and errors are amplified.
APART = 1e-5
CACHE = {
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}


def run(quick: bool) -> Report:
    """Every process by itself, one after the other."""
    scenes, cases = (SCENES[:2], CASES[:1]) if quick else (SCENES, CASES)
    rows = []
    for scene in scenes:
        heyoka = first("heyoka", scene, CASES[0], None) if find_spec("heyoka") else {}
        for case in cases:
            found = [_round(scene, case) for _ in range(1 if quick else ROUNDS)]
            rows.append(_row(scene, case, found, heyoka if case == CASES[0] else {}))
    return Report(rows, *judged(rows))


def first(side: str, scene: str, case: str, cache: str | None) -> dict[str, Any]:
    """The times and the result of one program, measured in its own process."""
    settings = {} if cache is None else {"JAX_COMPILATION_CACHE_DIR": cache, **CACHE}
    done = fresh_process(ONE_PROCESS, side, scene, case, **settings)
    if done.returncode:
        raise RuntimeError(f"{case} of {scene!r} on {side} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def _round(scene: str, case: str) -> dict[str, dict[str, Any]]:
    with TemporaryDirectory() as cache:
        cold, warm = (first("jaxlag", scene, case, cache) for _ in range(2))
    return {"cold": cold, "warm": warm, "diffrax": first("diffrax", scene, case, None)}


def _row(
    scene: str, case: str, rounds: Sequence[Mapping[str, Any]], heyoka: Mapping[str, Any]
) -> dict[str, Any]:
    cold, warm, diffrax = (
        min((found[side] for found in rounds), key=lambda x: x["first_s"])
        for side in ("cold", "warm", "diffrax")
    )
    run_ms = {side: min(r[side]["run_ms"] for r in rounds) for side in ("cold", "diffrax")}
    apart = _apart(cold["end"], diffrax["end"])
    if case in SOLVES and not apart <= APART:
        raise RuntimeError(f"{scene}: jaxlag and the equations by hand end {apart:.1e} apart")
    return {
        "scene": scene,
        "case": case,
        "import_s": cold["import_s"],
        "cold_s": cold["first_s"],
        "derive_s": cold["derive_s"],
        "lower_s": cold["lower_s"],
        "compile_s": cold["compile_s"],
        "warm_s": warm["first_s"],
        "diffrax_s": diffrax["first_s"],
        "heyoka_s": heyoka.get("first_s"),
        "run_ms": run_ms["cold"],
        "diffrax_run_ms": run_ms["diffrax"],
        "heyoka_run_ms": heyoka.get("run_ms"),
        "apart": apart if case in SOLVES else None,
        "rounds": len(rounds),
    }


def _apart(a: Sequence[float], b: Sequence[float]) -> float:
    if len(a) != len(b):  # by hand, y may have other entries after the coordinates
        return float("nan")
    x, y = np.asarray(a), np.asarray(b)
    return float(np.max(np.abs(x - y) / (1.0 + np.abs(y))))


def judged(rows: Sequence[Mapping[str, Any]]) -> tuple[list[Target], list[Reference]]:
    """Targets, each for the worst case of its kind, and references."""
    targets = []
    names = {row["scene"] for row in rows}
    for kind, wanted, bounds in (
        ("n <= 4", SMALL, (1.5, 3.0)),
        ("the quadcopter", ("quadcopter",), (2.5, 4.0)),
        ("chains, bodies, a network", LARGE, (4.0, 8.0)),
    ):
        for what, cases, bound in (
            ("rows", SOLVES, bounds[0]),
            ("a gradient", ("grad",), bounds[1]),
        ):
            if names & set(wanted):
                found = _worst(rows, wanted, cases, lambda row: row["cold_s"])
                targets.append(Target(f"s to the first result: {what}, {kind}", found, "<=", bound))
    for what, cases, bound in (("rows", SOLVES, 1.2), ("a gradient", ("grad",), 1.0)):
        found = _worst(rows, SCENES, cases, lambda row: row["cold_s"] / row["diffrax_s"])
        claim = f"times as long to the first result as diffrax by hand: {what}"
        targets.append(Target(claim, found, "<=", bound))
    found = _worst(rows, SCENES, CASES, lambda row: row["warm_s"])
    targets.append(Target("s to the first result with the persistent cache", found, "<=", 1.5))
    slower = [row for row in rows if row["run_ms"] > row["diffrax_run_ms"]]
    references = [
        Reference(f"{len(slower)} of {len(rows)}", "rows that run longer than diffrax by hand")
    ]
    return targets, references


def _worst(rows: Sequence[Mapping[str, Any]], scenes: Any, cases: Any, figure: Any) -> float:
    found = [figure(row) for row in rows if row["scene"] in scenes and row["case"] in cases]
    return max(found, default=float("nan"))
