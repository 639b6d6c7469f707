"""One example run of a system, as a table and a figure."""

import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

import jaxlag as jl
from systems._entry import Entry

TOLERANCE = 1e-10
SAMPLES = 601
TABLE_ROWS = 7


def simulate_example(entry: Entry) -> jl.Solution:
    """The example's motion at `SAMPLES` equidistant times."""
    example = entry.example
    ts = np.linspace(0.0, example.duration, SAMPLES)
    return jl.simulate(
        entry.system,
        example.q0,
        example.v0,
        ts,
        example.params,
        rtol=TOLERANCE,
        atol=TOLERANCE,
        throw=False,
    )


def drifts(entry: Entry, motion: jl.Solution) -> Iterator[tuple[str, float]]:
    """(name, largest relative change from the start) of each invariant of the entry."""
    for name, invariant in entry.invariants.items():
        along = jax.vmap(invariant, in_axes=(0, 0, 0, 0, None))
        values = np.asarray(along(motion.ts, motion.q, motion.v, motion.a, entry.example.params))
        yield name, float(np.max(np.abs(values / values[0] - 1)))


def main(entry: Entry, plot: Path | None) -> int:
    """Run the example and print it, with a figure at `plot` if given; 0 if all went well."""
    motion = simulate_example(entry)
    print("\n".join(_lines(entry, motion)))
    if plot is not None:
        from systems._plot import PlotError, save

        try:
            save(entry, motion, plot)
        except PlotError as error:
            print(error, file=sys.stderr)
            return 1
        print(f"figure   {plot}")
    return 0 if motion.status == jl.Status.ok else 1


def _lines(entry: Entry, motion: jl.Solution) -> Iterator[str]:
    params = entry.example.params
    yield f"{entry.name}: {entry.book}"
    yield ", ".join(f"{name} = {params[name]:g} {u}" for name, u in entry.parameter_units.items())
    yield ""
    yield from _table(entry, motion)
    yield ""
    yield f"energy   {_energy(entry, motion)}"
    for name, drift in drifts(entry, motion):
        yield f"{name:<8} constant within {drift:.1e} (relative)"
    yield f"steps    {', '.join(f'{name} {value}' for name, value in motion.stats.items())}"
    yield f"status   {motion.message()}"


def _table(entry: Entry, motion: jl.Solution) -> Iterator[str]:
    names = entry.coordinates
    units = entry.coordinate_units
    heads = ["t [s]"]
    heads += [f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)]
    heads += [f"{name}' [{unit}/s]" for name, unit in zip(names, units, strict=True)]
    heads += ["T + V [J]"]
    yield "  ".join(f"{head:>16}" for head in heads)
    energies = motion.kinetic + motion.potential
    for row in np.linspace(0, SAMPLES - 1, TABLE_ROWS, dtype=int):
        values = (motion.ts[row], *motion.q[row], *motion.v[row], energies[row])
        yield "  ".join(f"{float(value):16.6f}" for value in values)


def _energy(entry: Entry, motion: jl.Solution) -> str:
    H = np.asarray(motion.energy)
    if entry.system.forces:
        forces = ", ".join(force.name for force in entry.system.forces)
        return f"from {H[0]:.6g} J to {H[-1]:.6g} J under {forces}"
    return f"constant within {np.max(np.abs(H - H[0])):.1e} J"
