"""Figures, targets and references from the table rows of the benchmark `lowering`."""

from collections.abc import Callable, Mapping, Sequence
from math import exp, log
from typing import Any

from bench._harness.timing import Reference, Target

LIBRARIES = ("numba", "MuJoCo", "Pinocchio")
OPERATIONS = {"top": 85, "rigid_body": 85, "aircraft": 410, "chain_8": 720}  # at most
SOLVE_MS = {"on": 0.13, "off": 0.15}

Row = Mapping[str, Any]


class Figures:
    """Figures from the table rows, by the kind of comparison; empty if there are no rows."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self.rows = rows

    def of(self, part: str, **wanted: Any) -> list[Row]:
        """The table rows of one part with these entries."""
        return [
            row
            for row in self.rows
            if row["part"] == part and all(row[key] == value for key, value in wanted.items())
        ]

    def ratios(self, admitted: Callable[[str], bool]) -> dict[str, float]:
        """Time of jaxlag divided by that of the fastest admitted contender, by system."""
        found: dict[str, float] = {}
        for row in self.of("evaluation"):
            if admitted(row["contender"]):
                found[row["system"]] = max(found.get(row["system"], 0.0), 1.0 / row["ratio"])
        return found

    def gains(self, part: str, sizes: Sequence[int]) -> list[float]:
        """Time of the array program over that of the scalar one, for systems of these sizes."""
        return [row["ratio"] for row in self.of(part, contender="array") if row["n"] in sizes]

    def libraries(self) -> dict[int, tuple[float, str]]:
        """(time of jaxlag over that of the fastest library, its name), by the length of chain."""
        found: dict[int, tuple[float, str]] = {}
        for row in self.of("chain"):
            if row["contender"] in LIBRARIES:
                new = (1.0 / row["ratio"], row["contender"])
                found[row["n"]] = max(found.get(row["n"], (0.0, "")), new)
        return found


def is_peer(contender: str) -> bool:
    """Whether jaxlag is judged against it: plain code by hand or by sympy."""
    return is_any_peer(contender) and not contender.endswith("called")


def is_any_peer(contender: str) -> bool:
    return contender.startswith(("by hand", "sympy"))


def mean(ratios: Mapping[str, float]) -> float:
    """Geometric mean."""
    return exp(sum(map(log, ratios.values())) / len(ratios))


def verdict(
    rows: Sequence[Row], operations: Mapping[str, int | None], missing: Sequence[str]
) -> tuple[list[Target], list[Reference]]:
    """Targets and references of all parts that have table rows."""
    figures = Figures(rows)
    targets: list[Target] = []
    references = [Reference("left out", f"{name}: cannot be imported") for name in missing]
    for judge in (_evaluation, _chains, _compilation, _solves):
        more, found = judge(figures)
        targets += more
        references += found
    for name, bound in OPERATIONS.items():
        count = operations[name]
        figure = float("nan") if count is None else float(count)
        targets.append(Target(f"operations of {name}", figure, "<=", float(bound)))
    return targets, references


def _evaluation(figures: Figures) -> tuple[list[Target], list[Reference]]:
    ratios = figures.ratios(is_peer)
    what = "jaxlag as the best of hand-written and sympy"
    targets = [
        Target(f"times as long: {what}, mean of {len(ratios)}", mean(ratios), "<=", 1.0),
        Target(f"times as long: {what}, worst ({_worst(ratios)})", max(ratios.values()), "<=", 1.3),
    ]
    faster = "times faster: the scalar than the array program"
    for label, part, sizes, bound in (
        ("n = 1", "evaluation", (1,), 1.0),
        ("least for n = 2 to 4", "evaluation", (2, 3, 4), 20.0),
        ("chain of 8", "chain", (8,), 5.0),
    ):
        gains = figures.gains(part, sizes)
        if gains:
            targets.append(Target(f"{faster}, {label}", min(gains), ">=", bound))
    references = []
    for label, admitted in (
        ("hand-written code alone", lambda name: name == "by hand"),
        ("sympy alone", lambda name: name.startswith("sympy") and is_peer(name)),
        ("the best of both, theirs also called", is_any_peer),
    ):
        some = figures.ratios(admitted)
        if some:
            text = f"times as long: jaxlag as {label}, mean of {len(some)}; worst {_worst(some)}"
            references.append(Reference(f"{mean(some):.3g}; {max(some.values()):.3g}", text))
    return targets, references


def _worst(ratios: Mapping[str, float]) -> str:
    return max(ratios, key=lambda name: ratios[name])


def _chains(figures: Figures) -> tuple[list[Target], list[Reference]]:
    found = figures.libraries()
    near = {n: ratio for n, (ratio, _) in found.items() if n <= 16}
    targets = []
    if near:
        n = max(near, key=lambda n: near[n])
        label = f"times as long: jaxlag as its best neighbour, worst of n <= 16 (n = {n})"
        targets.append(Target(label, near[n], "<=", 1.0))
    references = [
        Reference(f"{ratio:.3g}", f"times as long: jaxlag as {name}, chain of {n}")
        for n, (ratio, name) in found.items()
    ]
    return targets, references


def _compilation(figures: Figures) -> tuple[list[Target], list[Reference]]:
    seconds = {row["system"]: row["trace_s"] + row["compile_s"] for row in figures.of("compile")}
    long = seconds.pop("chain_12", None)
    what = "s to derive and compile a solve"
    targets = [
        Target(f"{what}, worst of n <= 4 ({_worst(seconds)})", max(seconds.values()), "<=", 1.5)
    ]
    if long is not None:
        targets.append(Target(f"{what}, chain of 12", long, "<=", 4.0))
    return targets, []


def _solves(figures: Figures) -> tuple[list[Target], list[Reference]]:
    targets = []
    for row in figures.of("solve"):
        setting = "on" if "setting on" in row["contender"] else "off"
        label = f"ms: double pendulum to 1e-9, setting {setting}"
        targets.append(Target(label, row["min_us"] / 1e3, "<=", SOLVE_MS[setting]))
    return targets, []
