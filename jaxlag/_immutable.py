"""What of a program's key can change: a compiled program would answer as of what it was."""

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from enum import Enum, EnumMeta
from functools import lru_cache, partial
from reprlib import Repr
from types import (
    BuiltinFunctionType,
    FunctionType,
    MethodType,
    ModuleType,
    NoneType,
    SimpleNamespace,
)
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from jaxlag._errors import bad
from jaxlag._outside import (
    Outside,
    changes,
    of_class,
    of_library,
    outside,
    sources,
    unwrapped,
)

_PLAIN = (bool, int, float, complex, str, bytes, NoneType, type(...), range)
_VALUES = (*_PLAIN, np.generic, np.dtype, jax.Array)
_UNCHANGED = {
    *("jax", "jaxlib", "equinox", "jaxlag"),
    *("datetime", "decimal", "fractions", "operator", "pathlib", "re", "uuid"),
}
_FUNCTIONS = (FunctionType, BuiltinFunctionType, MethodType, partial)
_BUILTIN = (dict, list, tuple, NoneType)
_MUST = "be a number, an array, or an object that cannot change and that hashes"
_LIVE = "its numbers are read at every call then."
_shown = Repr()
_shown.maxother = _shown.maxstring = 60

# Not a setting: what functions and classes in params read from outside when they were first given.
_READ: WeakKeyDictionary[Any, Outside] = WeakKeyDictionary()


class _Place(NamedTuple):
    """What can change of an object, and where it is: from the outermost part to the inmost."""

    path: tuple[str, ...]
    what: str


def is_fixed(leaf: Any) -> bool:
    """Whether a leaf without numbers to trace is the same for ever, so that programs may key it."""
    return type(leaf) in _PLAIN or not _fault(leaf)


def refusal(leaf: Any, name: str) -> ValueError:
    """Why it is not, and what to write."""
    return bad(name, _MUST, f"it was {_words(leaf)}, and {_fault(leaf)}", _fix(leaf))


def check_nodes(tree: Any, name: str) -> None:
    """Raise where a node of a pytree has data that can change, as a list in a static field is.

    Raises:
        ValueError: with these by their path.
    """
    try:
        kinds, functions = _held(jax.tree.structure(tree))
        fixed = all(map(is_fixed, functions))
    except (TypeError, ValueError):  # no hash, no equality, or no key
        kinds, fixed = (), False
    if not fixed:
        for place, value in _data(tree, name):
            if not is_fixed(value):
                raise refusal(value, place)
    for kind in kinds:
        for what, before, now in changes(_read(kind)):
            message = (
                f"{what}, which {kind.__name__} in {name} reads from outside, was {before} when "
                f"{kind.__name__} was first given and is {now} now: compiled programs keep the "
                "former. Make it a field."
            )
            warnings.warn(message, UserWarning, stacklevel=2)


def _fault(leaf: Any) -> str:
    """What stands against it as part of a key; "" where nothing does."""
    known = _is_function(leaf) and _hashes(leaf) and leaf in _READ
    place = None if known else _mutable(leaf, ())
    if place is not None:
        where = " of ".join(reversed(place.path))
        thing = f"{where}, a {place.what}," if where else f"a {place.what}"
        return f"{thing} can change in place"
    if not _hashes(leaf):
        return "it does not hash"
    for reader in _readers(leaf):
        for name, before, now in changes(_read(reader)):
            return f"{name}, which it reads from outside, was {before} before and is {now} now"
    return ""


def _mutable(x: Any, path: tuple[str, ...]) -> _Place | None:
    """Where and what of x can change; None where nothing can."""
    if isinstance(x, Enum):
        return _mutable(x.value, (*path, "its value"))
    if isinstance(x, tuple | frozenset) and not getattr(x, "__dict__", None):
        return _first(_mutable(y, (*path, f"its element {i}")) for i, y in enumerate(x))
    if isinstance(x, _VALUES) and (not getattr(x, "__dict__", None) or isinstance(x, jax.Array)):
        return None
    if isinstance(x, type | ModuleType):
        known = of_library(x) or isinstance(x, EnumMeta)
        return None if known else _Place(path, "class" if isinstance(x, type) else "module")
    if _is_function(x):
        read = ((f"{name!r}, which it reads from outside", y) for name, y in sources(x))
        return _first(_mutable(y, (*path, name)) for name, y in read if y is not x)
    if isinstance(x, eqx.Module) or (is_dataclass(x) and _is_frozen(type(x))):
        own = ((f"its field {f.name!r}", getattr(x, f.name, None)) for f in fields(x))
        return _first(_mutable(y, (*path, name)) for name, y in own)
    package = type(x).__module__.partition(".")[0]
    if package in _UNCHANGED or isinstance(x, np.ufunc) or type(x) is object:
        return None
    return _Place(path, type(x).__name__)


def _readers(x: Any) -> Iterator[Any]:
    """The functions, and the classes with methods, in something that cannot change."""
    if _is_function(x):
        yield x
    elif isinstance(x, tuple | frozenset):
        for part in x:
            yield from _readers(part)
    elif is_dataclass(x) and not isinstance(x, type) and not of_library(x):
        yield type(x)
        for f in fields(x):
            yield from _readers(getattr(x, f.name, None))


def _first(places: Iterable[_Place | None]) -> _Place | None:
    return next((place for place in places if place is not None), None)


def _is_function(x: Any) -> bool:
    return isinstance(x, _FUNCTIONS) or isinstance(unwrapped(x), _FUNCTIONS)


def _is_frozen(kind: Any) -> bool:
    return kind.__dataclass_params__.frozen


def _hashes(x: Any) -> bool:
    try:
        hash(x)
    except TypeError:
        return False
    return True


def _read(x: Any) -> Outside:
    """What a function, or the methods of a class, read from outside when they were first given."""
    try:
        if x in _READ:
            return _READ[x]
        read = of_class(x) if isinstance(x, type) else outside(x)
        traced = any(isinstance(value, Tracer) for _, value in read.values())
        return {} if traced else _READ.setdefault(x, read)
    except TypeError:  # of no weak reference
        return {}


@lru_cache(maxsize=1024)
def _held(structure: Any) -> tuple[tuple[type, ...], tuple[Any, ...]]:
    """(classes of the user's, functions that they hold) in the nodes of a pytree.

    Raises:
        TypeError: what they hold besides their children can change.
    """
    kinds, held, rest = {}, [], [structure]
    while rest:
        here = rest.pop()
        rest += here.children()
        kind, data = here.node_data() or (NoneType, None)
        if not _holds(kind):
            continue
        if not is_fixed(data):
            raise TypeError(kind)
        held += _readers(data)
        kinds |= {} if of_library(kind) else {kind: None}
    return tuple(kinds), tuple(held)


def _holds(kind: type) -> bool:
    """Whether nodes of a pytree may hold what a user put there besides their children."""
    return kind is jax.tree_util.Partial or not (issubclass(kind, _BUILTIN) or of_library(kind))


def _data(tree: Any, name: str) -> Iterator[tuple[str, Any]]:
    """What nodes of a pytree hold besides their children, by path."""
    kind, data = jax.tree.structure(tree).node_data() or (NoneType, None)
    children, _ = jax.tree_util.tree_flatten_with_path(tree, lambda x: x is not tree)
    if _holds(kind):
        own = {id(child) for _, child in children}
        parts = fields(kind) if is_dataclass(kind) else ()
        found = [(f".{f.name}", getattr(tree, f.name, None)) for f in parts]
        found = [(part, value) for part, value in found if id(value) not in own]
        for part, value in found or [("", data)]:
            yield name + part, value
    for path, child in children:
        if child is not tree:
            yield from _data(child, name + jax.tree_util.keystr(path))


def _words(x: Any) -> str:
    text = " ".join(_shown.repr(x).split())
    return f"a {type(x).__name__}" if "Traced" in text or "Tracer" in text else text


def _fix(x: Any) -> str:
    """What to write in its place."""
    if _is_function(x):
        return "Hand over in params what it reads; numbers and arrays of jax.numpy may stay."
    if isinstance(x, type | ModuleType):
        return "Write a dict of the numbers that are read from it."
    if isinstance(x, set):
        return "Write a tuple for a set."
    if isinstance(x, SimpleNamespace):
        return f"Write a dict, as by vars: {_LIVE}"
    if isinstance(x, np.ndarray):
        return "Make its field no static one: arrays are read at every call then."
    if is_dataclass(x):
        kind = type(x).__name__
        return (
            f"Register its class, jax.tree_util.register_dataclass({kind}), or make it an "
            f"eqx.Module: {_LIVE}"
        )
    if hasattr(type(x), "__array__") or hasattr(type(x), "to_dict"):
        return f"Write a dict, as by to_dict(), or an array, as by to_numpy(): {_LIVE}"
    return f"Make its class an eqx.Module or a registered dataclass, or write a dict: {_LIVE}"
