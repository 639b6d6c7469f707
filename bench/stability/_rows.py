"""Rows of the benchmark `stability`: what is expected, what was found, and the verdict."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

import jaxlag as jl

OK = "ok"
TIGHT = {"rtol": 1e-12, "atol": 1e-12}


class Found(NamedTuple):
    """How a row ended: its figure, and the statuses of its motions in their order.

    Attributes:
        details: what the figure was made of, in words and numbers.
    """

    figure: float
    statuses: tuple[str, ...]
    details: str = ""


class Case(NamedTuple):
    """One row, with its bound written down before it was run.

    Attributes:
        name: what is stressed.
        figure: what the figure is, with its unit.
        bound: the figure must not exceed it where the status is ok.
        statuses: statuses other than ok that say what is singular; () where none is due.
        run: from `quick`.
        quick_bound: of a quick run, where fewer steps tell less.
    """

    name: str
    figure: str
    bound: float
    statuses: tuple[str, ...]
    run: Callable[[bool], Found]
    quick_bound: float | None = None

    def in_quick(self, quick: bool) -> "Case":
        """The row with the bound that holds for this run."""
        loose = quick and self.quick_bound is not None
        return self._replace(bound=self.quick_bound) if loose else self


class Rows:
    """A list of cases that functions add themselves to."""

    def __init__(self) -> None:
        self.cases: list[Case] = []

    def row(
        self,
        name: str,
        figure: str,
        bound: float,
        statuses: Sequence[str] = (),
        quick_bound: float | None = None,
    ) -> Callable[[Callable[[bool], Found]], Callable[[bool], Found]]:
        """A decorator: the function runs this row."""

        def added(run: Callable[[bool], Found]) -> Callable[[bool], Found]:
            self.cases.append(Case(name, figure, bound, tuple(statuses), run, quick_bound))
            return run

        return added


def names(status: Any) -> tuple[str, ...]:
    """Names of statuses."""
    return tuple(jl.Status(int(s)).name for s in np.ravel(np.asarray(status)))


def verdict(case: Case, found: Found) -> str:
    """What is to be said of a row.

    "within" and "named" are what was expected; "failed" ends in a status where none was due, or
    in another one; "silent" is a wrong answer with the status ok.
    """
    bad = sorted(set(found.statuses) - {OK})
    if bad:
        return "named" if set(bad) <= set(case.statuses) else "failed"
    if not found.figure <= case.bound:
        return "silent"
    return "within"


def run(system: jl.System, q0: Any, v0: Any, ts: Any, params: Any, **options: Any) -> jl.Solution:
    return jl.simulate(system, q0, v0, ts, params, throw=False, **options)


def energy_change(motion: jl.Solution, scale: float) -> Found:
    """The largest change of H, over `scale`."""
    change = np.max(np.abs(np.asarray(motion.energy) - float(motion.energy[0])))
    return Found(float(change) / scale, names(motion.status))


def difference(motion: jl.Solution, expected: Any, scale: float = 1.0) -> Found:
    """The largest error of q at the end, over `scale`."""
    error = np.max(np.abs(np.asarray(motion.q[-1]) - np.asarray(expected)))
    return Found(float(error) / scale, names(motion.status))


def must_end(motion: jl.Solution) -> Found:
    """There is no answer: ending well would be wrong."""
    return Found(np.inf, names(motion.status))
