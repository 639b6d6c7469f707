"""Timing of finished work, and what a benchmark reports."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Any, Literal, NamedTuple

import jax

BENCHMARKS = (
    "solve",
    "first-result",
    "batch",
    "gradient",
    "lowering",
    "constraints",
    "stability",
    "accuracy",
    "work-precision",
    "fuzz",
    "fits",
)

RUNS_PER_TURN = 3

Call = Callable[[], Any]


class Program(NamedTuple):
    """A compiled function, and what it took to get it."""

    call: Callable[..., Any]
    trace_s: float
    compile_s: float

    def cost(self) -> dict[str, float]:
        """The columns on compilation."""
        return {"trace_s": self.trace_s, "compile_s": self.compile_s}


@dataclass(frozen=True)
class Target:
    """A claim with its figure: judged."""

    claim: str
    figure: float
    relation: Literal[">=", "<="]
    bound: float

    @property
    def met(self) -> bool:
        """Whether the figure keeps the bound; nan does not."""
        return self.figure >= self.bound if self.relation == ">=" else self.figure <= self.bound


class Reference(NamedTuple):
    """A figure to read the rows by: not judged."""

    figure: str
    what: str


class Report(NamedTuple):
    """Rows with the same keys, units in the keys, and what is said of them.

    Attributes:
        shown: rows for the terminal, where all are too many.
    """

    rows: list[dict[str, Any]]
    targets: list[Target]
    references: list[Reference]
    shown: list[dict[str, Any]] | None = None


def build(function: Callable[..., Any], *args: Any) -> Program:
    """Compile `function` for arguments like `args`, without running it."""
    start = perf_counter()
    lowered = jax.jit(function).lower(*args)
    traced = perf_counter()
    call = lowered.compile()
    return Program(call, traced - start, perf_counter() - traced)


def seconds(call: Call) -> float:
    """How long until everything that `call` returns has been computed."""
    start = perf_counter()
    jax.block_until_ready(call())
    return perf_counter() - start


def interleaved(
    calls: Mapping[str, Call], rounds: int, budget_s: float = math.inf
) -> dict[str, list[float]]:
    """Seconds of every run after one to warm up.

    The calls take turns, so that whatever else the machine does hits all of them alike. A turn
    is three runs, as the first finds the caches full of another call's data. A call that has
    used up `budget_s` sits the remaining rounds out.
    """
    samples: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        jax.block_until_ready(call())
    for _ in range(rounds):
        for name, call in calls.items():
            if sum(samples[name]) < budget_s:
                samples[name] += [seconds(call) for _ in range(RUNS_PER_TURN)]
    return samples


def spread(samples: Sequence[float], unit: Literal["ms", "us"], lanes: int = 1) -> dict[str, Any]:
    """The columns on time, per lane."""
    scale = {"ms": 1e3, "us": 1e6}[unit] / lanes
    return {
        f"min_{unit}": min(samples) * scale,
        f"median_{unit}": median(samples) * scale,
        "repeats": len(samples),
    }
