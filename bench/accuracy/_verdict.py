"""Whether the errors of a motion match its tolerance: formulas and verdicts.

Errors are measured as `jl.lyapunov` measures growth: |e / w|, the Euclidean norm over (q, v) of
the error in units of w = atol + rtol |y|.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bench._harness.timing import Reference, Target

EPS = float(np.finfo(float).eps)
UPPER = 10.0  # kappa, above the floor
LOWER = 1e-3
STEPS = 20  # least number for the lower bound
AT_SAVES = 2.0  # times the error at step ends
ESTIMATE = 1 / 3, 100.0  # times the error
WORST = 5  # cases named for each bound


class Errors(NamedTuple):
    """Errors of one motion at s times after the start.

    Attributes:
        saves: (s,), scaled errors at the save times of one motion.
        ends: (e,), scaled errors of motions that end at some of these times, where a step ends.
        saves_at_ends: (e,), the entries of `saves` at the times of `ends`.
        estimates: (s,), scaled estimates of the error by `jl.simulate`.
        size: (s,), |y / w|.
        kappa: (s,), growth of perturbations.
        steps: number of accepted steps.
    """

    saves: np.ndarray
    ends: np.ndarray
    saves_at_ends: np.ndarray
    estimates: np.ndarray
    size: np.ndarray
    kappa: np.ndarray
    steps: int


NOTHING = Errors(*(np.array([np.nan]) for _ in range(6)), steps=0)
"""Errors of a motion that could not be solved."""


def scaled(error: np.ndarray, y: np.ndarray, rtol: float, atol: float) -> np.ndarray:
    """|error / (atol + rtol |y|)| at every time."""
    return np.linalg.norm(error / (atol + rtol * np.abs(y)), axis=-1)


def rounding(errors: Errors) -> np.ndarray:
    """Bound on the accumulated rounding error, eps kappa sqrt(steps) |y / w|, (s,)."""
    return EPS * errors.kappa * errors.steps**0.5 * errors.size


def judged(errors: Errors) -> dict[str, Any]:
    """The columns of a table row."""
    floor = 10 * rounding(errors)
    over = errors.saves / (UPPER * errors.kappa + floor)
    error = _largest(errors.saves)
    above = bool(np.any(errors.saves > floor))
    ratios = _estimates(errors)
    return {
        "steps": errors.steps,
        "kappa": float(errors.kappa[-1]),
        "error": error,
        "floor": float(floor[-1]),
        "of_bound": _largest(over),
        "upper": "within" if np.all(over <= 1) else "beyond",
        "lower": _lower(error, above, errors.steps),
        "saves_to_ends": _saves_to_ends(errors) if above else None,
        "estimate_least": float(np.min(ratios)) if len(ratios) else None,
        "estimate_most": float(np.max(ratios)) if len(ratios) else None,
        "estimate_of_largest": float(ratios[-1]) if len(ratios) else None,
    }


def _largest(x: np.ndarray) -> float:
    """The largest entry; infinite if there is a nan, where the motion ended early."""
    return float(np.max(np.nan_to_num(x, nan=np.inf)))


def _lower(error: float, above: bool, steps: int) -> str:
    if not above:
        return "floor"
    if steps < STEPS:
        return "few steps"
    return "within" if error >= LOWER else "below"


def _saves_to_ends(errors: Errors) -> float:
    return _largest(errors.saves_at_ends) / _largest(errors.ends)


def _estimates(errors: Errors) -> np.ndarray:
    """Estimate over error at all times with an error above rounding, the largest error last."""
    above = np.flatnonzero(~(errors.saves <= rounding(errors)))
    order = above[np.argsort(errors.saves[above], kind="stable")]
    return errors.estimates[order] / errors.saves[order]


def name_exact(rows: Sequence[dict[str, Any]]) -> None:
    """Mark the cases of one motion as exact if no tolerance has an error above the floor."""
    if all(row["lower"] == "floor" for row in rows):
        for row in rows:
            row["lower"] = "exact"


def conclusions(rows: Sequence[Mapping[str, Any]]) -> tuple[list[Target], list[Reference]]:
    """Targets, and the names of the cases that miss one or come nearest to missing it."""
    beyond = [row for row in rows if row["upper"] == "beyond"]
    below = [row for row in rows if row["lower"] == "below"]
    at_saves = [row for row in rows if (row["saves_to_ends"] or 0.0) > AT_SAVES]
    low, high = ESTIMATE
    estimated = [row for row in rows if row["estimate_least"] is not None]
    off = [
        row for row in estimated if not low <= row["estimate_least"] <= row["estimate_most"] <= high
    ]
    largest_off = [row for row in estimated if not low <= row["estimate_of_largest"] <= high]
    targets = [
        Target("rows beyond 10 kappa + floor", len(beyond), "<=", 0),
        Target("rows below 1e-3 of the tolerance", len(below), "<=", 0),
        Target(
            "rows with errors at save times beyond twice those at step ends", len(at_saves), "<=", 0
        ),
        Target("rows with an estimate outside error / 3 to 100 errors", len(off), "<=", 0),
    ]
    largest = Reference(str(len(largest_off)), "rows whose largest error is estimated so badly")
    return targets, [*_named(rows, beyond, below, at_saves, off), largest, *_counts(rows)]


def _counts(rows: Sequence[Mapping[str, Any]]) -> list[Reference]:
    kinds = [row["lower"] for row in rows]
    return [
        Reference(str(kinds.count(kind)), f"rows of {len(rows)}: {text}")
        for kind, text in (
            ("within", "judged by the lower bound, and within it"),
            ("few steps", f"fewer than {STEPS} steps"),
            ("floor", "error within the floor of round-off"),
            ("exact", "exact: errors within the floor at every tolerance"),
        )
    ]


def _named(rows: Any, beyond: Any, below: Any, at_saves: Any, off: Any) -> list[Reference]:
    low, high = ESTIMATE
    small = [row for row in rows if row["lower"] in ("within", "below")]
    less = [row for row in off if not row["estimate_least"] >= low]
    more = [row for row in off if not row["estimate_most"] <= high]
    return [
        *_worst(rows, "of_bound", 1, beyond, "of 10 kappa + floor"),
        *_worst(small, "error", -1, below, "tolerances, the error"),
        *_worst(rows, "saves_to_ends", 1, at_saves, "of the error at step ends, that at saves"),
        *_worst(rows, "estimate_least", -1, less, "of the error, the estimate at least"),
        *_worst(rows, "estimate_most", 1, more, "of the error, the estimate at most"),
    ]


def _worst(rows: Any, column: str, sign: int, missed: Any, what: str) -> list[Reference]:
    """All cases that miss a target, and those nearest to missing it."""
    known = [row for row in rows if row[column] is not None]
    order = sorted(known, key=lambda row: -sign * row[column])
    return [
        Reference(f"{row[column]:.3g}", f"{what}: {_name(row)}" + ", MISSED" * (row in missed))
        for k, row in enumerate(order)
        if row in missed or k < WORST
    ]


def _name(row: Mapping[str, Any]) -> str:
    return f"{row['system']} ({row['start']}) to {row['rtol']:.0e}"
