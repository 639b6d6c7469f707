"""Constraint drift over a million steps: residuals, energy, and time per step of stabilization.

The cases are two linkages (bench/_problems/mechanisms.py) and two rolling systems. The linkages
have both formulations with multipliers, each without stabilization ("none"), with Baumgarte's
damping and with projection. The rolling systems have multipliers without and with projection, and
quasi-velocities, in which the constraints cannot drift. Steps are fixed: 0.01 s of order 8.
Baumgarte's alpha = beta = 0.1 / step damp residuals critically, over ten steps.

A quick run has 20 000 steps. It takes the first linkage by multipliers without Baumgarte's
damping, and the first rolling system. Most of its time is compilation.

Tumbling motions are chaotic and soon differ between the cases. So the benchmark compares quantities
that should be constant, at 1001 save times (quick: 201) evenly over the run. They are nan if a run
failed. The columns are:

`position`: the largest |phi_k| / |A_k| of any constraint row k. This is about the distance from the
constraint, in m (double pendulum) or rad (four-bar); 0 without phi.
`growth`: `position` divided by its value for the first tenth of the run.
`velocity`: the largest |A v + b|_k / |A_k|, in m/s or rad/s.
`energy`: the largest |H - H0| / T0, where T0 is the initial kinetic energy.
`slope`: slope of a line through the second half of (H - H0) / T0, per million steps.
`min_us`, `median_us`: time per step.
`ratio`: min_us divided by that of "none" with the same mechanism and formulation, for
quasi-velocities by that of multipliers with projection.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench._harness import results
from bench._harness.timing import Program, Reference, Report, Target, build, interleaved, spread
from bench._problems.mechanisms import LINKAGES, ROLLING, Mechanism
from bench.constraints import _drift_plot

STEP = 0.01  # s
METHOD = "dopri8"
GAIN = 0.1 / STEP  # 1/s
NONE, BAUMGARTE, PROJECTION = "none", "Baumgarte", "projection"
STABILIZATIONS = {NONE: None, BAUMGARTE: jl.Baumgarte(GAIN, GAIN), PROJECTION: "projection"}
FORMULATIONS = ("multipliers", "null_space")
QUASI = "quasi"
STEPS, SAVES = 1_000_000, 1001
QUICK_STEPS, QUICK_SAVES = 20_000, 201

Row = dict[str, Any]


class Case(NamedTuple):
    """One case; its fields are columns of the table and of stored runs."""

    mechanism: str
    formulation: str
    stabilisation: str


def cases(quick: bool) -> list[Case]:
    """All cases that are compared."""
    linkages, rolling = list(LINKAGES), list(ROLLING)
    forms, ways = list(FORMULATIONS), list(STABILIZATIONS)
    if quick:
        linkages, rolling, forms, ways = linkages[:1], rolling[:1], forms[:1], [NONE, PROJECTION]
    found = [Case(*each) for each in product(linkages, forms, ways)]
    for name in rolling:
        found += [Case(name, forms[0], way) for way in (NONE, PROJECTION)]
        found.append(Case(name, QUASI, NONE))
    return found


class Record(NamedTuple):
    """One run at its save times: the columns of the same names before the largest is taken.

    Attributes:
        steps: number of steps before each save time.
        position: largest |phi_k| / |A_k|.
        velocity: largest |A v + b|_k / |A_k|.
        energy: (H - H0) / T0.
    """

    steps: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    energy: np.ndarray

    @property
    def complete(self) -> bool:
        """Whether the run reached its end."""
        return all(np.isfinite(each).all() for each in self)


def run(quick: bool) -> Report:
    """All cases: recorded one after the other, timed in turn."""
    steps, saves = (QUICK_STEPS, QUICK_SAVES) if quick else (STEPS, SAVES)
    compared = cases(quick)
    starts = LINKAGES | ROLLING
    mechanisms = {name: starts[name]() for name in dict.fromkeys(c.mechanism for c in compared)}
    calls, programs, records = {}, {}, {}
    for case in compared:
        mechanism = mechanisms[case.mechanism]
        programs[case] = program = compiled(mechanism, case, steps, saves)
        calls[", ".join(case)] = call = partial(program.call, mechanism.q0, mechanism.v0)
        q, v = call()
        records[case] = record(mechanism, q, v, steps)
    samples = interleaved(calls, 8, budget_s=1.0 if quick else 8.0)
    found = {
        case: {
            **case._asdict(),
            **figures(records[case]),
            **programs[case].cost(),
            **times(samples[", ".join(case)], records[case]),
        }
        for case in compared
    }
    for case, row in found.items():
        row["ratio"] = row["min_us"] / found[against(case)]["min_us"]
    targets, references = judged(list(found.values()))
    folder = results.FOLDER / "quick" if quick else results.FOLDER
    references.append(Reference(_drift_plot.save(records, folder / "constraints.png"), "curves"))
    return Report(list(found.values()), targets, references)


def against(case: Case) -> Case:
    """The case whose time per step is the reference for this case."""
    if case.formulation == QUASI:
        return Case(case.mechanism, FORMULATIONS[0], PROJECTION)
    return case._replace(stabilisation=NONE)


def compiled(mechanism: Mechanism, case: Case, steps: int, saves: int) -> Program:
    """(q0, v0) -> (q, v) at times evenly over `steps` steps; nan after a failure."""
    ts = np.linspace(0.0, steps * STEP, saves)

    def solve(q0: Array, v0: Array) -> tuple[Array, Array]:
        motion = jl.simulate(
            mechanism.system,
            q0,
            v0,
            ts,
            mechanism.params,
            method=METHOD,
            dt=STEP,
            max_steps=steps + 1,  # step times are rounded: a short last step may remain
            formulation=case.formulation,
            stabilization=STABILIZATIONS[case.stabilisation],
            throw=False,
        )
        return motion.q, motion.v

    return build(solve, mechanism.q0, mechanism.v0)


def record(mechanism: Mechanism, q: Array, v: Array, steps: int) -> Record:
    """Record of states (q, v), the first at the start and the last after `steps` steps."""

    def residuals(q: Array, v: Array) -> tuple[Array, Array]:
        position, velocity = mechanism.system.residuals(q, v, mechanism.params)
        rates = jnp.concatenate([jnp.ravel(x) for x in velocity.values()])
        if not position:  # rows without phi
            return jnp.zeros_like(rates), rates
        return jnp.concatenate([jnp.ravel(x) for x in position.values()]), rates

    @jax.jit
    @jax.vmap
    def each(q: Array, v: Array) -> tuple[Array, Array, Array]:
        A = jax.jacfwd(lambda v: residuals(q, v)[1])(v)
        position, velocity = (
            jnp.max(jnp.abs(x) / jnp.linalg.norm(A, axis=1)) for x in residuals(q, v)
        )
        return position, velocity, mechanism.system.energy(q, v, mechanism.params)

    position, velocity, H = (np.asarray(x) for x in each(q, v))
    return Record(
        np.linspace(0.0, steps, len(H)), position, velocity, (H - H[0]) / mechanism.energy
    )


def figures(record: Record) -> dict[str, float]:
    """The columns computed from one record."""
    count = len(record.steps)
    early, late = slice(1, count // 10 + 1), slice(count // 2, None)
    position = float(np.max(record.position))
    millions = (record.steps[late] - np.mean(record.steps[late])) / 1e6
    return {
        "position": position,
        "growth": position / (float(np.max(record.position[early])) or 1.0),
        "velocity": float(np.max(record.velocity)),
        "energy": float(np.max(np.abs(record.energy))),
        "slope": float(millions @ record.energy[late] / (millions @ millions)),
    }


def times(samples: Sequence[float], record: Record) -> Row:
    """The columns about time, per step; nan for a failed run, because it ended early."""
    columns = spread(samples, "us", round(record.steps[-1]))
    if record.complete:
        return columns
    return columns | {"min_us": np.nan, "median_us": np.nan}


def judged(rows: Sequence[Row]) -> tuple[list[Target], list[Reference]]:
    """Targets for each formulation, named after the worst mechanism; references for the rest."""
    found = {Case(*(row[name] for name in Case._fields)): row for row in rows}
    targets = []
    for formulation in FORMULATIONS:
        projected = {
            case: row for case, row in found.items() if case[1:] == (formulation, PROJECTION)
        }
        if not projected:
            continue
        drifts = {
            case: row["energy"] / found[against(case)]["energy"] for case, row in projected.items()
        }
        for label, figure, bound in (
            ("position residual with projection", _of(projected, "position"), 1e-12),
            ("velocity residual with projection", _of(projected, "velocity"), 1e-12),
            ("times the energy drift: projection as none", drifts, 1.0),
            ("times as long: a step with projection as none", _of(projected, "ratio"), 1.5),
        ):
            targets.append(_worst(f"{label}, {formulation}", figure, bound))
    rolling = {case: row for case, row in found.items() if case.formulation == QUASI}
    if rolling:
        drifts = {
            case: row["energy"] / found[against(case)]["energy"] for case, row in rolling.items()
        }
        targets += [
            _worst("velocity residual, quasi", _of(rolling, "velocity"), 1e-12),
            _worst("times the energy drift: quasi as multipliers with projection", drifts, 1.0),
            _worst(
                "times as long: a step, quasi as multipliers with projection",
                _of(rolling, "ratio"),
                1.0,
            ),
        ]
    return targets, _references(found)


def _worst(label: str, figure: Mapping[Case, float], bound: float) -> Target:
    """The target that no mechanism exceeds the bound, named after the worst one."""
    # nan is worse than any number.
    worst = max(figure, key=lambda case: np.nan_to_num(figure[case], nan=np.inf))
    return Target(f"{label} ({worst.mechanism})", figure[worst], "<=", bound)


def _of(rows: Mapping[Case, Row], column: str) -> dict[Case, float]:
    return {case: row[column] for case, row in rows.items()}


def _references(rows: Mapping[Case, Row]) -> list[Reference]:
    references = []
    for stabilization, column, label in (
        (NONE, "position", "position residual without stabilisation"),
        (NONE, "growth", "times that of the first tenth of the run: the same"),
        (BAUMGARTE, "position", "position residual with Baumgarte's damping"),
        (BAUMGARTE, "velocity", "velocity residual with Baumgarte's damping"),
        (BAUMGARTE, "ratio", "times as long: a step with Baumgarte's damping as none"),
    ):
        values = [
            row[column]
            for case, row in rows.items()
            if case[2] == stabilization and case.mechanism not in ROLLING
        ]
        if not values:
            continue
        ends = [f"{x:.2g}" for x in (np.min(values), np.max(values))]
        references.append(Reference(" to ".join(dict.fromkeys(ends)), label))
    return references
