"""The folder of a store: its place, what is in it, and what takes its place."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxlag._core._errors import invalid
from jaxlag._sweep._record import FACTS

CHECKSUM = "checksum"
"""Name of the array of the digests of blocks."""
FORMAT = 1
"""Of the files."""


def folder_at(path: Any) -> Path:
    """The folder of this path, without links; raises if there can be none."""
    text = str(path)
    if not isinstance(path, str | os.PathLike) or not text or "://" in text or "\0" in text:
        raise invalid("store", "be the path of a local folder", f"it was {path!r}")
    try:
        folder = Path(path).expanduser().resolve()
        folder.exists()
    except (OSError, RuntimeError) as error:
        was = f"{path!r} is none: {_first_line(error)}"
        raise invalid("store", "be the path of a local folder", was) from error
    if not folder.name:
        raise invalid("store", "be the path of a local folder", f"it was {path!r}")
    return folder


def exists(folder: Path) -> bool:
    """Whether something is there but an empty folder."""
    return folder.exists() and not (folder.is_dir() and not any(folder.iterdir()))


def described(folder: Path) -> Mapping[str, Any]:
    """What a sweep wrote about itself; raises if there is none."""
    try:
        found = json.loads((folder / "zarr.json").read_text())["attributes"]["jaxlag"]
        if found["format"] != FORMAT or not isinstance(found["problem"]["values"], list):
            raise ValueError(found)
    except (OSError, ValueError, LookupError, TypeError) as error:
        must, was = f"be a store of jl.sweep of format {FORMAT}", f"{folder} is none"
        raise invalid("store", must, was, "Check the path, or choose another one.") from error
    return found


@contextmanager
def whole_files(folder: Path) -> Iterator[None]:
    """What zarr raises for damaged files, as one sentence."""
    try:
        yield
    except (OSError, ValueError, LookupError, TypeError) as error:
        must, was = "have whole files", f"one in {folder} is not: {_first_line(error)}"
        raise invalid("store", must, was, "The same jl.sweep writes it again.") from error


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0].rstrip(".")


def beside(folder: Path) -> tuple[Path, Path]:
    """(the store that takes the place of another one, the other one)."""
    name = folder.name
    return folder.with_name(f".{name}.jaxlag-new"), folder.with_name(f".{name}.jaxlag-old")


def bring_back(folder: Path) -> None:
    """The store that a new one should have replaced, if that has not happened."""
    _, old = beside(folder)
    if old.exists() and not exists(folder):
        os.replace(old, folder)


def check_alone(folder: Path) -> None:
    """Raise if there are other files among those of a store, which is to be removed."""
    names = {*described(folder)["problem"]["values"], *FACTS, "t", CHECKSUM, "zarr.json"}
    others = sorted({path.name for path in folder.iterdir()} - names)
    if others:
        must, was = "hold nothing else to be overwritten", f"{folder} holds {others}"
        raise invalid("store", must, was, "Move these files.")
