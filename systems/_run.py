"""One example run of a system, as a table and a figure."""

import sys
from collections.abc import Iterator, Sequence
from functools import partial, singledispatch
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from systems._entry import AbstractEntry, Entry, PrescribedEntry, StaticEntry
from systems._plot import Panel, PlotError, by_unit, save
from systems._quantities import prescribed_quantities, static_quantities

TOLERANCE = 1e-10
SAMPLES = 601
TABLE_ROWS = 7

_FORCE_UNITS = {"m": "N", "rad": "N m"}
"""Unit of the generalized force on a coordinate of this unit."""


class Report(NamedTuple):
    """What a run found: lines to print, panels to draw, and whether all went well."""

    lines: list[str]
    panels: list[Panel]
    ok: bool


def main(entry: AbstractEntry, plot: Path | None) -> int:
    """Run the example and print it, with a figure at `plot` if given; 0 if all went well."""
    report = run(entry)
    params = entry.example.params
    print(f"{entry.name}: {entry.book}")
    print(", ".join(f"{name} = {params[name]:g} {u}" for name, u in entry.parameter_units.items()))
    print("\n".join(["", *report.lines]))
    if plot is not None:
        try:
            save(entry, report.panels, plot)
        except PlotError as error:
            print(error, file=sys.stderr)
            return 1
        print(f"figure   {plot}")
    return 0 if report.ok else 1


@singledispatch
def run(entry: AbstractEntry) -> Report:
    """The example of a system, run."""
    raise NotImplementedError(f"examples of {entry.kind} systems cannot be run")


@run.register
def _(entry: Entry) -> Report:
    motion = simulate_example(entry)
    energies = {
        "T kinetic": motion.kinetic,
        "V potential": motion.potential,
        "E = T + V": motion.kinetic + motion.potential,
    }
    panels = by_unit(entry, motion.ts, motion.q, entry.coordinate_units)
    panels.append(Panel("t [s]", motion.ts, "energy [J]", energies))
    return Report(list(_motion_lines(entry, motion)), panels, bool(motion.status == jl.Status.ok))


@run.register
def _(entry: StaticEntry) -> Report:
    params = {name: jnp.asarray(value) for name, value in entry.example.params.items()}
    rest = entry.rest(params)
    return Report(
        list(_static_lines(entry, params, rest)),
        _static_panels(entry, params, rest),
        bool(rest.status == jl.Status.ok),
    )


@run.register
def _(entry: PrescribedEntry) -> Report:
    example = entry.example
    ts = jnp.linspace(0.0, example.duration, SAMPLES)
    motion = jl.prescribed_motion(lambda t: entry.motion(t, example.params), ts)
    rows = jax.vmap(partial(prescribed_quantities, entry, example.params))(ts, *motion)
    forces = rows["generalized_force"]
    units = [_FORCE_UNITS[unit] for unit in entry.coordinate_units]
    heads = [*_heads(entry, ""), *_forces(entry)]
    lines = [*_table(heads, (ts, rows["q"], forces)), "", f"at t = {ts[0]:g} s"]
    lines += [f"{name} = {rows[f'extras.{name}'][0]:.6g}" for name in entry.extras]
    panels = by_unit(entry, ts, rows["q"], entry.coordinate_units)
    panels += [
        p._replace(y_label=f"force on {p.y_label}") for p in by_unit(entry, ts, forces, units)
    ]
    return Report(lines, panels, bool(jnp.all(jnp.isfinite(forces))))


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
        save=("work",),
        throw=False,
    )


def drifts(entry: Entry, motion: jl.Solution) -> Iterator[tuple[str, float]]:
    """(name, largest change from the start over largest value) of each invariant."""
    for name, invariant in entry.invariants.items():
        along = jax.vmap(invariant, in_axes=(0, 0, 0, 0, None))
        values = np.asarray(along(motion.ts, motion.q, motion.v, motion.a, entry.example.params))
        yield name, float(np.max(np.abs(values - values[0])) / np.max(np.abs(values)))


def _motion_lines(entry: Entry, motion: jl.Solution) -> Iterator[str]:
    heads = [*_heads(entry, ""), *_heads(entry, "'")[1:], "T + V [J]"]
    energies = motion.kinetic + motion.potential
    yield from _table(heads, (motion.ts, motion.q, motion.v, energies))
    yield ""
    yield f"energy   {_energy(motion)}"
    for name, drift in drifts(entry, motion):
        yield f"{name:<8} constant within {drift:.1e} (relative)"
    yield f"steps    {', '.join(f'{name} {value}' for name, value in motion.stats.items())}"
    yield f"status   {motion.message()}"


def _static_lines(entry: StaticEntry, params: dict, rest: jl.Equilibrium) -> Iterator[str]:
    for name, unit, value in zip(entry.coordinates, entry.coordinate_units, rest.q, strict=True):
        yield f"{name} = {float(value):.9g} {unit}"
    for name, value in static_quantities(entry, params, rest.q).items():
        if name != "q":
            yield f"{name} = {float(value):.9g}"
    yield ""
    verdict = "stable" if rest.stable else "not shown to be stable"
    kind = "Hessian of V" if rest.conservative else "symmetric part of the stiffness"
    yield f"{verdict}: eigenvalues of the {kind} {', '.join(f'{x:.6g}' for x in rest.eigenvalues)}"
    yield f"status   {rest.message()}"


def _static_panels(entry: StaticEntry, params: dict, rest: jl.Equilibrium) -> list[Panel]:
    """The force on every coordinate as this coordinate alone moves away from rest."""
    zero = jnp.zeros_like(rest.q)
    panels = []
    for i, (name, unit) in enumerate(zip(entry.coordinates, entry.coordinate_units, strict=True)):
        x = rest.q[i] + jnp.linspace(-1.0, 1.0, 201) * (1.0 if unit == "rad" else 0.5)

        def force(x: jax.Array, i: int = i) -> jax.Array:
            return -jl.inverse_dynamics(entry.system, rest.q.at[i].set(x), zero, zero, params)[i]

        label = f"force on {name} [{_FORCE_UNITS[unit]}]"
        mark = (float(rest.q[i]), float(rest.residual[i]))
        panels.append(Panel(f"{name} [{unit}]", x, label, {name: jax.vmap(force)(x)}, mark))
    return panels


def _heads(entry: AbstractEntry, prime: str) -> list[str]:
    per = "/s" if prime else ""
    names = zip(entry.coordinates, entry.coordinate_units, strict=True)
    return ["t [s]", *(f"{name}{prime} [{unit}{per}]" for name, unit in names)]


def _forces(entry: AbstractEntry) -> list[str]:
    names = zip(entry.coordinates, entry.coordinate_units, strict=True)
    return [f"on {name} [{_FORCE_UNITS[unit]}]" for name, unit in names]


def _table(heads: Sequence[str], columns: Sequence[jax.Array]) -> Iterator[str]:
    yield "  ".join(f"{head:>16}" for head in heads)
    table = np.column_stack([np.asarray(column) for column in columns])
    for row in np.linspace(0, len(table) - 1, TABLE_ROWS, dtype=int):
        yield "  ".join(f"{value:16.6f}" for value in table[row])


def _energy(motion: jl.Solution) -> str:
    H = np.asarray(motion.energy)
    if not motion.work:
        return f"constant within {np.max(np.abs(H - H[0])):.1e} J"
    given = ", ".join(f"{name} {float(work[-1]):+.6g} J" for name, work in motion.work.items())
    left = np.max(np.abs(H - H[0] - sum(np.asarray(work) for work in motion.work.values())))
    return f"from {H[0]:.6g} J to {H[-1]:.6g} J by {given}; the books close within {left:.1e} J"
