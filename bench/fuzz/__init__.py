"""Random systems: every program of the library is compared with an independent computation.

Lagrangians have 1 to 5 coordinates and all kinds of operations. Energies are 1e-12 to 1e12 times
the usual size, units of coordinates 1e-6 to 1e6. The precision is float32 or float64. Of ten
systems

- three are free. The scalar program is compared with the array program (`_system_programs.py`).
- three are constrained by random holonomic, rheonomic and Pfaffian rows. Some rows depend on
  others, are identically zero, or lose rank at the state. Units of residuals are 1e-6 to 1e6;
  coordinates may have no inertia. Accelerations, multipliers and their derivatives by arrays,
  scalars and null spaces are compared with Gaussian elimination in extended precision
  (`_mechanism_programs.py`, `_reference_solution.py`).
- one consists of rigid bodies by poses, in chains, with rows between their points or none. It is
  compared in the same way.
- two have quasi-velocities, by U or by kinematics, L in v or in u, with rows or without. Some are
  singular at the state. They are compared with the same equations solved with multipliers.
- one is differentiated twice through a loop and compared with the unrolled loop (`_loops.py`).

If there is no solution, the result must not be finite. For some systems with constraints or
quasi-velocities, short motions by two formulations and their statuses are compared. For some loops
the steps are motions (`_mechanism_motions.py`). The allowed difference is that caused by other
rounding errors. A system that differs more is reduced and reported as source. Everything except
motions is evaluated operation by operation, because the test is about the programs and not about
the compilers.
"""

import sys
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
    _random_bodies,
    _random_mechanisms,
    _random_quasi,
    _random_systems,
    _system_programs,
)
from bench.fuzz._comparison import DIFFERS, EQUAL, Compared

SYSTEMS = 2000  # to be compared: this takes an hour and a half
QUICK = 20.0  # seconds of a quick run
TOGETHER = 200  # systems, after which compiled programs are dropped
SMALLEST = 60  # attempts to reduce a system that differs
MOVING = 4.0  # decades of the units for motions: tolerances do not cover more


class Kind(NamedTuple):
    """A kind of random systems, with the functions that draw and compare them.

    Attributes:
        name: in the table of the report.
        draw: a system from a seed.
        compared: the comparison of a system.
        smaller: reduced systems.
    """

    name: str
    draw: Callable[[int], Any]
    compared: Callable[[Any], Compared]
    smaller: Callable[[Any], Iterator[Any]]


def _none(_: Any) -> Iterator[Any]:
    return iter(())


FREE = Kind("free", _random_systems.draw, _system_programs.compared, _random_systems.smaller)
CONSTRAINED, QUASI, BODIES = (
    Kind(name, module.draw, _mechanism_programs.compared, _random_mechanisms.smaller)
    for name, module in (
        ("constrained", _random_mechanisms),
        ("quasi", _random_quasi),
        ("bodies", _random_bodies),
    )
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
    BODIES,
    LOOPS,
    CONSTRAINED_MOTION,
    QUASI_MOTION,
    LOOPED_MOTION,
)


def kind_of(seed: int) -> Kind:
    """The kind of a seed: of ten 3 are free, 3 constrained, 2 quasi, 1 bodies and 1 loops."""
    tens, ones = divmod(seed, 10)
    if ones == 5 and tens % 5 == 3:
        return CONSTRAINED_MOTION
    if ones == 7 and tens % 10 == 4:
        return QUASI_MOTION
    if ones == 9 and tens % 40 == 6:
        return LOOPED_MOTION
    kinds = (FREE, CONSTRAINED, QUASI, FREE, CONSTRAINED, CONSTRAINED, FREE, QUASI, BODIES, LOOPS)
    return kinds[ones]


def run(quick: bool, seconds: float | None = None, first: int = 0) -> Report:
    """Compare systems one after the other until there are enough or the time has expired."""
    if seconds is None:
        seconds = QUICK if quick else float("inf")
    end = perf_counter() + seconds
    found_kinds: Counter[str] = Counter()
    of_kind: Counter[str] = Counter()
    finds, seed, worst = [], first, 0.0
    while perf_counter() < end and found_kinds[EQUAL] < SYSTEMS:
        kind = kind_of(seed)
        drawn = kind.draw(seed)
        found = _compared(kind, drawn)
        found_kinds[found.kind] += 1
        if found.kind == DIFFERS:
            finds.append(_written_down(seed, *_smallest(kind, drawn, found)))
        else:
            of_kind[kind.name] += found.kind == EQUAL
            worst = max(worst, found.worst)
        seed += 1
        if seed % TOGETHER == 0:
            jax.clear_caches()
            print(f"{seed} seeds: {dict(found_kinds)}", file=sys.stderr, flush=True)
    rows = [_row(kind, number) for kind, number in found_kinds.most_common()]
    rows += [_row(f"equal, {kind}", number) for kind, number in of_kind.most_common()]
    rows.append(_row("worst of the equal, over the bound", worst))
    targets = [
        Target("systems that differ", float(found_kinds[DIFFERS]), "<=", 0.0),
        Target("systems compared", float(found_kinds[EQUAL]), ">=", 0.0 if quick else SYSTEMS),
    ]
    return Report(rows + finds, targets, [], rows)


def _compared(kind: Kind, drawn: Any) -> Compared:
    """The comparison; an exception counts as a difference."""
    try:
        return kind.compared(drawn)
    except Exception as error:
        return Compared(DIFFERS, float("inf"), f"{type(error).__name__}: {error},")


def _smallest(kind: Kind, drawn: Any, found: Compared) -> tuple[Any, Compared]:
    """A reduced system in which the programs still differ, after at most `SMALLEST` attempts."""
    tries, again = 0, True
    while again:
        again = False
        for other in kind.smaller(drawn):
            tries += 1
            if tries > SMALLEST:
                return drawn, found
            try:
                now = kind.compared(other)
            except Exception:  # reduced too far
                continue
            if now.kind == DIFFERS:
                drawn, found, again = other, now, True
                break
    return drawn, found


def _row(kind: str, number: float, declared: str = "") -> dict[str, Any]:
    return {"kind": kind, "systems": number, "declared": declared}


def _written_down(seed: int, drawn: Any, found: Compared) -> dict[str, Any]:
    return _row(f"seed {seed}: {found.what} differs", found.worst, drawn.written)
