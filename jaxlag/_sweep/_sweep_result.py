"""SweepResult: what the trajectories of a sweep saved, and how each of them ended."""

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxlag._core._by_name import ByName
from jaxlag._core._errors import invalid, requirement
from jaxlag._core._status import Status
from jaxlag._simulation._solution_views import dataset
from jaxlag._sweep._block import BlockKey, block_indices, cases_in
from jaxlag._sweep._case import Case
from jaxlag._system._system import System


class SweepReport(NamedTuple):
    """What a sweep took.

    Attributes:
        trajectories: their number.
        statuses: number of trajectories by the name of their status.
        accepted: steps of all trajectories.
        rejected: attempted steps that were not accepted.
        seconds: of the whole sweep.
        first_seconds: until the first block was done, which includes compiling.
        block: number of trajectories of a block.
    """

    trajectories: int
    statuses: dict[str, int]
    accepted: int
    rejected: int
    seconds: float
    first_seconds: float
    block: int


@final
class SweepResult(eqx.Module):
    """What n trajectories saved, in the order of their indices.

    `run["theta"]` is what was kept by that name. Entries that were not reached are NaN.

    Attributes:
        system: the mechanical system.
        ts: times in s, (s,), or (n, s) if each case has its own.
        values: what was kept by name, each (n, s, *its shape).
        status: how each trajectory ended, (n,), see `Status`.
        where: index of the coordinate or row that a failure concerns, (n,); -1 if none.
        last_time: last time reached by each, (n,), s.
        accepted: steps of each, (n,).
        rejected: its attempted steps that were not accepted, (n,).
        report: what the sweep took.
    """

    system: System
    ts: Float[np.ndarray, "*n s"]
    values: Mapping[str, np.ndarray]
    status: Int[np.ndarray, " n"]
    where: Int[np.ndarray, " n"]
    last_time: Float[np.ndarray, " n"]
    accepted: Int[np.ndarray, " n"]
    rejected: Int[np.ndarray, " n"]
    report: SweepReport
    _key: BlockKey = eqx.field(static=True)
    _cases: Any = eqx.field(static=True)

    def __len__(self) -> int:
        """Number of trajectories."""
        return len(self.status)

    @property
    def ok(self) -> Bool[np.ndarray, " n"]:
        """Whether each trajectory reached its last time."""
        return self.status == int(Status.ok)

    def __getitem__(self, name: str) -> np.ndarray:
        """What was kept by this name, (n, s, *its shape).

        Raises:
            KeyError: no such name.
        """
        return ByName(self.values)[name]

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

    def message(self) -> str:
        """How the trajectories ended: counts by status, and the first of each except "ok".

        `jl.replay(run, index).message()` says more of one of them.
        """
        lines = [f"{len(self)} trajectories: {_counts(self.report.statuses)}"]
        for status in sorted({int(x) for x in self.status} - {int(Status.ok)}):
            index = int(np.argmax(self.status == status))
            time = float(self.last_time[index])
            lines.append(f"[{index}]: {Status(status).name}, last good state at t = {time:.6g}")
        return "\n".join(lines)

    def to_xarray(self) -> Any:
        """A dataset with the axes motion and t (or save, if each case has its own times).

        Raises:
            ValueError: xarray is not installed.
        """
        ts = self.ts if self.ts.ndim > 1 else np.broadcast_to(self.ts, (len(self), *self.ts.shape))
        names = ("status", "where", "last_time", "accepted", "rejected")
        return dataset(ts, self.values, {name: getattr(self, name) for name in names})

    def __repr__(self) -> str:
        kept, counts = ", ".join(self.values), _counts(self.report.statuses)
        return f"SweepResult({kept}: {len(self)} trajectories, {self.ts.shape[-1]} times, {counts})"


def counted(status: np.ndarray) -> dict[str, int]:
    """Number of trajectories by the name of their status, "ok" first."""
    found = Counter(int(x) for x in status)
    return {Status(x).name: found[x] for x in sorted(found, key=lambda x: (x != Status.ok, x))}


def _counts(statuses: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in statuses.items())
