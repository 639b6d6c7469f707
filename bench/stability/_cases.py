"""Cases of the benchmark `stability`: the expected result, the computed one, and the verdict."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

import jaxlag as jl

OK = "ok"
TIGHT = {"rtol": 1e-12, "atol": 1e-12}


class Found(NamedTuple):
    """The result of a case: its figure, and the statuses of its motions in order.

    Attributes:
        details: the numbers behind the figure, as text.
    """

    figure: float
    statuses: tuple[str, ...]
    details: str = ""


class Case(NamedTuple):
    """One case, with a bound written down before it was run.

    Attributes:
        name: of the case.
        figure: name of the figure, with its unit.
        bound: the figure must not exceed it if the status is ok.
        statuses: expected statuses that name the singularity; () if ok is expected.
        run: function of `quick` that runs the case.
        quick_bound: bound for a quick run, which is less accurate with fewer steps.
    """

    name: str
    figure: str
    bound: float
    statuses: tuple[str, ...]
    run: Callable[[bool], Found]
    quick_bound: float | None = None

    def in_quick(self, quick: bool) -> "Case":
        """The case with the bound for this run."""
        loose = quick and self.quick_bound is not None
        return self._replace(bound=self.quick_bound) if loose else self


class Cases:
    """A list of cases, filled by a decorator."""

    def __init__(self) -> None:
        self.cases: list[Case] = []

    def add(
        self,
        name: str,
        figure: str,
        bound: float,
        statuses: Sequence[str] = (),
        quick_bound: float | None = None,
    ) -> Callable[[Callable[[bool], Found]], Callable[[bool], Found]]:
        """A decorator that adds a case; the function runs it."""

        def added(run: Callable[[bool], Found]) -> Callable[[bool], Found]:
            self.cases.append(Case(name, figure, bound, tuple(statuses), run, quick_bound))
            return run

        return added


def names(status: Any) -> tuple[str, ...]:
    """Names of statuses."""
    return tuple(jl.Status(int(s)).name for s in np.ravel(np.asarray(status)))


def verdict(case: Case, found: Found) -> str:
    """The verdict on a case.

    "within" and "named" are expected results. "failed" is a status other than ok that is not among
    the expected ones. "silent" is a wrong result with the status ok.
    """
    failures = sorted(set(found.statuses) - {OK})
    if failures:
        return "named" if set(failures) <= set(case.statuses) else "failed"
    if not found.figure <= case.bound:
        return "silent"
    return "within"


def run(system: jl.System, q0: Any, v0: Any, ts: Any, params: Any, **options: Any) -> jl.Solution:
    return jl.simulate(system, q0, v0, ts, params, throw=False, **options)


def energy_change(motion: jl.Solution, scale: float) -> Found:
    """The largest change of H, divided by `scale`."""
    change = np.max(np.abs(np.asarray(motion.energy) - float(motion.energy[0])))
    return Found(float(change) / scale, names(motion.status))


def difference(motion: jl.Solution, expected: Any, scale: float = 1.0) -> Found:
    """The largest error of the final q, divided by `scale`."""
    error = np.max(np.abs(np.asarray(motion.q[-1]) - np.asarray(expected)))
    return Found(float(error) / scale, names(motion.status))


def must_end(motion: jl.Solution) -> Found:
    """For a problem without solution: the status ok would be wrong."""
    return Found(np.inf, names(motion.status))
