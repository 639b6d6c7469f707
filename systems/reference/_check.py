"""Replay of reference files: all values of a case are computed from its initial data."""

import sys
from collections.abc import Mapping, Sequence
from functools import partial, singledispatch
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from systems.catalogue._entry import AbstractEntry, Entry, PrescribedEntry, StaticEntry
from systems.reference._cases import Case
from systems.reference._files import load
from systems.reference._json_fields import InvalidReference
from systems.reference._quantities import file_quantities, prescribed_quantities, static_quantities

LOCAL_ERROR = 1e-13
"""Tolerance rtol = atol of the simulation, per step."""

STATE_TOLERANCE = 1e-10
"""Largest |x - reference| / (1 + |reference|) of q, v, u, energies, invariants, states of rest."""

DERIVED_TOLERANCE = 1e-9
"""The same for accelerations, reactions, extras and other values computed from the states."""


class Motion(NamedTuple):
    """The replay of a case: name -> values, shape (S, ...), and the status at its end."""

    values: Mapping[str, Array]
    status: Array
    last_time: Array


class Deviation(NamedTuple):
    """The worst time of one field: |x - reference| / (1 + |reference|), largest component."""

    field: str
    time_index: int
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
        return f"{self.size:.1e} of {self.tolerance:.0e} in {self.field}, row {self.time_index}"


def replay(entry: Entry, params: Mapping[str, Any], times: Any, q0: Any, v0: Any) -> Motion:
    """Simulate from (q0, v0) and evaluate every quantity of reference files at `times`.

    Args:
        entry: the system, with k coordinates in reference files.
        params: parameter name -> value.
        times: shape (S,), s; the first is the time of the start.
        q0: coordinates at the start, shape (k,).
        v0: generalized velocities at the start, shape (k,).
    """
    if entry.chart is not None:
        q0, v0 = entry.chart.state(times[0], q0, v0, params)
    if len(times) == 1:
        values = _quantities(entry, params, times, q0[None], v0[None])
        return Motion(values, jnp.int32(jl.Status.ok), times[0])
    motion = jl.simulate(
        entry.system, q0, v0, times, params, rtol=LOCAL_ERROR, atol=LOCAL_ERROR, throw=False
    )
    values = _quantities(entry, params, times, motion.q, motion.v)
    return Motion(values, motion.status, motion.last_time)


@partial(jax.jit, static_argnums=0)
def _quantities(
    entry: Entry, params: Mapping[str, Array], times: Array, q: Array, v: Array
) -> Mapping[str, Array]:
    return jax.vmap(partial(file_quantities, entry, params))(times, q, v)


@partial(jax.jit, static_argnums=0)
def replay_rest(entry: StaticEntry, params: Mapping[str, Array]) -> Motion:
    """Find the state of rest; the values have one entry."""
    rest = entry.rest(params)
    values = static_quantities(entry, params, rest)
    return Motion({name: x[None] for name, x in values.items()}, rest.status, jnp.zeros(()))


@partial(jax.jit, static_argnums=0)
def replay_prescribed(
    entry: PrescribedEntry, params: Mapping[str, Array], times: Array, q: Array, v: Array, a: Array
) -> Motion:
    """The forces required for the motion (q, v, a), each (S, n), at `times`.

    q, v and a in the result are computed from the entry's own motion.
    """
    values = jax.vmap(partial(prescribed_quantities, entry, params))(times, q, v, a)
    law = jl.prescribed_motion(lambda t: entry.motion(t, params), times)
    values |= dict(zip(("q", "v", "a"), law, strict=True))
    return Motion(values, jnp.int32(jl.Status.ok), times[-1])


@singledispatch
def replay_case(entry: AbstractEntry, case: Case) -> Motion:
    """Replay a case from its initial data.

    These are, for a motion, the parameters, the times and the first q and v; for a state of rest
    the parameters; for a prescribed motion all of q, v and a.
    """
    raise NotImplementedError(f"cases of {entry.kind} systems cannot be replayed")


@replay_case.register
def _(entry: Entry, case: Case) -> Motion:
    return replay(entry, case.params, case.times, case.fields["q"][0], case.fields["v"][0])


@replay_case.register
def _(entry: StaticEntry, case: Case) -> Motion:
    return replay_rest(entry, case.params)


@replay_case.register
def _(entry: PrescribedEntry, case: Case) -> Motion:
    motion = (case.fields[name] for name in "qva")
    return replay_prescribed(entry, case.params, case.times, *motion)


def compare(case: Case, values: Mapping[str, Array]) -> list[Deviation]:
    """The worst deviation of every field of the case from the replayed values."""
    deviations = []
    for field, reference in case.fields.items():
        tolerance = DERIVED_TOLERANCE if _is_derived(field) else STATE_TOLERANCE
        relative = np.abs(np.asarray(values[field]) - reference) / (1 + np.abs(reference))
        by_time = relative.reshape(len(case.times), -1).max(axis=1)
        index = int(np.argmax(by_time))  # the first NaN, if there is one
        deviations.append(Deviation(field, index, float(by_time[index]), tolerance))
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
        jax.clear_caches()  # programs are not shared by files, and all of them take gigabytes
    verdicts = [f"{failed} out of tolerance" if failed else "all within tolerance"] * bool(cases)
    verdicts += [f"{refused} refused"] * bool(refused)
    print(f"files {len(paths)}, cases {cases}: {', '.join(verdicts)}")
    return 1 if failed or refused else 0


def _report(path: Path, entry: AbstractEntry, case: Case) -> bool:
    motion = replay_case(entry, case)
    deviations = compare(case, motion.values)
    status = jl.Status(int(motion.status))
    outside = [deviation.field for deviation in deviations if not deviation.ok]
    ok = status == jl.Status.ok and not outside
    finding = f"worst {max(deviations, key=lambda deviation: deviation.severity)}"
    if outside:
        finding += f"; out of tolerance: {', '.join(outside)}"
    if status != jl.Status.ok:
        when = f" at t = {float(motion.last_time):g} s" if entry.kind == "trajectory" else ""
        finding = f"ended with {status.name}{when}; {finding}"
    verdict = "ok  " if ok else "FAIL"
    print(f"{verdict}  {path.name:<42} {case.name:<12} {finding}", flush=True)
    return ok


def _is_derived(field: str) -> bool:
    reactions = ("lambda", "constraint_force", "generalized_force")
    return field in ("a", *reactions) or field.startswith("extras.")
