"""Lines of a work-precision diagram: one method at many tolerances or steps."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from time import perf_counter
from typing import Any, NamedTuple

import jax

from bench._harness.timing import Call, seconds

CLOSE = 3e-14  # an error below which the sweep ends
WRONG = 0.1  # larger errors are not recorded
ROUNDED = 1e-8  # errors below this may be limited by rounding
PATIENCE = 3  # successive values without progress, after which rounding limits the error
FACTOR = 4  # by which a first run may exceed the patience, because it may compile


class Solved(NamedTuple):
    """The result of one run.

    Attributes:
        q: final coordinates; nan if the end was not reached.
        steps: accepted steps; None if unknown.
    """

    q: Any
    steps: int | None = None


class Line(NamedTuple):
    """One way to solve a motion.

    Attributes:
        knob: "tolerance" or "step" (in s).
        knobs: its values, from loose to tight.
        make: function of one value that returns a call for one solve.
        read: function of the call's return value that gives the result.
        build_s: seconds to build the line, including compilation; `make` may take more.
        messages: of failed runs; each failure adds one.
    """

    knob: str
    knobs: Sequence[float]
    make: Callable[[float], Call]
    read: Callable[[Any], Solved]
    build_s: float
    messages: Sequence[str] = ()

    def why_none(self, patience_s: float) -> str:
        """The reason why a line has no points."""
        if self.messages:
            return self.messages[-1]
        return f"no run of at most {FACTOR * patience_s:g} s ended with an error below {WRONG:g}"


def tolerances(loosest: float = 2.5, tightest: float = 14.0, each: float = 0.5) -> list[float]:
    """Powers of ten from 10^-loosest on."""
    count = round((tightest - loosest) / each) + 1
    return [10.0 ** -(loosest + each * i) for i in range(count)]


def steps(t1: float, fewest: int, most: int) -> list[float]:
    """Step lengths that divide the span into a whole number of steps, `fewest` or more."""
    counts = [fewest * 2**i for i in range(32)]
    return [t1 / count for count in counts if count <= most]


def built(make: Callable[[], Line]) -> Line:
    """The line, with the time to build it."""
    start = perf_counter()
    line = make()
    return line._replace(build_s=line.build_s + perf_counter() - start)


def swept(
    line: Line, error: Callable[[Any], float], patience_s: float
) -> tuple[dict[str, Call], list[dict[str, Any]]]:
    """Calls by the values of the knob, and their points before timing.

    The sweep ends when rounding limits the error, or after the first run longer than `patience_s`.
    Points contain the times of the two runs made here: `swept_s`.
    """
    calls: dict[str, Call] = {}
    points: list[dict[str, Any]] = []
    best, idle = math.inf, 0
    for value in line.knobs:
        start = perf_counter()
        call = line.make(value)
        made = perf_counter() - start
        start = perf_counter()
        solved = line.read(jax.block_until_ready(call()))
        first = perf_counter() - start
        if first > FACTOR * patience_s:
            break
        again = seconds(call)
        found = error(solved.q)
        if found < WRONG:  # False for nan
            calls[f"{value:.3g}"] = call
            points.append(
                {
                    "knob": line.knob,
                    "value": value,
                    "error": found,
                    "steps": solved.steps,
                    "compile_s": line.build_s + made,
                    "swept_s": [first, again],
                }
            )
        if found < 0.7 * best:
            best, idle = found, 0
        elif best < ROUNDED:
            idle += 1
        if best < CLOSE or idle == PATIENCE or again > patience_s:
            break
    return calls, points


def time_at(points: Iterable[Mapping[str, Any]], error: float, column: str) -> float | None:
    """Least time in which the line reaches an error; None if it does not.

    Between two adjacent points of the line that enclose the error, times are interpolated in
    logarithms. If the error of the loosest point is smaller, its time is used.
    """
    line = [(point["error"], point[column]) for point in points]
    found = [line[0][1]] if line and line[0][0] <= error else []
    for (loose, fast), (tight, slow) in pairwise(line):
        if loose > error >= tight:
            part = math.log(loose / error) / math.log(loose / max(tight, 1e-300))
            found.append(fast * (slow / fast) ** part)
    return min(found, default=None)
