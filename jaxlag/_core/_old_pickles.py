"""Import errors for modules of an older layout, such as those named in old pickles.

All modules once lay in one folder. The finder is the last entry of `sys.meta_path`: it receives
only names that no other finder knows. If a package has the name of an old module, its
`__getattr__` raises the same error for the contents of that module.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from types import ModuleType
from typing import Any, NoReturn

_OLD = "jaxlag._"


def refuse(name: str) -> NoReturn:
    """Raise on a name that is no module of this version.

    Raises:
        ImportError: always.
    """
    raise ImportError(
        f"{name} must be a module or a name of this version of jaxlag, but it belongs to an older "
        "version, as in an old pickle. Create the pickle again. To store a motion, keep "
        "`motion.to_dict()`: every version reads these named arrays.",
        name=name,
    )


def missing(module: str, name: str) -> NoReturn:
    """`__getattr__` of a package: refuses the contents of an old module of the same name."""
    if name.startswith("_"):
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    refuse(f"{module}.{name}")


class _Finder(MetaPathFinder):
    """Finds no module."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> Any:
        """None for modules of other packages."""
        if fullname.startswith(_OLD):
            refuse(fullname)
        return None


def install() -> None:
    """Register the finder, once."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder())
