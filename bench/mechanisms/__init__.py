"""Mechanisms: first results, methods, gradients and evaluations, beside the same by other means.

Every case is a fresh process with an empty compile cache, without the time to import. Motions have
101 save times and the tolerance 1e-9, kvaerno5 1e-6, variational4 its fixed step. `apart` is the
difference of the end from Newton's and Euler's equations on numbers, from published digits or
from one degree of freedom, over 1 + its size; of a gradient, the difference from a quotient of
differences along one direction. `evaluation_ns` is one evaluation of the accelerations in a loop,
`off` their relative difference from those of the first case.

Cases beside jaxlag's: "by hand" (derivatives of L and one dense solve in JAX, diffrax), "sympy" (L
in symbols, Lagrange's equations, cse, scipy's DOP853 on plain code; evaluation in C), "mujoco".
A case over 90 s is stopped: its first_s is then a lower bound.
"""

import json
import subprocess
import sys
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from math import exp, log
from pathlib import Path
from typing import Any

import numpy as np

from bench._harness.timing import Reference, Report, Target
from bench._harness.workers import fresh_process
from bench.mechanisms._scene import Scene
from bench.mechanisms._scenes import SCENES

LIMIT_S = 90.0
SMALL = ("bicycle", "bicycle, quasi", "squeezer", "governor", "2 four-bars", "six-bar", "arm")
METHODS = ("null_space", "kvaerno5", "variational4")
# Ends beside the independent ones: the tolerance holds for a step, and motions amplify errors.
APART = {"kvaerno5": 1e-2, "variational4": 1e-1, "gradient": 1e-3}
USUAL_APART, SAME = 1e-6, 1e-8
FAILED = "failed"
# Run by its path: as a module of this package it would import jax before the timing starts.
ONE_PROCESS = str(Path(__file__).with_name("_one_process.py"))
COLUMNS = ("scene", "n", "rows", "case", "first_s", "run_ms", "solve_ms", "steps", "apart")
COLUMNS += ("evaluation_ns", "off", "operations", "note")

Row = dict[str, Any]


def run(quick: bool) -> Report:
    """Every process by itself, one after the other."""
    scenes = ("2 four-bars",) if quick else tuple(SCENES)
    rows = [row for name in scenes for row in measured(name, quick)]
    return Report(rows, *judged(rows))


def cases(name: str, scene: Scene, quick: bool) -> Iterable[str]:
    """The cases of a scene that exist."""
    yield from ("solve", "explain")
    if quick:
        return
    if scene.phi is not None and scene.quasi is None:
        yield "null_space"
    yield "kvaerno5"
    if scene.rolling is None:
        yield "variational4"
    yield "gradient"
    if name == "bicycle":
        yield from ("acceleration", "assemble")
    if scene.quasi is None:  # the others have the same equations for both
        yield "by hand"
        if find_spec("sympy"):
            yield "sympy"
    if name == "arm" and find_spec("mujoco"):
        yield "mujoco"


def measured(name: str, quick: bool) -> list[Row]:
    """The rows of one scene."""
    scene, rows = SCENES[name](), []
    end, ours = scene.end(), None
    count = sum(np.size(part) for part in _residuals(scene))
    for case in cases(name, scene, quick):
        found = first(name, case)
        apart = None
        if "end" in found:
            apart = float(np.max(np.abs(np.array(found["end"]) - end) / (1.0 + np.abs(end))))
        elif "along" in found:
            a, b = found["along"], found["difference"]
            apart = abs(a - b) / (1.0 + abs(b))
        off = None
        if "acceleration" in found:
            a = np.array(found["acceleration"])
            ours = a if ours is None else ours
            off = float(np.max(np.abs(a - ours)) / np.max(np.abs(ours)))
        row = {key: found.get(key) for key in COLUMNS}
        row |= {"scene": name, "n": scene.q0.size, "rows": count, "case": case}
        rows.append(row | {"apart": apart, "off": off})
        print(f"{name}, {case}: {row['first_s'] or 0.0:.3g} s {row['note'] or ''}", file=sys.stderr)
    return rows


def _residuals(scene: Scene) -> list[Any]:
    found = []
    if scene.phi is not None:
        found.append(scene.phi(0.0, scene.q0, scene.params))
    if scene.rolling is not None:
        found.append(scene.rolling(0.0, scene.q0, scene.v0, scene.params))
    return found


def first(name: str, case: str) -> dict[str, Any]:
    """The figures of one program, measured in its own process."""
    try:
        done = fresh_process(ONE_PROCESS, name, case, limit_s=LIMIT_S)
    except subprocess.TimeoutExpired:
        return {"first_s": LIMIT_S, "note": f"stopped after {LIMIT_S:g} s"}
    if done.returncode != 0:
        return {"note": f"{FAILED}: {done.stderr.strip().splitlines()[-1]}"}
    found = json.loads(done.stdout.splitlines()[-1])
    return found | ({"note": found["refused"]} if "refused" in found else {})


def judged(rows: list[Row]) -> tuple[list[Target], list[Reference]]:
    """Targets, each for the worst scene, and references."""
    of = {(row["scene"], row["case"]): row for row in rows}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))

    def figures(case: str, key: str, among: Iterable[str] = scenes) -> dict[str, float]:
        chosen = {name: of.get((name, case), {}).get(key) for name in among}
        return {name: value for name, value in chosen.items() if value is not None}

    def worst(values: Iterable[float]) -> float:
        return max(values, default=float("nan"))

    firsts, targets = figures("solve", "first_s"), []
    failed = sum(str(row["note"]).startswith(FAILED) for row in rows)
    targets.append(Target("cases that failed", failed, "<=", 0))
    ends = (row["apart"] / APART.get(row["case"], USUAL_APART) for row in rows if row["apart"])
    targets.append(Target("times its bound: an end or a gradient apart", worst(ends), "<=", 1.0))
    found = worst(row["off"] for row in rows if row["off"] is not None)
    targets.append(Target("relative difference of accelerations", found, "<=", SAME))
    for what, among, bound in (
        ("n <= 8 with up to 6 rows", [name for name in scenes if name in SMALL], 5.0),
        ("the larger ones", [name for name in scenes if name not in SMALL], 8.0),
    ):
        found = worst(firsts[name] for name in among if name in firsts)
        targets.append(Target(f"s to the first result: {what}", found, "<=", bound))
    for method in METHODS:
        found = figures(method, "first_s")
        claim = f"times as long to the first result as by default: {method}"
        ratio = worst(found[name] / firsts[name] for name in found)
        targets.append(Target(claim, ratio, "<=", 2.0))
    gradients, solves = figures("gradient", "run_ms"), figures("gradient", "solve_ms")
    ratio = worst(gradients[name] / solves[name] for name in gradients)
    targets.append(Target("times as long as the solve: a gradient", ratio, "<=", 2.0))
    ours, theirs = (figures(case, "evaluation_ns") for case in ("solve", "sympy"))
    ratios = {name: ours[name] / theirs[name] for name in theirs if name in ours}
    mean = exp(sum(map(log, ratios.values())) / len(ratios)) if ratios else float("nan")
    claim = "times as long as C of sympy's cse: an evaluation, geometric mean"
    targets.append(Target(claim, mean, "<=", 1.2))
    claim = "s of derivation, by explain"
    targets.append(Target(claim, worst(figures("explain", "first_s").values()), "<=", 2.0))
    bicycle = of.get(("bicycle", "solve"))
    if bicycle is not None:
        targets.append(Target("operations of the bicycle", bicycle["operations"], "<=", 4000))
        targets.append(Target("ms of the bicycle's run", bicycle["run_ms"], "<=", 5.0))
        for case in ("acceleration", "assemble"):
            found = of["bicycle", case]["first_s"]
            targets.append(Target(f"s to the first result: {case}, bicycle", found, "<=", 5.0))
    references = [
        _beside(peer, what, firsts if key == "first_s" else figures("solve", key),
                figures(peer, key))
        for peer in ("by hand", "sympy")
        for key, what in (("first_s", "to the first result"), ("run_ms", "of a run"))
    ]  # fmt: skip
    listed = ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items())
    references.append(Reference(listed or "none", "evaluations beside C, by scene"))
    mujoco = figures("mujoco", "evaluation_ns")
    if mujoco:
        figure = f"{ours['arm'] / mujoco['arm']:.2f}"
        references.append(Reference(figure, "evaluation of the arm beside MuJoCo"))
    return targets, references


def _beside(
    peer: str, what: str, ours: Mapping[str, float], theirs: Mapping[str, float]
) -> Reference:
    shorter = sum(ours[name] <= value for name, value in theirs.items())
    return Reference(
        f"{shorter} of {len(theirs)}", f"scenes with a shorter time {what} than {peer}"
    )
