"""One example run of a system, as a table and a figure."""

import sys
from collections.abc import Iterator, Sequence
from functools import partial, singledispatch
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

import jaxlag as jl
from systems._plot import Panel, PlotError, by_unit, save
from systems.catalogue._entry import AbstractEntry, Entry, PrescribedEntry, StaticEntry
from systems.reference._quantities import prescribed_quantities, static_quantities

TOLERANCE = 1e-10
SAMPLES = 601
TABLE_ROWS = 7

_FORCE_UNITS = {"m": "N", "rad": "N m"}
"""Unit of the generalized force on a coordinate of this unit."""


class Report(NamedTuple):
    """The results of a run: lines to print, panels to draw, and whether it was successful."""

    lines: list[str]
    panels: list[Panel]
    ok: bool


def main(entry: AbstractEntry, plot: Path | None) -> int:
    """Run the example and print it, with a figure at `plot` if given; 0 if successful."""
    report = run(entry)
    params = entry.example.params
    print(f"{entry.name}: {entry.book}")
    units = entry.parameter_units.items()
    print(", ".join(f"{name} = {_value(params[name])}{_unit(unit)}" for name, unit in units))
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
    """Run the example of a system."""
    raise NotImplementedError(f"examples of {entry.kind} systems cannot be run")


@run.register
def _(entry: Entry) -> Report:
    motion = simulate_example(entry)
    energies = {
        "T kinetic": motion.kinetic,
        "V potential": motion.potential,
        "E = T + V": motion.kinetic + motion.potential,
    }
    panels = by_unit(entry.coordinates, motion.ts, motion.q, entry.coordinate_units)
    panels += by_unit(*_free_quasi_velocities(entry, motion))
    panels.append(Panel("t [s]", motion.ts, "energy [J]", energies))
    lines = list(_motion_lines(entry, motion))
    if entry.constraints:
        lines += ["", *_constraint_lines(entry, motion)]
        panels += _constraint_panels(entry, motion)
    return Report(lines, panels, bool(motion.status == jl.Status.ok))


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
    values = jax.vmap(partial(prescribed_quantities, entry, example.params))(ts, *motion)
    forces = values["generalized_force"]
    units = [_FORCE_UNITS[unit] for unit in entry.coordinate_units]
    heads = [*_heads(entry, ""), *_forces(entry)]
    lines = [*_table(heads, (ts, values["q"], forces)), "", f"at t = {ts[0]:g} s"]
    lines += [f"{name} = {values[f'extras.{name}'][0]:.6g}" for name in entry.extras]
    panels = by_unit(entry.coordinates, ts, values["q"], entry.coordinate_units)
    panels += [
        p._replace(y_label=f"force on {p.y_label}")
        for p in by_unit(entry.coordinates, ts, forces, units)
    ]
    return Report(lines, panels, bool(jnp.all(jnp.isfinite(forces))))


def simulate_example(entry: Entry) -> jl.Solution:
    """The example's motion at `SAMPLES` equidistant times."""
    example = entry.example
    ts = np.linspace(0.0, example.duration, SAMPLES)
    return jl.simulate(
        entry.system,
        *entry.start(),
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
    heads, rates = [*_heads(entry, ""), *_heads(entry, "'")[1:]], motion.v
    if entry.quasi_velocities:
        names, _, rates, units = _free_quasi_velocities(entry, motion)
        own = (f"{name} [{unit}]" for name, unit in zip(names, units, strict=True))
        heads = [*_heads(entry, ""), *own]
    energies = motion.kinetic + motion.potential
    yield from _table([*heads, "T + V [J]"], (motion.ts, motion.q, rates, energies))
    yield ""
    yield f"energy   {_energy(motion)}"
    for name, drift in drifts(entry, motion):
        yield f"{name:<8} varies by {drift:.1e} (relative)"
    steps = (f"{motion.stats[name]} {name}" for name in ("accepted", "rejected"))
    yield f"steps    {', '.join(steps)}"
    yield f"status   {motion.message()}"


def _free_quasi_velocities(
    entry: Entry, motion: jl.Solution
) -> tuple[tuple[str, ...], jax.Array, np.ndarray, tuple[str, ...]]:
    """(names, times, values, units) of the quasi-velocities that do not vanish."""
    names = entry.free_quasi_velocities
    columns = [entry.quasi_velocities.index(name) for name in names]
    units = tuple(entry.quasi_units[column] for column in columns)
    values = np.asarray(motion.u)[:, columns] if columns else np.zeros((len(motion.ts), 0))
    return names, motion.ts, values, units


def _constraint_lines(entry: Entry, motion: jl.Solution) -> Iterator[str]:
    def residuals(q: jax.Array, v: jax.Array, t: jax.Array) -> tuple[dict, dict]:
        return entry.system.residuals(q, v, entry.example.params, t=t)

    positions, velocities = jax.jit(jax.vmap(residuals))(motion.q, motion.v, motion.ts)
    both = {"position": positions, "velocity": velocities}
    multipliers = motion.multipliers
    yield f"{'constraint':<12}{'lambda at the end':>24}  largest residuals"
    for name, unit in entry.multiplier_units.items():
        last = f"{float(multipliers[name][-1]):.6g} {unit}"
        sizes = {kind: jnp.max(jnp.abs(rows[name])) for kind, rows in both.items() if name in rows}
        yield f"{name:<12}{last:>24}  {', '.join(f'{k} {float(x):.1e}' for k, x in sizes.items())}"


def _constraint_panels(entry: Entry, motion: jl.Solution) -> list[Panel]:
    """The multipliers over time."""
    multipliers = motion.multipliers
    lam = jnp.stack([multipliers[name] for name in entry.constraints], axis=-1)
    units = tuple(entry.multiplier_units.values())
    panels = by_unit(entry.constraints, motion.ts, lam, units)
    return [panel._replace(y_label=f"lambda of {panel.y_label}") for panel in panels]


def _static_lines(entry: StaticEntry, params: dict, rest: jl.Equilibrium) -> Iterator[str]:
    for name, unit, value in zip(entry.coordinates, entry.coordinate_units, rest.q, strict=True):
        yield f"{name} = {float(value):.9g} {unit}"
    for name, value in static_quantities(entry, params, rest).items():
        if name not in ("q", *entry.coordinates):
            yield f"{name} = {float(value):.9g}"
    yield ""
    verdict = "stable" if rest.stable else "not shown to be stable"
    kind = "Hessian of V" if rest.conservative else "symmetric part of the stiffness"
    yield f"{verdict}: eigenvalues of the {kind} {', '.join(f'{x:.6g}' for x in rest.eigenvalues)}"
    yield f"status   {rest.message()}"


def _static_panels(entry: StaticEntry, params: dict, rest: jl.Equilibrium) -> list[Panel]:
    """The force on every coordinate as a function of this coordinate, the others at rest.

    With constraints, only the independent coordinates have panels; they determine the others.
    """
    zero, own = jnp.zeros_like(rest.q), rest.q[entry.file_columns]

    def configuration(own: jax.Array) -> jax.Array:
        return own if entry.chart is None else entry.chart.configuration(0.0, own, params)

    panels = []
    for i, (column, name) in enumerate(
        zip(entry.file_columns, entry.file_coordinates, strict=True)
    ):
        unit = entry.coordinate_units[column]
        x = own[i] + jnp.linspace(-1.0, 1.0, 201) * (1.0 if unit == "rad" else 0.5)

        def force(x: jax.Array, i: int = i) -> jax.Array:
            q, vjp_fn = jax.vjp(configuration, own.at[i].set(x))
            return -vjp_fn(jl.inverse_dynamics(entry.system, q, zero, zero, params))[0][i]

        label = f"force on {name} [{_FORCE_UNITS[unit]}]"
        mark = (float(own[i]), float(force(own[i])))
        panels.append(Panel(f"{name} [{unit}]", x, label, {name: jax.vmap(force)(x)}, mark))
    return panels


def _value(value: ArrayLike) -> str:
    numbers = [f"{x:g}" for x in np.ravel(np.asarray(value))]
    return numbers[0] if np.ndim(value) == 0 else f"({', '.join(numbers)})"


def _unit(unit: str) -> str:
    return "" if unit == "1" else f" {unit}"


def _heads(entry: AbstractEntry, prime: str) -> list[str]:
    per = "/s" if prime else ""
    names = zip(entry.coordinates, entry.coordinate_units, strict=True)
    return ["t [s]", *(f"{name}{prime} [{unit}{per}]" for name, unit in names)]


def _forces(entry: AbstractEntry) -> list[str]:
    names = zip(entry.coordinates, entry.coordinate_units, strict=True)
    return [f"on {name} [{_FORCE_UNITS[unit]}]" for name, unit in names]


def _table(heads: Sequence[str], columns: Sequence[ArrayLike]) -> Iterator[str]:
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
