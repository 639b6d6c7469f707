"""Store: the trajectories of a sweep in a zarr group on disk, whatever ends the process.

Each array has one file for each block, which is written beside its place, synchronized with the
disk, and renamed; that of "status" is the last one. The SHA-256 digest of these files is then
written in the same way, as the entry of the block in the array "checksum": a sweep goes on with the
blocks whose entry does not fit their files.
"""

import logging
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, final

import jax
import numpy as np

from jaxlag._core._errors import invalid, requirement, unsupported
from jaxlag._core._status import Status
from jaxlag._sweep._files import remove_partial, write_whole
from jaxlag._sweep._problem import differences
from jaxlag._sweep._record import FACTS, NOT_COMPUTED, AbstractRecord, Layout, Rows
from jaxlag._sweep._store_folder import (
    CHECKSUM,
    FORMAT,
    beside,
    bring_back,
    check_alone,
    described,
    exists,
    folder_at,
    whole_files,
)

PENDING = 2
"""Blocks that wait for the disk."""
_INSTALL = 'pip install "jaxlag[sweep]"'
_logger = logging.getLogger("jaxlag")


@final
@dataclass(frozen=True)
class Store(AbstractRecord):
    """Arrays in a folder, which is a group of zarr 3.

    Attributes:
        path: of the folder.
        problem: what the trajectories depend on, by name.
    """

    path: Path
    problem: Mapping[str, Any]
    layout: Layout

    @property
    def checksum(self) -> str:
        """SHA-256 digest of those that the blocks have got; their files are not read."""
        return sha256(self.read(CHECKSUM).tobytes()).hexdigest()

    def missing(self) -> list[int]:
        """Those without an entry that fits their files."""
        found = []
        for block in range(self.layout.blocks):
            entry = self._file(CHECKSUM, block)
            if entry.exists() and entry.read_bytes() == self._digest(block):
                continue
            if entry.exists():
                _logger.warning("Block %d in %s was damaged; it is computed again.", block, self)
            found.append(block)
        return found

    def is_whole(self, block: int) -> bool:
        """Whether a block that counts as computed has all of its files, of the right size."""
        if not self._file(CHECKSUM, block).exists():
            return True
        for name, x in self.layout.arrays.items():
            size = self.layout.size * int(np.prod(x.shape)) * np.dtype(x.dtype).itemsize
            file = self._file(name, block)
            if not file.exists() or file.stat().st_size != size:
                return False
        return True

    @contextmanager
    def writer(self) -> Iterator[Callable[[int, Rows], None]]:
        """By a thread, while the next block is computed. After an error nothing more is written."""
        pending, errors = deque[Future[None]](), list[BaseException]()

        def attempt(block: int, rows: Rows) -> None:
            try:
                if not errors:
                    self._write(block, rows)
            except BaseException as error:
                errors.append(error)

        def write(block: int, rows: Rows) -> None:
            pending.append(thread.submit(attempt, block, rows))
            while len(pending) > PENDING:
                pending.popleft().result()
            if errors:
                raise errors[0]

        try:
            with ThreadPoolExecutor(1, "jaxlag-store") as thread:
                yield write
        finally:
            if errors:
                raise errors[0]

    def _write(self, block: int, rows: Rows) -> None:
        try:
            for name in (CHECKSUM, "status"):  # from here on the block is not computed
                self._file(name, block).unlink(missing_ok=True)
            digest = sha256(str(block).encode())
            for name, content in self._contents(block, rows):
                write_whole(self._file(name, block), content)
                digest.update(name.encode() + content)
            write_whole(self._file(CHECKSUM, block), digest.digest())
        except OSError as error:
            must = f"take block {block} of {self.layout.blocks}"
            was = f"writing to {self} failed: {error.strerror}"
            fix = "All blocks before it are kept: the same command goes on from there."
            raise OSError(error.errno, requirement("store", must, was, fix)) from error

    def _contents(self, block: int, rows: Rows) -> Iterator[tuple[str, bytes]]:
        """(name, file) of each array; trajectories that do not exist have the value of no entry."""
        within, arrays = self.layout.within(block), self.layout.arrays
        for name in self._order:
            shape, dtype = arrays[name].shape, _on_disk(arrays[name].dtype)
            whole = np.full((self.layout.size, *shape), _absent(name, dtype), dtype)
            whole[: within.stop - within.start] = rows[name]
            yield name, whole.tobytes()

    @property
    def _order(self) -> list[str]:
        """Names of arrays in the order of writing: trajectories with a status have all others."""
        return sorted(self.layout.arrays, key=lambda name: (name == "status", name))

    def _digest(self, block: int) -> bytes | None:
        """Of the index and the files of a block; None if one cannot be read."""
        digest = sha256(str(block).encode())
        for name in self._order:
            try:
                digest.update(name.encode() + self._file(name, block).read_bytes())
            except OSError:
                return None
        return digest.digest()

    def _file(self, name: str, block: int) -> Path:
        """The file of a block, by the usual keys of zarr 3: c/block/0/0..."""
        rank = 1 if name == CHECKSUM else len(self.layout.arrays[name].shape)
        return self.path.joinpath(name, "c", str(block), *["0"] * rank)

    def read(self, name: str) -> np.ndarray:
        """Into memory."""
        self._check_same()
        with whole_files(self.path):
            return np.asarray(_zarr().open_array(store=self.path / name, mode="r")[:])

    def rows(self, name: str, block: int) -> np.ndarray:
        """Into memory."""
        within, x = self.layout.within(block), self.layout.arrays[name]
        found = np.fromfile(self._file(name, block), _on_disk(x.dtype))
        return found.reshape(-1, *x.shape)[: within.stop - within.start]

    def to_xarray(self) -> Any:
        """Of lazy arrays of dask, a chunk for each block."""
        try:
            import dask.array  # noqa: F401
            import xarray
        except ImportError as error:
            why = f"{error.name} is not installed"
            raise unsupported("`to_xarray` of a store", why, _INSTALL) from error
        self._check_same()
        return xarray.open_zarr(self.path, consolidated=False, drop_variables=CHECKSUM)

    def _check_same(self) -> None:
        """Raise if the folder has another sweep now."""
        if different := differences(described(self.path)["problem"], self.problem):
            must, was = "still hold this sweep", f"{self.path} was overwritten: {different}"
            raise invalid("store", must, was)

    def __str__(self) -> str:
        return str(self.path)


def _zarr() -> Any:
    try:
        import zarr
    except ImportError as error:
        raise unsupported("`store`", "zarr is not installed", _INSTALL) from error
    return zarr


def _on_disk(dtype: Any) -> np.dtype:
    return np.dtype(dtype).newbyteorder("<")


def _absent(name: str, dtype: np.dtype) -> Any:
    """The entry of a trajectory that is not computed."""
    if name in ("status", "where"):
        return NOT_COMPUTED
    return np.nan if dtype.kind == "f" else np.zeros((), dtype)[()]


# ---- Creation ------------------------------------------------------------------------------------


def created(path: Any, problem: Mapping[str, Any], layout: Layout, overwrite: bool) -> Store:
    """The store of a sweep at this path: a new one, or that which is there.

    Args:
        path: of its folder.
        problem: what the trajectories depend on.
        layout: the arrays.
        overwrite: whether a store of another sweep is replaced.

    Raises:
        ValueError: there is something else, or a store of another sweep, whose difference is named.
    """
    folder = folder_at(path)
    _zarr()
    _check_names(layout)
    new, old = beside(folder)
    try:
        bring_back(folder)
        there = described(folder) if exists(folder) else None
        different = differences(there["problem"], problem) if there else ""
        if different and not overwrite:
            must, was = "hold trajectories of this sweep", f"{folder} differs in {different}"
            raise invalid("store", must, was, "Choose another path, or give overwrite=True.")
        shutil.rmtree(new, ignore_errors=True)
        _write_empty(new, problem, layout)
        if different:
            check_alone(folder)
            os.replace(folder, old)
        if exists(folder):
            _mend(folder, new)
        else:
            os.replace(new, folder)
    except OSError as error:
        must, was = "be a folder that can be written", f"{folder} cannot: {error.strerror}"
        raise invalid("store", must, was) from error
    finally:
        bring_back(folder)
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)
    remove_partial(folder)
    return Store(folder, problem, layout)


def opened(path: Any) -> Store:
    """The store at a path.

    Raises:
        ValueError: there is none; a file of a trajectory that is computed is missing or cut.
    """
    folder = folder_at(path)
    problem = described(folder)["problem"]
    zarr = _zarr()
    with whole_files(folder):
        found = {
            name: zarr.open_array(store=folder / name, mode="r")
            for name in (*problem["values"], *FACTS, "t", CHECKSUM)
        }
        rows = {name: jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for name, x in found.items()}
        (count, size), ts = (found["status"].shape[0], found["status"].chunks[0]), found["t"]
        del rows[CHECKSUM]
        common = None
        if ts.ndim == 1:
            common = np.fromfile(folder / "t" / "c" / "0", _on_disk(ts.dtype)).reshape(ts.shape)
            del rows["t"]
        values = {name: rows.pop(name) for name in problem["values"]}
        store = Store(folder, problem, Layout(count, size, common, values, rows))
        for block in range(store.layout.blocks):
            if not store.is_whole(block):
                raise ValueError(f"block {block}")
    return store


def _mend(folder: Path, empty: Path) -> None:
    """Write the metadata and the times again where they are not as in an empty store."""
    for path in filter(Path.is_file, empty.rglob("*")):
        target, content = folder / path.relative_to(empty), path.read_bytes()
        if not target.is_file() or target.read_bytes() != content:
            _logger.warning("%s was damaged; it is written again.", target)
            write_whole(target, content)


def _check_names(layout: Layout) -> None:
    """Names of arrays are names of folders, which some systems compare without case."""
    taken = {name: name for name in (*FACTS, "t", CHECKSUM)}
    for name in layout.values:
        other = taken.get(name.casefold())
        if other is not None:
            was = f"{name!r} and {other!r} are both names of arrays in a store"
            raise invalid("keep", "have names that differ by more than case", was)
        taken[name.casefold()] = name
        if set(name) & set('/\\:*?"<>|') or name.startswith((".", "__")) or name == "zarr.json":
            must = "have names that can be those of folders"
            raise invalid("keep", must, f"one was {name!r}")


def _write_empty(folder: Path, problem: Mapping[str, Any], layout: Layout) -> None:
    """A store without trajectories, synchronized with the disk."""
    zarr = _zarr()
    folder.mkdir(parents=True)
    attributes = {"jaxlag": {"format": FORMAT, "problem": problem}, "coordinates": "t"}
    zarr.create_group(store=folder, attributes=attributes)

    def array(name: str, shape: Any, chunks: Any, dtype: Any, axes: Any, **more: Any) -> Any:
        return zarr.create_array(
            store=folder,
            name=name,
            shape=shape,
            chunks=chunks,
            dtype=_on_disk(dtype),
            fill_value=_absent(name, _on_disk(dtype)),
            dimension_names=axes,
            compressors=None,
            filters=None,
            attributes=more,
        )

    n, size = layout.count, layout.size
    array(CHECKSUM, (layout.blocks, 32), (1, 32), np.uint8, ("block", "byte"))
    along = "t"
    if layout.ts is None:
        along = "save"
    else:
        times = array("t", layout.ts.shape, layout.ts.shape, layout.ts.dtype, ("t",), units="s")
        times[:] = layout.ts
    for name, x in layout.arrays.items():
        axes, more = ["motion"], {}
        if name in layout.values or name == "t":
            axes += [along, *(f"{name}_{i}" for i in range(len(x.shape) - 1))]
        if name in ("t", "last_time"):
            more["units"] = "s"
        if name == "status":
            more["flag_values"] = [NOT_COMPUTED, *map(int, Status)]
            more["flag_meanings"] = " ".join(["not_computed", *(x.name for x in Status)])
        array(name, (n, *x.shape), (size, *x.shape), x.dtype, axes, **more)
    for path in filter(Path.is_file, folder.rglob("*")):
        with open(path, "rb") as file:
            os.fsync(file.fileno())
