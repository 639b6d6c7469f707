"""Records: where the trajectories of a sweep are kept, block by block."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any, final

import jax
import numpy as np

from jaxlag._simulation._solution_views import dataset

FACTS = ("status", "where", "last_time", "accepted", "rejected")
"""What is kept of every trajectory beside its saved values."""
NOT_COMPUTED = -1
"""In place of the status of a trajectory that is still to be computed."""

Rows = Mapping[str, np.ndarray]
"""Arrays by name for the trajectories of a block, one entry for each."""


@dataclass(frozen=True)
class Layout:
    """The arrays of a sweep.

    Attributes:
        count: number of trajectories.
        size: number of trajectories of a block.
        ts: times for all of them, (s,) in s; None if each has its own, which are called "t" then.
        values: shape and dtype of what each trajectory saves, by name: (s, ...).
        facts: the same of what is known of it as a whole.
    """

    count: int
    size: int
    ts: np.ndarray | None
    values: Mapping[str, jax.ShapeDtypeStruct]
    facts: Mapping[str, jax.ShapeDtypeStruct]

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return -(-self.count // self.size)

    @property
    def arrays(self) -> Mapping[str, jax.ShapeDtypeStruct]:
        """Values and facts."""
        return {**self.values, **self.facts}

    def within(self, block: int) -> slice:
        """The trajectories of a block."""
        return slice(block * self.size, min((block + 1) * self.size, self.count))

    def trajectories(self, blocks: list[int]) -> int:
        """Number of trajectories of some blocks."""
        slices = map(self.within, blocks)
        return sum(within.stop - within.start for within in slices)


class AbstractRecord(ABC):
    """What is kept of the trajectories of a sweep.

    Attributes:
        layout: its arrays.
    """

    layout: Layout

    @abstractmethod
    def missing(self) -> list[int]:
        """Indices of the blocks that are still to be computed, in order."""

    @abstractmethod
    def writer(self) -> AbstractContextManager[Callable[[int, Rows], None]]:
        """A function (index of a block, its rows) that keeps them; all are kept after it."""

    @abstractmethod
    def read(self, name: str) -> np.ndarray:
        """An array of all trajectories, (n, ...)."""

    @abstractmethod
    def rows(self, name: str, block: int) -> np.ndarray:
        """The same of the trajectories of a block."""

    @abstractmethod
    def to_xarray(self) -> Any:
        """A dataset."""


@final
@dataclass(frozen=True)
class InMemory(AbstractRecord):
    """Arrays in memory."""

    layout: Layout
    _arrays: dict[str, np.ndarray] = field(default_factory=dict)

    def missing(self) -> list[int]:
        """All of them."""
        return list(range(self.layout.blocks))

    @contextmanager
    def writer(self) -> Iterator[Callable[[int, Rows], None]]:
        """Into the arrays."""

        def write(block: int, rows: Rows) -> None:
            for name, x in self.layout.arrays.items():
                if name not in self._arrays:
                    self._arrays[name] = np.empty((self.layout.count, *x.shape), x.dtype)
                self._arrays[name][self.layout.within(block)] = rows[name]

        yield write

    def read(self, name: str) -> np.ndarray:
        """The array itself."""
        return self._arrays[name]

    def rows(self, name: str, block: int) -> np.ndarray:
        """A view."""
        return self._arrays[name][self.layout.within(block)]

    def to_xarray(self) -> Any:
        """In memory, too."""
        layout = self.layout
        ts = layout.ts
        ts = self.read("t") if ts is None else np.broadcast_to(ts, (layout.count, *ts.shape))
        values = {name: self.read(name) for name in layout.values}
        return dataset(ts, values, {name: self.read(name) for name in FACTS})
