"""Pickles name the modules that hold their classes: those of an older layout are refused by name.

All modules once lay in one folder. The finder, an entry of `sys.meta_path`, is the last that Python
asks, so that it is met by names alone that nobody else finds; a package that has the name of an old
module says the same of what that module held.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from types import ModuleType
from typing import Any, NoReturn

_OLD = "jaxlag._"


def refuse(name: str) -> NoReturn:
    """Raise on a name that is of no module of this version.

    Raises:
        ImportError: always.
    """
    raise ImportError(
        f"{name} must be a module or a name of this version of jaxlag, but it was of an older one, "
        "as those in older pickles are. Make the pickle anew; of motions keep `to_dict()`: arrays "
        "by name, which every version reads.",
        name=name,
    )


def missing(module: str, name: str) -> NoReturn:
    """`__getattr__` of a package: as any module, but of what was in the module of that name."""
    if name.startswith("_"):
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    refuse(f"{module}.{name}")


class _Finder(MetaPathFinder):
    """Finds nothing."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> Any:
        """None of modules of others."""
        if fullname.startswith(_OLD):
            refuse(fullname)
        return None


def install() -> None:
    """Have Python ask, once."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder())
