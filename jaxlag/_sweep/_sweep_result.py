"""SweepResult: what the trajectories of a sweep saved, and how each of them ended."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxlag._core._by_name import ByName
from jaxlag._core._errors import invalid, requirement
from jaxlag._core._status import Status
from jaxlag._sweep._block import BlockKey, block_indices, cases_in
from jaxlag._sweep._case import Case
from jaxlag._sweep._cases import AbstractCases
from jaxlag._sweep._record import NOT_COMPUTED, AbstractRecord
from jaxlag._sweep._statistics import StatisticsResult
from jaxlag._sweep._store import Store, opened
from jaxlag._system._system import System


class SweepReport(NamedTuple):
    """What a sweep took.

    Attributes:
        trajectories: their number.
        computed: number of those that this call computed; the others were in the store.
        statuses: number of trajectories by the name of their status.
        accepted: steps of all trajectories.
        rejected: attempted steps that were not accepted.
        seconds: of this call.
        first_seconds: until its first block was done, which includes compiling.
        block: number of trajectories of a block.
    """

    trajectories: int
    computed: int
    statuses: dict[str, int]
    accepted: int
    rejected: int
    seconds: float
    first_seconds: float
    block: int


class AbstractSweep(eqx.Module):
    """What n trajectories saved, in the order of their indices.

    `run["theta"]` is what was kept by that name. Entries that were not reached are NaN. Arrays of a
    store are read when they are asked for.

    Attributes:
        record: where they are kept.
    """

    record: eqx.AbstractVar[AbstractRecord]

    @property
    def ts(self) -> Float[np.ndarray, "*n s"]:
        """Times in s, (s,), or (n, s) if each case has its own."""
        common = self.record.layout.ts
        return self.record.read("t") if common is None else common

    @property
    def values(self) -> Mapping[str, Any]:
        """What was kept by name, each (n, s, *its shape)."""
        return Values(self.record)

    @property
    def status(self) -> Int[np.ndarray, " n"]:
        """How each trajectory ended, (n,), see `Status`; -1 if it is not computed yet."""
        return self.record.read("status")

    @property
    def where(self) -> Int[np.ndarray, " n"]:
        """Index of the coordinate or row that a failure concerns, (n,); -1 if none."""
        return self.record.read("where")

    @property
    def last_time(self) -> Float[np.ndarray, " n"]:
        """Last time reached by each, (n,), s."""
        return self.record.read("last_time")

    @property
    def accepted(self) -> Int[np.ndarray, " n"]:
        """Steps of each, (n,)."""
        return self.record.read("accepted")

    @property
    def rejected(self) -> Int[np.ndarray, " n"]:
        """Attempted steps of each that were not accepted, (n,)."""
        return self.record.read("rejected")

    def __len__(self) -> int:
        """Number of trajectories."""
        return self.record.layout.count

    @property
    def ok(self) -> Bool[np.ndarray, " n"]:
        """Whether each trajectory reached its last time."""
        return self.status == int(Status.ok)

    def __getitem__(self, name: str) -> np.ndarray:
        """What was kept by this name, (n, s, *its shape).

        Raises:
            KeyError: no such name.
        """
        return self.values[name]

    def index(self, i: Any) -> int:
        """The index of a trajectory from 0; negative ones count from the last.

        Raises:
            IndexError: there is no such trajectory.
            ValueError: it is no integer.
        """
        count = len(self)
        if isinstance(i, bool) or not isinstance(i, int | np.integer):
            raise invalid("index", "be an integer", f"it was {i!r}")
        if not -count <= i < count:
            must, was = f"be that of one of {count} trajectories", f"it was {i}"
            raise IndexError(requirement("index", must, was))
        return int(i) % count

    def message(self) -> str:
        """How the trajectories ended: counts by status, and the first of each except "ok".

        `jl.replay(run, index).message()` says more of one of them.
        """
        status = self.status
        lines = [f"{len(self)} trajectories: {_counts(counted(status))}"]
        for kind in sorted({int(x) for x in status} - {int(Status.ok), NOT_COMPUTED}):
            index = int(np.argmax(status == kind))
            time = float(self.last_time[index])
            lines.append(f"[{index}]: {Status(kind).name}, last good state at t = {time:.6g}")
        return "\n".join(lines)

    def to_xarray(self) -> Any:
        """A dataset with the axes motion and t (or save, if each case has its own times).

        Of a store it is lazy: arrays of dask, with a chunk for each block.

        Raises:
            ValueError: xarray is not installed, or dask for a store.
        """
        return self.record.to_xarray()

    def __repr__(self) -> str:
        layout = self.record.layout
        kept, counts = ", ".join(layout.values), _counts(counted(self.status))
        ts = layout.facts["t"] if layout.ts is None else layout.ts
        name, times = type(self).__name__, ts.shape[0]
        return f"{name}({kept}: {len(self)} trajectories, {times} times, {counts})"


@final
class SweepResult(AbstractSweep):
    """What `jl.sweep` returns: its trajectories, in the order of their indices.

    Attributes:
        record: where they are kept.
        system: the mechanical system.
        report: what the sweep took.
        statistics: by name, of `statistics=`; None if there was none.
        reduced: result of `reduce=`.
    """

    record: AbstractRecord
    system: System
    report: SweepReport
    statistics: StatisticsResult | None
    reduced: Any
    _key: BlockKey = eqx.field(static=True)
    _cases: AbstractCases = eqx.field(static=True)

    def case(self, index: Any) -> Case:
        """The case of one trajectory: its start, params and inputs.

        Raises:
            IndexError: there is no such trajectory.
        """
        size = self._key.size
        first, place = divmod(self.index(index), size)
        shared, own = self._cases.arguments(block_indices(first * size, size, len(self)))
        cases = cases_in(self._key, shared, own)
        return jax.tree.map(lambda x: x[place] if eqx.is_array(x) else x, cases)


@final
class StoredSweep(AbstractSweep):
    """The trajectories in a store, without the system: `jl.sweep` with the same arguments adds it.

    Attributes:
        record: the store.
    """

    record: Store

    @property
    def problem(self) -> Mapping[str, Any]:
        """What the trajectories depend on, by name."""
        return self.record.problem

    @property
    def checksum(self) -> str:
        """SHA-256 digest of the trajectories when they were written; their files are not read."""
        return self.record.checksum


def open_sweep(store: Any) -> StoredSweep:
    """The trajectories that `jl.sweep` has written to a store, also while it runs.

    Args:
        store: path of its folder.

    Raises:
        ValueError: there is no store; zarr is not installed.
    """
    return StoredSweep(opened(store))


class Values(Mapping[str, np.ndarray]):
    """What was kept by name; arrays of a store are read when they are asked for."""

    def __init__(self, record: AbstractRecord) -> None:
        self._record = record

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._record.layout.values:
            return ByName(self._record.layout.values)[name]
        return self._record.read(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._record.layout.values)

    def __contains__(self, name: object) -> bool:
        return name in self._record.layout.values

    def __repr__(self) -> str:
        return f"Values({', '.join(self)})"

    def __len__(self) -> int:
        return len(self._record.layout.values)


def totals(record: AbstractRecord) -> dict[str, Any]:
    """Statuses and steps of all trajectories, read block by block."""
    statuses, steps = Counter[int](), dict.fromkeys(("accepted", "rejected"), 0)
    for block in range(record.layout.blocks):
        statuses.update(record.rows("status", block).tolist())
        for name in steps:
            steps[name] += int(record.rows(name, block).sum())
    return {"statuses": _named(statuses), **steps}


def counted(status: np.ndarray) -> dict[str, int]:
    """Number of trajectories by the name of their status, "ok" first."""
    return _named(Counter(status.tolist()))


def _named(found: Mapping[int, int]) -> dict[str, int]:
    names = {NOT_COMPUTED: "not_computed", **{int(x): x.name for x in Status}}
    return {names[x]: found[x] for x in sorted(found, key=lambda x: (x != Status.ok, x))}


def _counts(statuses: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in statuses.items())
