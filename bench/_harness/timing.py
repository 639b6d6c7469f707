"""Timing of completed computations, and the report of a benchmark."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Any, Literal, NamedTuple

import jax

BENCHMARKS = (
    "solve",
    "calls",
    "first-result",
    "batch",
    "gradient",
    "lowering",
    "mechanisms",
    "analysis",
    "constraints",
    "stability",
    "accuracy",
    "work-precision",
    "fuzz",
    "fits",
)

RUNS_PER_ROUND = 3

Call = Callable[[], Any]


class Program(NamedTuple):
    """A compiled function, with the times to trace and to compile it."""

    call: Callable[..., Any]
    trace_s: float
    compile_s: float

    def cost(self) -> dict[str, float]:
        """The columns about compilation."""
        return {"trace_s": self.trace_s, "compile_s": self.compile_s}


@dataclass(frozen=True)
class Target:
    """A claim with its measured figure and its bound; judged."""

    claim: str
    figure: float
    relation: Literal[">=", "<="]
    bound: float

    @property
    def met(self) -> bool:
        """Whether the figure satisfies the bound; nan does not."""
        return self.figure >= self.bound if self.relation == ">=" else self.figure <= self.bound


class Reference(NamedTuple):
    """A figure for comparison with the table rows; not judged."""

    figure: str
    what: str


class Report(NamedTuple):
    """Table rows with the same keys, which name the units, and the targets and references.

    Attributes:
        shown: table rows for the terminal, if all of them are too many.
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
    """Seconds until all results of `call` have been computed."""
    start = perf_counter()
    jax.block_until_ready(call())
    return perf_counter() - start


def interleaved(
    calls: Mapping[str, Call], rounds: int, budget_s: float = math.inf
) -> dict[str, list[float]]:
    """Seconds of every run after one warm-up run.

    The calls alternate, so that other load of the machine affects all of them equally. In a round,
    each call runs three times, because in its first run the caches hold the data of another call.
    A call that has used `budget_s` is left out of the remaining rounds.
    """
    samples: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        jax.block_until_ready(call())
    for _ in range(rounds):
        for name, call in calls.items():
            if sum(samples[name]) < budget_s:
                samples[name] += [seconds(call) for _ in range(RUNS_PER_ROUND)]
    return samples


def spread(samples: Sequence[float], unit: Literal["ms", "us"], lanes: int = 1) -> dict[str, Any]:
    """The columns about time, per lane."""
    scale = {"ms": 1e3, "us": 1e6}[unit] / lanes
    return {
        f"min_{unit}": min(samples) * scale,
        f"median_{unit}": median(samples) * scale,
        "repeats": len(samples),
    }
