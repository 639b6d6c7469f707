"""Systems at random: every program of the library against another way to the same numbers.

Lagrangians of 1 to 5 coordinates with every kind of operation, energies of 1e-12 to 1e12 times the
usual size, coordinates in units of 1e-6 to 1e6, float32 and float64. Of ten systems

- four are free: the scalar program against the array program (`_system_programs.py`);
- three are constrained, holonomic, rheonomic and Pfaffian rows at random, some of which follow from
  others, say nothing, or lose rank at the state, residuals in units of 1e-6 to 1e6, coordinates
  without inertia: accelerations, multipliers and their derivatives by arrays, scalars and null
  spaces against Gaussian elimination in extended precision (`_mechanism_programs.py`,
  `_reference_solution.py`);
- two are in quasi-velocities, by U or by kinematics, L in v or in u, with rows or without,
  singular at the state by chance: against the same equations solved with multipliers;
- one is differentiated twice through a loop: against the same unrolled (`_loops.py`).

What has no solution must have no number. Of some of the constrained ones, and of those in
quasi-velocities, short motions by two formulations are compared, and their statuses, and of some
loops the steps are motions (`_mechanism_motions.py`). Differences are allowed up to what other
roundings change. What differs more is made smaller and written down as source. All but the motions
is computed operation by operation: it is the programs that are compared, not what compilers make of
them.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from time import perf_counter
from typing import Any, NamedTuple

import jax

from bench._harness.timing import Report, Target
from bench.fuzz import (
    _loops,
    _mechanism_motions,
    _mechanism_programs,
    _random_mechanisms,
    _random_quasi,
    _random_systems,
    _system_programs,
)
from bench.fuzz._comparison import DIFFERS, EQUAL, Compared

SYSTEMS = 2000  # compared: an hour and a half
QUICK = 20.0  # seconds of a quick run
TOGETHER = 200  # systems, after which what is compiled is dropped
SMALLEST = 60  # attempts to make a find smaller
MOVING = 4.0  # decades of units of what moves: tolerances bound no more


class Kind(NamedTuple):
    """What is drawn, and how it is looked at.

    Attributes:
        name: in the rows of the report.
        draw: from a seed.
        compared: how it compares.
        smaller: others with something left out.
    """

    name: str
    draw: Callable[[int], Any]
    compared: Callable[[Any], Compared]
    smaller: Callable[[Any], Iterator[Any]]


def _none(_: Any) -> Iterator[Any]:
    return iter(())


FREE = Kind("free", _random_systems.draw, _system_programs.compared, _random_systems.smaller)
CONSTRAINED, QUASI = (
    Kind(name, module.draw, _mechanism_programs.compared, _random_mechanisms.smaller)
    for name, module in (("constrained", _random_mechanisms), ("quasi", _random_quasi))
)
CONSTRAINED_MOTION, QUASI_MOTION = (
    Kind(
        f"{kind.name}, moving",
        lambda seed, kind=kind: kind.draw(seed, MOVING, True),  # type: ignore[call-arg]
        _mechanism_motions.compared,
        _random_mechanisms.smaller,
    )
    for kind in (CONSTRAINED, QUASI)
)
LOOPS = Kind("loops", _loops.draw, _loops.compared, _none)
LOOPED_MOTION = LOOPS._replace(name="loops of motions", draw=lambda seed: _loops.draw(seed, True))
KINDS = (
    FREE,
    CONSTRAINED,
    QUASI,
    LOOPS,
    CONSTRAINED_MOTION,
    QUASI_MOTION,
    LOOPED_MOTION,
)


def kind_of(seed: int) -> Kind:
    """What a seed stands for: free, constrained, quasi or loops, in ten 4, 3, 2 and 1."""
    tens, ones = divmod(seed, 10)
    if ones == 5 and tens % 5 == 3:
        return CONSTRAINED_MOTION
    if ones == 7 and tens % 10 == 4:
        return QUASI_MOTION
    if ones == 9 and tens % 40 == 6:
        return LOOPED_MOTION
    turns = (FREE, CONSTRAINED, QUASI, FREE, CONSTRAINED, CONSTRAINED, FREE, QUASI, FREE, LOOPS)
    return turns[ones]


def run(quick: bool, seconds: float | None = None, first: int = 0) -> Report:
    """Systems one after the other until enough are compared or the time is over."""
    if seconds is None:
        seconds = QUICK if quick else float("inf")
    end = perf_counter() + seconds
    found_kinds: Counter[str] = Counter()
    of_kind: Counter[str] = Counter()
    finds, seed, worst = [], first, 0.0
    while perf_counter() < end and found_kinds[EQUAL] < SYSTEMS:
        kind = kind_of(seed)
        drawn = kind.draw(seed)
        found = kind.compared(drawn)
        found_kinds[found.kind] += 1
        if found.kind == DIFFERS:
            finds.append(_written_down(seed, *_smallest(kind, drawn, found)))
        else:
            of_kind[kind.name] += found.kind == EQUAL
            worst = max(worst, found.worst)
        seed += 1
        if seed % TOGETHER == 0:
            jax.clear_caches()
    rows = [_row(kind, number) for kind, number in found_kinds.most_common()]
    rows += [_row(f"equal, {kind}", number) for kind, number in of_kind.most_common()]
    rows.append(_row("worst of the equal, over the bound", worst))
    targets = [
        Target("systems that differ", float(found_kinds[DIFFERS]), "<=", 0.0),
        Target("systems compared", float(found_kinds[EQUAL]), ">=", 0.0 if quick else SYSTEMS),
    ]
    return Report(rows + finds, targets, [], rows)


def _smallest(kind: Kind, drawn: Any, found: Compared) -> tuple[Any, Compared]:
    """A system in which the programs still differ, with as much left out as the tries allow."""
    tries, again = 0, True
    while again:
        again = False
        for other in kind.smaller(drawn):
            tries += 1
            if tries > SMALLEST:
                return drawn, found
            try:
                now = kind.compared(other)
            except Exception:  # left too little
                continue
            if now.kind == DIFFERS:
                drawn, found, again = other, now, True
                break
    return drawn, found


def _row(kind: str, number: float, declared: str = "") -> dict[str, Any]:
    return {"kind": kind, "systems": number, "declared": declared}


def _written_down(seed: int, drawn: Any, found: Compared) -> dict[str, Any]:
    return _row(f"seed {seed}: {found.what} differs", found.worst, drawn.written)
