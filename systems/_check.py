"""Replay of reference files: simulate from the first row, then compare every number."""

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from systems._entry import Entry
from systems._quantities import quantities
from systems._reference import Case, InvalidReference, load

LOCAL_ERROR = 1e-13
"""Tolerance rtol = atol of the simulation, per step."""

STATE_TOLERANCE = 1e-10
"""Largest |x - reference| / (1 + |reference|) of q, v, energies and invariants."""

DERIVED_TOLERANCE = 1e-9
"""The same for accelerations, extras and everything else found from the state."""


class Motion(NamedTuple):
    """A replayed motion: name -> rows, shape (S, ...), and how the simulation ended."""

    rows: Mapping[str, Array]
    status: Array
    last_time: Array


class Deviation(NamedTuple):
    """Worst row of one field: |x - reference| / (1 + |reference|), the largest component."""

    field: str
    row: int
    size: float
    tolerance: float

    @property
    def ok(self) -> bool:
        """Whether the field is within its tolerance; NaN is not."""
        return self.size <= self.tolerance

    @property
    def severity(self) -> float:
        """Size in units of the tolerance, infinite for NaN."""
        return np.inf if np.isnan(self.size) else self.size / self.tolerance

    def __str__(self) -> str:
        """E.g. `2.1e-14 of 1e-10 in energy.T, row 3`."""
        return f"{self.size:.1e} of {self.tolerance:.0e} in {self.field}, row {self.row}"


@partial(jax.jit, static_argnums=0)
def replay(entry: Entry, params: Mapping[str, Array], times: Array, q0: Array, v0: Array) -> Motion:
    """Simulate from (q0, v0) and evaluate every quantity at `times`.

    Args:
        entry: the system, n coordinates.
        params: parameter name -> value.
        times: shape (S,), s; the first is the time of the start.
        q0: coordinates at the start, shape (n,).
        v0: generalized velocities at the start, shape (n,).
    """
    evaluate = jax.vmap(partial(quantities, entry, params))
    if len(times) == 1:
        ok = jnp.int32(jl.Status.ok)
        return Motion(evaluate(times, q0[None], v0[None]), ok, times[0])
    motion = jl.simulate(
        entry.system, q0, v0, times, params, rtol=LOCAL_ERROR, atol=LOCAL_ERROR, throw=False
    )
    rows = evaluate(times, motion.q, motion.v)
    return Motion(rows, motion.status, motion.last_time)


def replay_case(entry: Entry, case: Case) -> Motion:
    """Replay a case from its parameters, its times and its first row of q and v alone."""
    return replay(entry, case.params, case.times, case.fields["q"][0], case.fields["v"][0])


def compare(case: Case, rows: Mapping[str, Array]) -> list[Deviation]:
    """The worst deviation of every field of the case from the replayed rows."""
    deviations = []
    for field, reference in case.fields.items():
        tolerance = STATE_TOLERANCE if _is_state(field) else DERIVED_TOLERANCE
        relative = np.abs(np.asarray(rows[field]) - reference) / (1 + np.abs(reference))
        by_row = relative.reshape(len(case.times), -1).max(axis=1)
        row = int(np.argmax(by_row))  # the first NaN, if there is one
        deviations.append(Deviation(field, row, float(by_row[row]), tolerance))
    return deviations


def main(paths: Sequence[Path]) -> int:
    """Check the files and report; 0 if every number of every case is within tolerance."""
    cases = failed = refused = 0
    for path in paths:
        try:
            reference = load(path)
        except InvalidReference as error:
            print(f"{path}: {error}", file=sys.stderr, flush=True)
            refused += 1
            continue
        cases += len(reference.cases)
        failed += sum(not _report(path, reference.entry, case) for case in reference.cases)
    verdicts = [f"{failed} out of tolerance" if failed else "all within tolerance"] * bool(cases)
    verdicts += [f"{refused} refused"] * bool(refused)
    print(f"files {len(paths)}, cases {cases}: {', '.join(verdicts)}")
    return 1 if failed or refused else 0


def _report(path: Path, entry: Entry, case: Case) -> bool:
    motion = replay_case(entry, case)
    deviations = compare(case, motion.rows)
    status = jl.Status(int(motion.status))
    outside = [deviation.field for deviation in deviations if not deviation.ok]
    ok = status == jl.Status.ok and not outside
    finding = f"worst {max(deviations, key=lambda deviation: deviation.severity)}"
    if outside:
        finding += f"; out of tolerance: {', '.join(outside)}"
    if status != jl.Status.ok:
        finding = f"ended with {status.name} at t = {float(motion.last_time):g} s; {finding}"
    verdict = "ok  " if ok else "FAIL"
    print(f"{verdict}  {path.name:<30} {case.name:<12} {finding}", flush=True)
    return ok


def _is_state(field: str) -> bool:
    return field in ("q", "v") or field.startswith(("energy.", "invariants."))
