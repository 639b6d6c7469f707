"""Files that exist as a whole or not at all."""

import os
from pathlib import Path
from uuid import uuid4

_BESIDE = ".partial"


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside its place, synchronize it with the disk, and rename it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f"{path.name}.{uuid4().hex}{_BESIDE}")
    try:
        with open(beside, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def remove_partial(folder: Path) -> None:
    """Remove what processes left that were killed while they wrote."""
    for path in folder.rglob(f"*{_BESIDE}"):
        if path.is_file():
            path.unlink(missing_ok=True)
