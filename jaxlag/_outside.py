"""What a Python function reads from outside its arguments: globals, closures, attributes."""

from collections.abc import Callable, Iterator
from dis import get_instructions
from functools import partial
from inspect import unwrap
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

LEAVES = 1000  # of a container that are looked at
ELEMENTS = 100_000  # of an array
DEPTH = 4  # of functions that call functions


class Read(NamedTuple):
    """A value from outside.

    Attributes:
        look: how to read it again.
        value: as it was; arrays that can be changed in place are copied.
    """

    look: Callable[[], Any]
    value: Any


Outside = dict[str, Read]
_GONE = object()
_STORES = ("STORE_GLOBAL", "STORE_DEREF")
_FUNCTIONS = (FunctionType, MethodType)
_NUMBERS = (bool, int, float, complex, str, np.generic)


def outside(function: Callable) -> Outside:
    """By name, what a function reads from outside: numbers, arrays, and functions of the user's.

    Containers of numbers are read whole, of other objects the attributes that the code names.
    """
    found: Outside = {}
    _read(function, found, set(), DEPTH)
    return found


def changes(read: Outside) -> Iterator[tuple[str, str, str]]:
    """(name, what it was, what it is now) of all that has changed."""
    for name, (look, before) in read.items():
        now = _value(look())
        if not _same(before, now):
            yield name, _words(before), _words(now)


def _read(function: Any, found: Outside, met: set[int], depth: int) -> None:
    if isinstance(function, MethodType):
        codes = list(_codes(function.__func__.__code__))
        _attributes("self", partial(getattr, function, "__self__"), codes, found)
        function = function.__func__
    function = _unwrapped(function)
    if not isinstance(function, FunctionType) or id(function) in met or depth == 0:
        return
    met.add(id(function))
    codes = list(_codes(function.__code__))
    space = function.__globals__
    looks: dict[str, Callable[[], Any]] = {}
    for name in {name for code in codes for name in code.co_names}:
        if name in space:
            looks[name] = lambda name=name: space.get(name, _GONE)
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        looks[name] = lambda cell=cell: _content(cell)
    stored = {i.argval for code in codes for i in get_instructions(code) if i.opname in _STORES}
    for name, look in looks.items():
        if name in stored:  # counters and the like
            continue
        value = look()
        if isinstance(_unwrapped(value), _FUNCTIONS):
            if getattr(value, "__module__", None) != function.__module__:
                continue  # of a library
            found.setdefault(name, Read(look, value))
            _read(value, found, met, depth - 1)
        elif isinstance(value, ModuleType | type):
            continue
        elif _value(value) is not None:
            found.setdefault(name, Read(look, _value(value)))
        else:
            _attributes(name, look, codes, found)


def _unwrapped(x: Any) -> Any:
    """The function inside jit and the like."""
    try:
        return unwrap(x)
    except ValueError:  # whatever has every attribute
        return x


def _codes(code: CodeType) -> Iterator[CodeType]:
    """A code and those of the functions written inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not set yet
        return _GONE


def _attributes(owner: str, look: Callable[[], Any], codes: list, found: Outside) -> None:
    """Those attributes of an object that the code names."""
    own = getattr(look(), "__dict__", {})
    for name in {name for code in codes for name in code.co_names}:
        value = _value(own.get(name, _GONE))
        if value is not None and value is not _GONE:

            def again(name: str = name) -> Any:
                return getattr(look(), name, _GONE)

            found.setdefault(f"{owner}.{name}", Read(again, value))


def _value(x: Any) -> Any:
    """A number, an array or a container of them as it is now; None for anything else."""
    if x is _GONE or isinstance(x, (*_NUMBERS, jax.Array)) or isinstance(_unwrapped(x), _FUNCTIONS):
        return x
    if isinstance(x, np.ndarray):
        return x.copy() if 0 < x.size <= ELEMENTS and x.dtype != object else None
    if isinstance(x, dict | list | tuple):
        leaves, tree = jax.tree.flatten(x)
        known = len(leaves) <= LEAVES and not any(
            isinstance(y, dict | list | tuple) for y in leaves
        )
        values = list(map(_value, leaves)) if known else [None]
        return None if any(value is None for value in values) else (tree, values)
    return None


def _same(before: Any, now: Any) -> bool:
    if before is now:
        return True
    if isinstance(before, tuple) and isinstance(now, tuple):
        pairs = zip(before[1], now[1], strict=False)
        return before[0] == now[0] and all(_same(x, y) for x, y in pairs)
    if isinstance(before, Tracer) or isinstance(now, Tracer):
        return False
    kinds = (np.ndarray, jax.Array, *_NUMBERS)
    if not isinstance(before, kinds) or not isinstance(now, kinds):
        return False
    x, y = np.asarray(before), np.asarray(now)
    return (
        x.shape == y.shape and x.dtype == y.dtype and bool(np.all((x == y) | ((x != x) & (y != y))))
    )


def _words(value: Any) -> str:
    if value is _GONE:
        return "gone"
    if isinstance(value, tuple):
        value = jax.tree.unflatten(*value)
    if isinstance(value, Tracer):
        return "a traced value"
    if isinstance(value, _FUNCTIONS):
        return f"{value.__qualname__} at {id(value):#x}"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
