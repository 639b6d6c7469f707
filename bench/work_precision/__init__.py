"""Time over achieved error: jaxlag, diffrax, heyoka, numba, SUNDIALS, CasADi, scipy, MuJoCo.

Each line of a system is one way to solve it, at many tolerances (or steps). The error is the
largest deviation of a final coordinate from a reference to 20 digits (`bench/references`), divided
by one plus its size. Times at an error are interpolated between adjacent points of a line, never
extrapolated.

The processes run in turn, all on one core: jax with XLA's loop setting, jax without it, another jax
(`--python PATH` of an interpreter that has jax, diffrax and optimistix), and all libraries other
than JAX. Compilation is given separately, in `compile_s`. Runs of more than 40 ms are timed only
twice, when the line is built, and not in turn. For a batch of 16 pendulums, times are per pendulum.
"""

import os
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from typing import Any

import jax

from bench._harness import results
from bench._harness.timing import Call, Reference, Report, spread
from bench._harness.workers import Worker
from bench._problems.exact_ends import exact_end
from bench._problems.motions import MOTIONS, Motion
from bench.work_precision import _jax, _peers, _plot, _ranking
from bench.work_precision._sweep import Line, built, swept
from jaxlag._core import _xla

KIND, SYSTEM = "BENCH_KIND", "BENCH_SYSTEM"  # environment of a worker
ROUNDS, QUICK_ROUNDS = 4, 2
IN_TURN_S = 40e-3  # runs up to this length are timed in turn
BUDGET_S = 100e-3  # after which a point is not timed again
PATIENCE_S = 0.5
QUICK_SYSTEMS = ("double pendulum, regular",)
QUICK_LINES = {"jaxlag dopri8", "diffrax Dopri8, by hand", "heyoka", "numba DOP853", "scipy DOP853"}
SETTINGS = {"on": "1", "off": "0", "newest": "1", "peers": "1"}


# ---- In a worker ---------------------------------------------------------------------------------


def prepare(quick: bool) -> tuple[dict[str, Call], dict[str, Any]]:
    """Sweep every line of this process: the calls to time, and the points of the lines."""
    name, kind = os.environ[SYSTEM], os.environ[KIND]
    motion = MOTIONS[name]()
    exact = exact_end(name)
    lines, missing = _lines(motion, kind)
    calls: dict[str, Call] = {}
    facts: dict[str, Any] = {"missing": missing, "jax": jax.__version__, "points": {}, "none": {}}
    facts["versions"] = _peers.versions() if kind == "peers" else {}
    for label, make in lines.items():
        if quick and label not in QUICK_LINES:
            continue
        try:
            line = built(make)
            found, points = swept(line, lambda q: motion.error(q, exact), PATIENCE_S)
        except Exception as error:  # the method does not apply, or a library is broken
            facts["none"][label] = f"{type(error).__name__}: {error}".splitlines()[0]
            continue
        if not points:
            facts["none"][label] = line.why_none(PATIENCE_S)
        facts["points"][label] = points
        calls |= {f"{label}|{value}": call for value, call in found.items()}
        for value, point in zip(found, points, strict=True):
            point["case"] = f"{label}|{value}"
    return calls, facts


def _lines(motion: Motion, kind: str) -> tuple[Mapping[str, Callable[[], Line]], dict[str, str]]:
    """Lines of one kind of process, and the error texts of libraries that cannot be imported."""
    if kind != "peers":
        ours = {"on": None, "off": (), "newest": ("tsit5", "dopri8")}[kind]
        # A prototype runs with jax's default: without the setting.
        return _jax.lines(motion, ours, prototype=kind == "off"), {}
    _silence()
    missing = _peers.missing()
    chosen = _peers.lines(motion)
    return {
        label: partial(make, motion)
        for label, (library, make) in chosen.items()
        if library not in missing
    }, missing


def _silence() -> None:
    """Discard output: warnings of libraries about short steps would fill a terminal."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nothing, stream)


# ---- The main process ----------------------------------------------------------------------------


def run(quick: bool, system: list[str] | None = None, python: str | None = None) -> Report:
    """All systems, one after the other.

    Args:
        quick: one system and a few lines.
        system: names of the systems; all by default.
        python: interpreter with another version of jax; by default that version is left out.
    """
    chosen = system or (QUICK_SYSTEMS if quick else tuple(MOTIONS))
    unknown = [name for name in chosen if name not in MOTIONS]
    if unknown:
        raise ValueError(f"--system must be one of {list(MOTIONS)}, but it was {unknown[0]!r}.")
    rows: list[dict[str, Any]] = []
    remarks: list[Reference] = []
    folder = results.FOLDER / "quick" if quick or system else results.FOLDER
    for name in chosen:
        try:
            found, notes = contest(name, quick, python)
        except RuntimeError as error:  # a crashed process must not stop the other systems
            remarks.append(Reference("failed", f"{name}: {error}"))
            continue
        rows += found
        remarks += notes
        remarks.append(Reference(_plot.save(name, found, folder), f"{name}: the diagram"))
    if python is None:
        remarks.append(Reference("left out", "another jax: no interpreter given by --python"))
    targets, profiles = _ranking.judged(rows, chosen)
    references = _ranking.fastest_references(rows) + profiles + list(dict.fromkeys(remarks))
    return Report(rows, targets, references, _ranking.fastest(rows))


def contest(
    name: str, quick: bool, python: str | None
) -> tuple[list[dict[str, Any]], list[Reference]]:
    """Table rows of one system, and notes about missing lines and versions."""
    kinds = ("on", "peers") if quick else tuple(SETTINGS)
    samples: dict[tuple[str, str], list[float]] = defaultdict(list)
    notes: list[Reference] = []
    workers: dict[str, Worker] = {}
    with ExitStack() as stack:
        for kind in kinds:
            if kind == "newest" and python is None:
                continue
            try:
                workers[kind] = stack.enter_context(_worker(name, kind, quick, python))
            except (OSError, RuntimeError) as error:
                if kind != "newest":
                    raise
                notes.append(Reference("left out", f"another jax: {python}: {error}"))
        points = {
            (kind, point["case"]): point
            for kind, worker in workers.items()
            for found in worker.facts["points"].values()
            for point in found
        }
        for key, point in points.items():
            point["in_turn"] = min(point["swept_s"]) <= IN_TURN_S
            if not point["in_turn"]:
                samples[key] = point["swept_s"]
        for _ in range(QUICK_ROUNDS if quick else ROUNDS):
            for kind, worker in workers.items():
                open_cases = [
                    case
                    for (where, case), point in points.items()
                    if where == kind and point["in_turn"] and sum(samples[kind, case]) < BUDGET_S
                ]
                for case, seconds in worker.seconds(open_cases).items():
                    samples[kind, case] += seconds
        lanes = MOTIONS[name]().lanes
        rows = [
            {
                "system": name,
                "line": _label(label, kind, worker.facts["jax"]),
                **{key: point[key] for key in ("knob", "value", "error", "steps")},
                **spread(samples[kind, point["case"]], "us", lanes),
                "compile_s": point["compile_s"],
            }
            for kind, worker in workers.items()
            for label, found in worker.facts["points"].items()
            for point in found
        ]
        for kind, worker in workers.items():
            notes += _notes(name, kind, worker.facts)
    return rows, notes


def _worker(name: str, kind: str, quick: bool, python: str | None) -> Worker:
    settings = {KIND: kind, SYSTEM: name, _xla.SWITCH: SETTINGS[kind]}
    options: dict[str, Any] = {"interpreter": python} if kind == "newest" else {}
    if hasattr(os, "sched_getaffinity"):
        options["core"] = max(os.sched_getaffinity(0))
    return Worker("work_precision", quick, settings, **options)


def _label(line: str, kind: str, version: str) -> str:
    return line + {"off": ", no setting", "newest": f", jax {version}"}.get(kind, "")


def _notes(name: str, kind: str, facts: Mapping[str, Any]) -> list[Reference]:
    missing = [Reference("left out", f"{who}: {text}") for who, text in facts["missing"].items()]
    none = [
        Reference("no line", f"{name}, {_label(line, kind, facts['jax'])}: {text}")
        for line, text in facts["none"].items()
    ]
    used = [Reference(number, f"version of {who}") for who, number in facts["versions"].items()]
    rates = MOTIONS[name]().rates.__name__
    if kind == "peers" and rates in _peers.NO_LINE:
        none.append(Reference("no line", f"{name}, {_peers.NO_LINE[rates]}"))
    return missing + used + none
