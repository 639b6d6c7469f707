"""Minimal states: independent coordinates and velocities, quasi-velocities, states."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxlag._analysis._independent_columns import dependent_columns, rank_of, unit_rows
from jaxlag._core._arguments import name_sequence
from jaxlag._core._errors import invalid
from jaxlag._linalg._mass_solve import dependence_floor
from jaxlag._model._constraints import ConstraintRows
from jaxlag._model._coordinates import Coordinates
from jaxlag._model._quasi_velocities import QuasiVelocities
from jaxlag._system._system import System


class MinimalStates(NamedTuple):
    """Which entries of (q, w, x) are independent; w = v, or the free quasi-velocities.

    Attributes:
        coordinates: indices of q.
        velocities: indices of w.
        names: of the states, those of the system included.
    """

    coordinates: tuple[int, ...]
    velocities: tuple[int, ...]
    names: tuple[str, ...]


def minimal_states(
    system: System,
    rows: ConstraintRows,
    A: np.ndarray | None,
    independent: Any,
    function: str = "linearize",
    first: Sequence[int] = (),
    last: tuple[Sequence[int], Sequence[int]] = ((), ()),
) -> MinimalStates:
    """The independent coordinates and velocities, by pivoting or as they are named.

    Args:
        system: the mechanical system.
        rows: of its constraints.
        A: the rows in units of equal inertia; None if they are unknown.
        independent: names; None for pivoting.
        function: the public function, for errors.
        first: velocities that are taken as dependent ones before others.
        last: coordinates, and velocities, that are taken as such only if others do not suffice.

    Raises:
        ValueError: names that are unknown, too few or too many, or do not determine the others;
            traced values that decide it.
    """
    argument, quasi = f"{function}: independent", system.quasi
    labels = system.coordinates.labels
    rates = tuple(f"{label}'" for label in labels)
    if quasi is not None:
        rates = tuple(quasi.names[i] for i in quasi.free)
    n, k = len(labels), len(rates)
    named = None
    if independent is not None:
        named = _named(argument, system.coordinates, rates, independent, quasi is not None)
    if quasi is not None:
        _check_satisfied(function, quasi, rows, n, A)
    holonomic = [i for i in range(rows.size) if rows.holonomic[i]]
    free = tuple(range(n)), tuple(range(k))
    if named is not None and not holonomic:
        named = named[0] or free[0], named[1]
    if not rows.size or (quasi is not None and not holonomic):
        chosen = _all_of(argument, free, named, (labels, rates))
    elif A is None:
        most = len(holonomic), rows.size if quasi is None else 0
        chosen = _trusted(argument, named, free, most, (labels, rates))
    else:
        A, floor = unit_rows(A), dependence_floor(A.dtype)
        own = named and named[0]
        kind = "coordinates"
        coordinates = _chosen(argument, kind, A[holonomic], floor, labels, own, last=last[0])
        if quasi is not None:
            speeds = None if named is None else (free[0], named[1] or free[1])
            chosen = coordinates, _all_of(argument, free, speeds, (labels, rates))[1]
        else:
            bound = [i for i in range(n) if i not in coordinates]
            of_rates = named[1] if named and named[1] else None
            before = [*bound, *(i for i in first if i not in bound)]
            after = [i for i in last[1] if i not in before]
            kind = "velocities"
            velocities = _chosen(argument, kind, A, floor, rates, of_rates, before, after)
            chosen = coordinates, velocities
    states = () if system.states is None else system.states.layout.labels
    names = (*(labels[i] for i in chosen[0]), *(rates[i] for i in chosen[1]), *states)
    return MinimalStates(*chosen, names)


def _check_satisfied(
    function: str, quasi: QuasiVelocities, rows: ConstraintRows, n: int, A: np.ndarray | None
) -> None:
    """Refuse quasi-velocities that leave rows to multipliers: they are not independent."""
    rank = rows.size if A is None else rank_of(unit_rows(A), dependence_floor(A.dtype))
    left = [label for label in rows.labels if label not in quasi.constrained]
    if left and len(quasi.free) > n - rank:
        must = "have quasi-velocities that satisfy all rows"
        fix = (
            "Pass the names of quasi-velocities that are zero as constrained=, or declare the "
            "system without quasi-velocities."
        )
        was = f"{len(quasi.free)} are free beside {rank} independent rows, with {left}"
        raise invalid(f"{function}: system", must, was, fix)


def entries(coordinates: Coordinates, names: Sequence[str], states: Sequence[str]) -> list[str]:
    """The states that names of coordinates and velocities stand for; other names as they are."""
    of_name = {name: [coordinates.labels[i] for i in x] for name, x in coordinates.places.items()}
    of_name |= {f"{name}'": [f"{x}'" for x in labels] for name, labels in of_name.items()}
    found: list[str] = []
    for name in names:
        found += [x for x in of_name.get(name, []) if x in states] or [name]
    return found


def _named(
    argument: str, coordinates: Coordinates, rates: tuple[str, ...], independent: Any, fixed: bool
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Indices of the named coordinates and velocities."""
    of_q = {label: [i] for i, label in enumerate(coordinates.labels)} | coordinates.places
    of_w = {rate: [i] for i, rate in enumerate(rates)}
    if not fixed:
        of_w |= {f"{name}'": places for name, places in coordinates.places.items()}
    found: tuple[list[int], list[int]] = [], []
    for name in name_sequence(argument, independent):
        if name not in of_q and name not in of_w:
            must = f"name coordinates or velocities among {[*coordinates.names, *rates]}"
            raise invalid(argument, must, f"one was {name!r}")
        part, places = (found[0], of_q[name]) if name in of_q else (found[1], of_w[name])
        part += [i for i in places if i not in part]
    return tuple(sorted(found[0])), tuple(sorted(found[1]))


_Indices = tuple[tuple[int, ...], tuple[int, ...]]
_Labels = tuple[Sequence[str], Sequence[str]]


def _all_of(argument: str, free: _Indices, named: _Indices | None, labels: _Labels) -> _Indices:
    """All coordinates and velocities, where no row determines any of them."""
    for kind, every, some, names in zip(
        ("coordinates", "velocities"), free, named or free, labels, strict=True
    ):
        if some != every and (some or kind == "coordinates"):
            must = f"name all {kind}, as no row determines one of them"
            was = f"they were {[names[i] for i in some]}"
            raise invalid(argument, must, was, "Leave it out; see drop=.")
    return free


def _trusted(
    argument: str, named: _Indices | None, free: _Indices, most: tuple[int, int], labels: _Labels
) -> _Indices:
    """The named ones where values are traced; only their numbers are checked.

    Args:
        argument: its name in errors.
        named: indices of q and w; None if there are no names.
        free: all of them.
        most: largest numbers that rows determine.
        labels: of q and w.
    """
    if named is not None and not most[1]:
        named = named[0], named[1] or free[1]
    if named is None or not named[1]:
        raise invalid(
            argument,
            "name the independent coordinates and velocities if t, q or params are traced",
            "there were none" if named is None else "there were no velocities",
            "Take the names from linearize(...).states outside of jax.jit, jax.grad and jax.vmap.",
        )
    kinds = zip(("coordinates", "velocities"), named, free, most, labels, strict=True)
    for kind, some, every, count, names in kinds:
        if len(every) - len(some) > count:
            must = f"name {len(every) - count} {kind} or more, as {count} rows determine the others"
            raise invalid(argument, must, f"they were {[names[i] for i in some]}")
    return named


def _chosen(
    argument: str,
    kind: str,
    A: np.ndarray,
    floor: float,
    labels: Sequence[str],
    named: tuple[int, ...] | None,
    first: Sequence[int] = (),
    last: Sequence[int] = (),
) -> tuple[int, ...]:
    """Independent columns of A: those named, or the others of the dependent ones."""
    every = range(A.shape[1])
    if named is None:
        bound = dependent_columns(A, floor, first, last)
        return tuple(i for i in every if i not in bound)
    rank = rank_of(A, floor)
    if len(named) != len(every) - rank:
        must = f"name {len(every) - rank} {kind}, as the rank of the rows is {rank}"
        was = f"they were {[labels[i] for i in named]}"
        proposed = dependent_columns(A, floor, first)
        fix = f"For example {[labels[i] for i in every if i not in proposed]}."
        raise invalid(argument, must, was, fix)
    bound = [i for i in every if i not in named]
    if rank and rank_of(A[:, bound], floor) < rank:
        kept = dependent_columns(A[:, bound], floor)
        lost = [labels[i] for j, i in enumerate(bound) if j not in kept]
        proposed = dependent_columns(A, floor, first, named)
        fix = f"For example {[labels[i] for i in every if i not in proposed]}."
        was = f"{', '.join(lost)} did not follow from {[labels[i] for i in named]}"
        raise invalid(argument, f"determine all {kind} by the rows", was, fix)
    return named
