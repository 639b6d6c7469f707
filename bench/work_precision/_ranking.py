"""The ranking from the table rows of `work-precision`: the fastest line at equal error, targets."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from bench._harness.timing import Reference, Target
from bench.work_precision._sweep import time_at

ERRORS = (1e-6, 1e-9, 1e-12)
COMPILED = ("heyoka", "numba")
PEERS = (*COMPILED, "SUNDIALS", "CasADi", "scipy", "MuJoCo")
REGULAR, CARTESIAN = "double pendulum, regular", "Cartesian double pendulum"
LANES = "16 double pendulums"
ORBITS = ("Kepler, e = 0.6", "Kepler, e = 0.9", "elastic pendulum, k = 1e6")
Row = Mapping[str, Any]
Belongs = Callable[[str], bool]


def is_ours(line: str) -> bool:
    """Whether a line is jaxlag's, with XLA's setting, on the jax that runs the benchmark."""
    return line.startswith("jaxlag") and ", jax " not in line


def is_peer(line: str) -> bool:
    return line.startswith(PEERS)


def starts(*prefixes: str) -> Belongs:
    return lambda line: line.startswith(prefixes)


def diffrax(form: str, setting: bool) -> Belongs:
    """diffrax on equations "by hand" or "naive", with the setting or without."""
    ending = form if setting else f"{form}, no setting"
    return lambda line: line.startswith("diffrax") and line.endswith(ending)


def best(rows: Iterable[Row], system: str, error: float, belongs: Belongs) -> tuple[float, str]:
    """(least time at an error, us, its line) over these lines; (inf, "") if none reaches it."""
    lines: dict[str, list[Row]] = {}
    for row in rows:
        if row["system"] == system and belongs(row["line"]):
            lines.setdefault(row["line"], []).append(row)
    found = [
        (us, line)
        for line, points in lines.items()
        if (us := time_at(points, error, "min_us")) is not None
    ]
    return min(found, default=(math.inf, ""))


def ratio(rows: Sequence[Row], system: str, error: float, others: Belongs) -> float:
    """jaxlag's time divided by that of the best of others, at an error.

    It is nan if jaxlag does not reach the error, and 0 if only jaxlag reaches it. It is also nan if
    the others have no table rows, for example if the libraries are not installed.
    """
    if not any(row["system"] == system and others(row["line"]) for row in rows):
        return math.nan
    us, _ = best(rows, system, error, is_ours)
    theirs, _ = best(rows, system, error, others)
    return us / theirs if us < math.inf else math.nan


def fastest(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """For every system and error the best time of jaxlag, of the peers and of diffrax, us."""
    groups = {
        "jaxlag": is_ours,
        "peer": is_peer,
        "by hand": diffrax("by hand", True),
        "naive": diffrax("naive", False),
    }
    table = []
    for system in dict.fromkeys(row["system"] for row in rows):
        for error in ERRORS:
            cells: dict[str, Any] = {"system": system, "error": f"{error:.0e}"}
            for label, belongs in groups.items():
                us, line = best(rows, system, error, belongs)
                cells[f"{label}_us"] = us if us < math.inf else None
                if label in ("jaxlag", "peer"):
                    cells[label] = line
            table.append(cells)
    return table


def fastest_references(rows: Sequence[Row]) -> list[Reference]:
    """References that name the fastest line at 1e-6, 1e-9 and 1e-12."""
    found = []
    for system in dict.fromkeys(row["system"] for row in rows):
        for error in ERRORS:
            us, line = best(rows, system, error, lambda line: True)
            ours, method = best(rows, system, error, is_ours)
            figure = f"{line} {us:.3g} us" if line else "nobody"
            rest = f"; {method} {ours:.3g} us" if method not in ("", line) else ""
            found.append(Reference(figure, f"{system}: fastest at {error:.0e}{rest}"))
    return found


def judged(rows: Sequence[Row], systems: Sequence[str]) -> tuple[list[Target], list[Reference]]:
    """Targets of these systems, and the steps and times of both sides for every missed target."""
    plans: list[tuple[str, str, float, float, Belongs]] = []  # claim, system, error, bound, others

    def at_most(bound: float, system: str, errors: Sequence[float], label: str, who: Belongs):
        plans.extend((label, system, error, bound, who) for error in errors)

    at_most(1.0, REGULAR, (1e-6, 1e-9), "the best of heyoka and numba", starts(*COMPILED))
    at_most(1.3, REGULAR, (1e-12,), "the best of heyoka and numba", starts(*COMPILED))
    at_most(0.5, REGULAR, ERRORS, "diffrax by hand with the setting", diffrax("by hand", True))
    at_most(1.5, CARTESIAN, (1e-9,), "the best peer", is_peer)
    at_most(0.1, CARTESIAN, (1e-9,), "diffrax by hand as found", diffrax("by hand", False))
    for system in ORBITS:
        at_most(1.5, system, (1e-6, 1e-9), "heyoka", starts("heyoka"))
    at_most(1.25, LANES, (1e-9,), "heyoka's SIMD mode", starts("heyoka"))
    at_most(1.0, LANES, (1e-7,), "heyoka's SIMD mode", starts("heyoka"))
    targets, profiles = [], []
    for label, system, error, bound, who in plans:
        if system not in systems:
            continue
        what = f"{system} at {error:.0e}"
        claim = f"times as long: jaxlag as {label}, {what}"
        targets.append(Target(claim, ratio(rows, system, error, who), "<=", bound))
        if not targets[-1].met:
            profiles.append(
                Reference(profile(rows, system, error, who), f"missed: as {label}, {what}")
            )
    targets += overall(rows, systems)
    for system in systems:
        figure = ratio(rows, system, 1e-9, is_peer)
        if figure > 2.0:
            text = profile(rows, system, 1e-9, is_peer)
            profiles.append(Reference(text, f"{figure:.3g} times the best peer: {system} at 1e-09"))
        for error in ERRORS:
            others = diffrax("by hand", True)
            figure = ratio(rows, system, error, others)
            if figure > 1.0:
                text = profile(rows, system, error, others)
                label = f"diffrax by hand with the setting: {system} at {error:.0e}"
                profiles.append(Reference(text, f"{figure:.3g} times {label}"))
    return targets, profiles


def overall(rows: Sequence[Row], systems: Sequence[str]) -> list[Target]:
    """Targets for the worst of all systems; nan if a system has no table rows."""
    gains = {}
    for system in systems:
        for error in ERRORS:
            share = ratio(rows, system, error, diffrax("naive", False))
            # If the prototype is missing or does not reach the error, there is no comparison.
            if (
                not ours_exist(rows, system)
                or best(rows, system, error, diffrax("naive", False))[1]
            ):
                gains[f"{system} at {error:.0e}"] = 1.0 / share
    slow = {
        system: ratio(rows, system, 1e-9, is_peer)
        for system in systems
        if not ours_exist(rows, system) or best(rows, system, 1e-9, is_peer)[1]
    }
    found = []
    if gains:
        where, least = worst(gains, smallest=True)
        claim = f"times faster: jaxlag than naive autodiff with diffrax as found, worst ({where})"
        found.append(Target(claim, least, ">=", 10.0))
    if slow:
        where, most = worst(slow, smallest=False)
        claim = f"times as long: jaxlag as the best peer at 1e-09, worst ({where})"
        found.append(Target(claim, most, "<=", 2.0))
    return found


def ours_exist(rows: Sequence[Row], system: str) -> bool:
    return any(row["system"] == system and is_ours(row["line"]) for row in rows)


def worst(figures: Mapping[str, float], smallest: bool) -> tuple[str, float]:
    """The worst figure and its name; nan is worse than any number."""
    for name, figure in figures.items():
        if math.isnan(figure):
            return name, figure
    return (min if smallest else max)(figures.items(), key=lambda item: item[1])


def profile(rows: Sequence[Row], system: str, error: float, others: Belongs) -> str:
    """Steps and time per step of both sides at an error, and jaxlag's time besides the steps."""
    parts = []
    for belongs in (is_ours, others):
        us, line = best(rows, system, error, belongs)
        if not line:
            parts.append("never")
            continue
        points = [row for row in rows if row["system"] == system and row["line"] == line]
        known = all(row["steps"] is not None for row in points)
        steps = time_at(points, error, "steps") if known else None
        each = f" in {steps:.0f} steps of {us / steps:.3g} us" if steps else ""
        if steps and belongs is is_ours:
            besides, step = fixed_and_each(points)
            each += f" (about {besides:.3g} us however few, and {step:.3g} us each)"
        parts.append(f"{line} {us:.3g} us{each}")
    return " against ".join(parts)


def fixed_and_each(points: Sequence[Row]) -> tuple[float, float]:
    """(time independent of the steps, time per accepted step), us, by least relative squares."""
    us = np.array([point["min_us"] for point in points], float)
    steps = np.array([point["steps"] for point in points], float)
    if len(set(steps)) < 2:
        return 0.0, float(np.min(us / steps))
    A = np.stack([np.ones_like(us), steps], 1) / us[:, None]
    fixed, each = np.linalg.lstsq(A, np.ones_like(us), rcond=None)[0]
    if fixed < 0.0:  # the time is all in the steps
        return 0.0, float(np.sum(steps / us) / np.sum((steps / us) ** 2))
    return float(fixed), float(each)
