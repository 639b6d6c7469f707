"""The package that defines an object."""

import re
import sys
from types import FunctionType, ModuleType
from typing import Any

_INSTALLED = re.compile(r"[/\\](site|dist)-packages[/\\]")
_ARRAYS = {
    *("jax", "jaxlib", "numpy", "equinox", "diffrax", "optax", "optimistix", "lineax"),
    *("jaxtyping", "jaxlag"),
}
_LIBRARIES = {*_ARRAYS, *sys.stdlib_module_names}


def of_library(x: Any) -> bool:
    """Whether Python or a JAX library defines a module, a class, a function or an object."""
    return _home(x) in _LIBRARIES


def of_arrays(x: Any) -> bool:
    """Whether a JAX library or jaxlag defines it."""
    return _home(x) in _ARRAYS


def is_installed(x: Any) -> bool:
    """Whether a module or a function belongs to an installed package."""
    file = x.__code__.co_filename if isinstance(x, FunctionType) else getattr(x, "__file__", None)
    return isinstance(file, str) and _INSTALLED.search(file) is not None


def _home(x: Any) -> str:
    """The name of its package."""
    if isinstance(x, ModuleType):
        name = x.__name__
    elif isinstance(x, FunctionType):
        name = x.__globals__.get("__name__")
    else:
        name = (x if isinstance(x, type) else type(x)).__module__
    return str(name).partition(".")[0]
