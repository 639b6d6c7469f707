"""`sweep`: many trajectories of one system, each a function of its case."""

import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

from jaxlag._core._errors import invalid
from jaxlag._simulation._options._simulate_options import NO_OPTIONS
from jaxlag._sweep._cores import computed_rows
from jaxlag._sweep._plan import Plan, planned
from jaxlag._sweep._problem import problem_of
from jaxlag._sweep._progress import Progress, between_blocks
from jaxlag._sweep._record import AbstractRecord, InMemory, Rows
from jaxlag._sweep._statistics import Reduction, Statistics
from jaxlag._sweep._store import created
from jaxlag._sweep._sweep_result import SweepReport, SweepResult, totals

_STOPPED = "The sweep was stopped. What is in its store is kept: the same call goes on from there."


def sweep(
    system: Any,
    cases: Any,
    n: Any,
    ts: Any = None,
    *,
    seed: Any = 0,
    keep: Any = None,
    store: Any = None,
    overwrite: Any = False,
    statistics: Any = None,
    reduce: Any = None,
    simulate_options: Any = NO_OPTIONS,
) -> SweepResult:
    """Simulate n trajectories, and keep what is named.

    Trajectory i has the same bits for any n, and whatever the other trajectories do. They are
    computed in blocks of a fixed number, one at a time by each core: the memory of the solves is
    that of these blocks. As under `jax.vmap`, "auto" does not change the method or the formulation
    of a motion that fails: pass the method for stiff systems.

    On a terminal a bar shows the progress if tqdm is installed; elsewhere the logger "jaxlag" has a
    line of level INFO every 30 s. Ctrl-C ends a sweep after the block that is being computed.

    Args:
        system: the mechanical system.
        cases: a function (key, index) -> `Case` of one trajectory, with a key of `jax.random` and
            its index; or a `Case` of arrays with a leading axis, one entry for each trajectory.
            Keys are `jax.random.fold_in(jax.random.key(seed), index)`. The function is traced once:
            values that it reads from outside are those of this moment.
        n: number of trajectories; None for that of the arrays.
        ts: (s,) times in s, strictly monotone; None if each case has its own.
        seed: of the keys, 0 <= seed < 2^32.
        keep: names of coordinates, "x'" for the velocity of "x", quasi-velocities, states, and of
            quantities as in `save=` of `simulate`; None for all but these quantities. One that is
            a dict is kept by its keys: "power" as `run["power drag"]`.
        store: path of a folder, in which the trajectories are kept in place of the memory, block
            by block, as a group of zarr 3. A sweep that was ended at any moment goes on by the same
            call, and its files have the same bits then. One sweep at a time writes to a store.
        overwrite: whether a store of another sweep there is replaced, if nothing else is in its
            folder; one of this sweep goes on. Results that were read from it raise then.
        statistics: names, or `Statistics`, whose results are `run.statistics`; they are computed
            while the sweep runs. With `keep=()` nothing else is kept of the trajectories than how
            they ended. In a store they are computed of what `keep` names.
        reduce: `Reduction`, any other statistics; its result is `run.reduced`.
        simulate_options: options of `jl.simulate`, such as `{"method": "tsit5", "rtol": 1e-7}`.

    Returns:
        What they saved, and how each of them ended. Nothing is raised for a trajectory that fails:
        read `run.status`, or print `run.message()`.

    Raises:
        ValueError: an argument of wrong form or value, named; `cases` returns something else than a
            `Case`, is not traceable, or depends on more than key and index; the store is of another
            sweep, whose difference is named.
        OSError: the store cannot be written; what it has is kept.

    Example:
        A thousand pendulums of random length, from the same angle:

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     return 0.5 * params["l"] ** 2 * v[0] ** 2 + 9.81 * params["l"] * jnp.cos(q[0])
        >>> def draw(key, index):
        ...     length = 1.0 + 0.1 * jax.random.normal(key)
        ...     return jl.Case(q0=[0.5], v0=[0.0], params={"l": length})
        >>> pendulum = jl.System(lagrangian, coordinates=("theta",))
        >>> run = jl.sweep(pendulum, draw, 1000, jnp.linspace(0.0, 2.0, 5))
        >>> print(run.message(), run["theta"].shape)
        1000 trajectories: 1000 ok (1000, 5)
    """
    begun = time.monotonic()
    if not isinstance(overwrite, bool):
        raise invalid("overwrite", "be True or False", f"it was {overwrite!r}")
    statistics, reduce = _checked_statistics(statistics), _checked_reduction(reduce)
    also = () if statistics is None else tuple(statistics.names)
    plan = planned(system, cases, n, ts, seed, keep, also, simulate_options)
    if store is not None and set(also) - set(plan.layout.values):
        raise invalid("keep", f"have the names of the statistics, {list(also)}", f"it was {keep}")
    record = _record(plan, store, overwrite)
    streams = {"statistics": statistics, "reduced": reduce}
    streams = {name: stream for name, stream in streams.items() if stream is not None}
    results: dict[str, Any] = {}
    first_seconds = 0.0
    missing = record.missing()
    progress = Progress(plan.layout.count, plan.layout.count - plan.layout.trajectories(missing))
    with record.writer() as write, between_blocks(_STOPPED) as stop, closing(progress):
        for block, rows, is_new in _rows(plan, record, missing, bool(streams)):
            first_seconds = first_seconds or time.monotonic() - begun
            if is_new:
                write(block, rows)
                progress.advance(rows["status"])
            for name, stream in streams.items():
                part = stream.of_block(block * plan.layout.size, rows)
                results[name] = stream.merge(results[name], part) if name in results else part
            stop()
    report = SweepReport(
        trajectories=plan.layout.count,
        computed=plan.layout.trajectories(missing),
        **totals(record),
        seconds=time.monotonic() - begun,
        first_seconds=first_seconds,
        block=plan.layout.size,
    )
    found = results.get("statistics"), results.get("reduced")
    return SweepResult(record, plan.key.system, report, *found, plan.key, plan.cases)


def _record(plan: Plan, store: Any, overwrite: bool) -> AbstractRecord:
    """Where the trajectories are kept."""
    if store is None:
        return InMemory(plan.layout)
    return created(store, problem_of(plan), plan.layout, overwrite)


def _checked_statistics(given: Any) -> Statistics | None:
    return given if given is None or isinstance(given, Statistics) else Statistics(given)


def _checked_reduction(given: Any) -> Reduction | None:
    if given is None or isinstance(given, Reduction):
        return given
    raise invalid("reduce", "be a jl.Reduction", f"it was {given!r}")


def _rows(
    plan: Plan, record: AbstractRecord, missing: list[int], every: bool
) -> Iterator[tuple[int, Rows, bool]]:
    """(index, rows, whether they are computed now) of every block, or of those not kept yet."""
    computed, absent = computed_rows(plan, missing), set(missing)
    for block in range(plan.layout.blocks) if every else missing:
        if block in absent:
            yield block, next(computed), True
        else:
            yield block, {name: record.rows(name, block) for name in plan.layout.arrays}, False
