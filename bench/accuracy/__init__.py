"""Accuracy: every system to 1e-4 ... 1e-11 against references of 20 digits or more.

A case is one motion to one tolerance, rtol = atol, by the method that `jl.simulate` chooses. With
w = atol + rtol |y|, kappa from `jl.lyapunov` and norms as there, the requirements are:

    |error / w| <= 10 kappa + floor, floor = 10 eps kappa sqrt(steps) |y / w|, at every time;
    |error / w| >= 1e-3 for the largest, from 20 steps on and above the floor;
    errors at save times at most twice those of motions that end there;
    estimates of the error between a third of it and 100 times it, above rounding.

The cases of a motion are called exact if the error is below the floor at every tolerance.
References come from `python -m bench._multiprecision.make_references`. A quick run takes a few
systems.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

import jaxlag as jl
from bench._harness.timing import Report
from bench._multiprecision.make_references import Reference, load
from bench.accuracy._verdict import NOTHING, Errors, conclusions, judged, name_exact, scaled
from systems.catalogue import ENTRIES

MOVING = tuple(name for name, entry in ENTRIES.items() if entry.kind == "trajectory")
TOLERANCES = tuple(10.0**-k for k in range(4, 12))
FINE = 1e-12  # tolerance of the motion for which the growth of perturbations is computed
ENDS_EVERY = 4  # one motion ends at every fourth save time
QUICK = ("simple_pendulum", "double_pendulum", "chaplygin_sleigh")


def run(quick: bool) -> Report:
    """All motions of all systems, one after the other."""
    rows = []
    for name in QUICK if quick else MOVING:
        params, references = load(name)
        for reference in references:
            rows += safely(name, params, reference, TOLERANCES[::3] if quick else TOLERANCES)
        jax.clear_caches()  # programs of this system: large and not needed again
    return Report(rows, *conclusions(rows))


def safely(
    name: str, params: Any, reference: Reference, tolerances: Sequence[float]
) -> list[dict[str, Any]]:
    """The table rows of one motion; if it raises an error they are beyond all bounds."""
    try:
        return rows_of(name, params, reference, tolerances)
    except Exception as error:
        about = {"system": name, "start": reference.start, "exponent": math.nan}
        about |= {"grows": f"raised {type(error).__name__}: {error}"[:200]}
        return [about | {"rtol": rtol} | judged(NOTHING) for rtol in tolerances]


def rows_of(
    name: str, params: Any, reference: Reference, tolerances: Sequence[float]
) -> list[dict[str, Any]]:
    """The table rows of one motion."""
    motion = Run(name, params, reference)
    growth = jl.lyapunov(motion.to(FINE))  # with weights atol = rtol, as in the cases
    kappa = np.asarray(growth.kappa)[1:]
    rows = []
    for rtol in tolerances:
        about = {"system": name, "start": reference.start, "exponent": float(growth.exponent)}
        about |= {"grows": "exponentially" if bool(growth.exponential) else "as a power"}
        rows.append(about | {"rtol": rtol} | judged(motion.errors(rtol, kappa)))
    name_exact(rows)
    return rows


class Run:
    """A reference motion, solved to several tolerances."""

    def __init__(self, name: str, params: Any, reference: Reference) -> None:
        self.system, self.reference = ENTRIES[name].system, reference
        self.params = {
            key: np.asarray(value, float) if isinstance(value, list) else value
            for key, value in params.items()
        }

    def to(self, tolerance: float, until: int = -1, **options: Any) -> jl.Solution:
        """Solve to this tolerance, from the start to time `until` of the reference.

        The solution has as many save times as the reference.
        """
        q0, v0 = np.split(self.reference.y[0], 2)
        times = self.reference.times
        if until != -1:
            times = np.linspace(times[0], times[until], len(times))
        return jl.simulate(
            self.system,
            q0,
            v0,
            times,
            self.params,
            rtol=tolerance,
            atol=tolerance,
            throw=False,
            **options,
        )

    def errors(self, rtol: float, kappa: np.ndarray) -> Errors:
        """The errors to be judged."""
        motion = self.to(rtol, estimate_error=True)
        exact = self.reference.y[1:]
        saves = scaled(_state(motion.q, motion.v)[1:] - exact, exact, rtol, rtol)
        assert motion.error is not None
        chosen = np.arange(len(exact))[ENDS_EVERY - 1 :: ENDS_EVERY]
        return Errors(
            saves=saves,
            ends=np.array(list(self._ends(rtol, chosen))),
            saves_at_ends=saves[chosen],
            estimates=scaled(_state(*motion.error)[1:], exact, rtol, rtol),
            size=scaled(exact, exact, rtol, rtol),
            kappa=kappa,
            steps=int(motion.stats["accepted"]),
        )

    def _ends(self, rtol: float, chosen: np.ndarray) -> Iterator[float]:
        """Scaled errors of motions that end at these save times."""
        for save in chosen + 1:
            last = save == len(self.reference.times) - 1
            motion = self.to(rtol, until=-1 if last else int(save))
            found, exact = _state(motion.q, motion.v)[-1], self.reference.y[save]
            yield float(scaled(found - exact, exact, rtol, rtol))


def _state(q: Any, v: Any) -> np.ndarray:
    return np.concatenate([np.asarray(q), np.asarray(v)], axis=-1)
