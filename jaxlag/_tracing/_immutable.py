"""Mutability of the values in a program's key: a mutated value would leave the cache outdated."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from decimal import Context
from enum import Enum, EnumMeta
from functools import lru_cache, partial
from inspect import getattr_static
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

from jaxlag._core._errors import invalid
from jaxlag._tracing._defining_package import of_arrays, of_library
from jaxlag._tracing._free_variables import reading
from jaxlag._tracing._function_code import own_attributes, unwrapped
from jaxlag._tracing._strict_equality import is_bare, types_in
from jaxlag._tracing._watched_values import Outside, changes

_PLAIN = (bool, int, float, complex, str, bytes, NoneType, type(...), range)
_BASES = (np.generic, str, bytes, int, float, complex, tuple, frozenset)
_ARRAYS = (jax.Array, np.dtype)
_UNCHANGED = {
    *("jax", "jaxlib", "equinox", "jaxlag"),
    *("datetime", "decimal", "fractions", "logging", "operator", "pathlib", "re", "uuid"),
}
_CHANGING = (list, dict, set, bytearray, ModuleType, Context, np.void)
_FUNCTIONS = (FunctionType, BuiltinFunctionType, MethodType, partial)
_MUST = "be a number, an array, or an immutable and hashable object"
_LIVE = "then its numbers are read at every call."
_CHANGES = "can change in place"
_shown = Repr()
_shown.maxother = _shown.maxstring = 60

# Not a setting: values first read from outside by functions and classes in params.
_READ: WeakKeyDictionary[Any, Outside] = WeakKeyDictionary()


class _Place(NamedTuple):
    """A mutable part of an object, and its path from the outermost part inwards."""

    path: tuple[str, ...]
    thing: Any
    why: str = _CHANGES


class _Fault(NamedTuple):
    """The reason why an object cannot be part of a key, and the remedy."""

    text: str
    fix: str


def is_fixed(leaf: Any) -> bool:
    """Whether an untraced leaf is immutable, so that it may be part of a program's key."""
    return type(leaf) in _PLAIN or _fault(leaf) is None


def refusal(leaf: Any, name: str) -> ValueError:
    """The error for a leaf that is mutable."""
    fault = _fault(leaf)
    assert fault is not None
    return _refusal(leaf, name, fault)


def check_nodes(tree: Any, name: str) -> None:
    """Raise if a node of a pytree has mutable data or methods.

    Raises:
        ValueError: with the path of these.
    """
    try:
        structure = jax.tree.structure(tree)
        readers = _held(structure, types_in(structure))
    except (TypeError, ValueError):  # no hash, no equality, or no key
        readers = None
    if readers is not None and _changed(readers) is None:
        return
    for place, value, fault in _data(tree, name):
        if fault is not None:
            raise _refusal(value, place, fault)


def _refusal(leaf: Any, name: str, fault: _Fault) -> ValueError:
    return invalid(name, _MUST, f"it was {_text(leaf)}, and {fault.text}", fault.fix)


def _fault(x: Any, data: bool = False) -> _Fault | None:
    """The reason why a leaf, or the data of a node, cannot be part of a key."""
    search = _Search()
    place = search.data(x) if data else search.place(x, ())
    return _found(search, place, x, not data)


def _fault_of_kind(kind: type) -> _Fault | None:
    """The reason why methods and attributes of a user class cannot be part of a key."""
    search = _Search()
    return _found(search, search.kind(kind, ()), kind, False)


def _found(search: "_Search", place: _Place | None, x: Any, hashed: bool) -> _Fault | None:
    if place is not None:
        where = " of ".join(reversed(place.path))
        what = "class" if isinstance(place.thing, type) else type(place.thing).__name__
        what = f"{'an' if what[0] in 'aeioAEIO' else 'a'} {what}"
        thing = f"{where}, {what}," if where else what
        return _Fault(f"{thing} {place.why}", _fix(x, place))
    if hashed and not _hashes(x):
        return _Fault("it is not hashable", _fix(x, None))
    search.keep()
    change = _changed(search.readers)
    if change is None:
        return None
    reader, name, before, now = change
    by = "its methods read" if isinstance(reader, type) else "it reads"
    fix = _OF_CLASS if isinstance(reader, type) else _OF_FUNCTION
    return _Fault(f"{name}, which {by} from outside, was {before} before and is {now} now", fix)


def _changed(readers: Iterable[Any]) -> tuple[Any, str, str, str] | None:
    """The first value read by functions and classes that has changed."""
    for reader in readers:
        for name, before, now in changes(_READ.get(reader, {})):
            return reader, name, before, now
    return None


class _Search:
    """Searches an object for mutable parts.

    Attributes:
        readers: functions, and classes with methods, found in it.
    """

    def __init__(self) -> None:
        self.readers: list[Any] = []
        self._met: dict[int, Any] = {}
        self._read: list[tuple[Any, Outside]] = []

    def keep(self) -> None:
        """Store the values of the readers for later comparison."""
        for reader, found in self._read:
            if not any(isinstance(value, Tracer) for _, value in found.values()):
                _READ.setdefault(reader, found)

    def place(self, x: Any, path: tuple[str, ...]) -> _Place | None:
        """The mutable part of x; None if there is none."""
        kind = type(x)
        if kind in _PLAIN or id(x) in self._met or isinstance(x, _ARRAYS):
            return None
        self._met[id(x)] = x
        if isinstance(x, Enum):
            return self._member(x, path)
        if kind in (tuple, frozenset):
            return self._parts(((f"its element {i}", y) for i, y in enumerate(x)), path)
        if kind is slice:
            return self._parts(
                ((f"its {n}", getattr(x, n)) for n in ("start", "stop", "step")), path
            )
        if isinstance(x, EnumMeta):
            return self.kind(x, path) or self._parts(((repr(y), y) for y in x), path)
        if isinstance(x, type | ModuleType):
            return None if of_library(x) else _Place(path, x)
        if _is_function(x):
            return self._function(x, path)
        if isinstance(x, eqx.Module) or (is_dataclass(x) and _is_frozen(kind)):
            return self._record(x, path)
        if isinstance(x, tuple) and hasattr(kind, "_fields"):
            parts = ((f"its field {n!r}", y) for n, y in zip(kind._fields, x, strict=False))
            return self._instance(x, parts, path)
        if isinstance(x, _BASES) and not of_library(x):
            base = next(each for each in _BASES if isinstance(x, each))
            return _Place(path, x, f"is no plain {base.__name__}")
        return self._other(x, path)

    def data(self, x: Any) -> _Place | None:
        """The same for library data in a node: only functions and user objects in it."""
        if isinstance(x, tuple | list | dict) and of_library(x):
            items = x if not isinstance(x, dict) else x.values()
            return _first(self.data(y) for y in items)
        known = of_library(x) and not isinstance(x, type) and not _is_function(x)
        return None if known else self.place(x, ())

    def kind(self, kind: type, path: tuple[str, ...]) -> _Place | None:
        """The same for the methods and the attributes of a class."""
        if of_library(kind):
            return None
        return self._reader(kind, path, "which its methods read from outside")

    def _function(self, x: Any, path: tuple[str, ...]) -> _Place | None:
        if isinstance(x, MethodType):  # a new object at every access
            return self.place(x.__self__, (*path, "'self', which it reads from outside")) or (
                self.place(x.__func__, path)
            )
        if not _hashes(x):
            return None  # reported elsewhere
        return self._reader(x, path, "which it reads from outside")

    def _reader(self, x: Any, path: tuple[str, ...], reads: str) -> _Place | None:
        self.readers.append(x)
        if x in _READ:
            return None
        self._met[id(x)] = x
        found, sources = reading(x)
        self._read.append((x, found))
        return self._parts(((f"{name!r}, {reads}", y) for name, y in sources), path)

    def _member(self, x: Enum, path: tuple[str, ...]) -> _Place | None:
        parts = [("its value", x._value_)]
        parts += [(f"its attribute {n!r}", y) for n, y in own_attributes(x).items()]
        return self._instance(x, parts, path)

    def _record(self, x: Any, path: tuple[str, ...]) -> _Place | None:
        names, uncompared, _ = _form(type(x))
        if uncompared is not None:
            why = "is excluded from comparisons"
            return _Place((*path, f"its field {uncompared!r}"), getattr(x, uncompared), why)
        parts = [(f"its field {name!r}", getattr(x, name, None)) for name in names]
        if not getattr(x, "__dict__", {}).keys() <= names.keys():
            others = own_attributes(x)
            parts += [(f"its attribute {n!r}", y) for n, y in others.items() if n not in names]
        return self._instance(x, parts, path)

    def _instance(
        self, x: Any, parts: Iterable[tuple[str, Any]], path: tuple[str, ...]
    ) -> _Place | None:
        """The same for an object with methods."""
        if _form(type(x)).compares:
            return _Place(path, x, "has an __eq__ method of its own")
        return self._parts(parts, path) or self.kind(type(x), path)

    def _other(self, x: Any, path: tuple[str, ...]) -> _Place | None:
        kind = type(x)
        if isinstance(x, _CHANGING):
            return _Place(path, x)
        package = kind.__module__.partition(".")[0]
        if package in _UNCHANGED or isinstance(x, np.ufunc | np.generic) or kind is object:
            return None
        builtin = package == "builtins"
        return _Place(path, x, "is not hashable" if builtin else _CHANGES)

    def _parts(self, parts: Iterable[tuple[str, Any]], path: tuple[str, ...]) -> _Place | None:
        return _first(self.place(y, (*path, name)) for name, y in parts)


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


class _Form(NamedTuple):
    """Properties common to all objects of a class.

    Attributes:
        names: fields of a dataclass.
        uncompared: a field that is ignored in comparisons.
        compares: whether it has a custom __eq__.
    """

    names: dict[str, None]
    uncompared: str | None
    compares: bool


@lru_cache(maxsize=1024)
def _form(kind: Any) -> _Form:
    module = issubclass(kind, eqx.Module)
    own = fields(kind) if is_dataclass(kind) else ()
    values = getattr(kind, "__dataclass_params__", None)
    by_value = values is not None and values.eq and not module
    uncompared = [f.name for f in own if by_value and not f.compare]
    equal = getattr_static(kind, "__eq__")
    written = isinstance(equal, FunctionType) and equal.__code__.co_filename != "<string>"
    return _Form(
        dict.fromkeys(f.name for f in own),
        uncompared[0] if uncompared else None,
        written and not of_library(equal),
    )


@lru_cache(maxsize=1024)
def _held(structure: Any, types: Any) -> tuple[Any, ...]:
    """The functions and user classes in the nodes of a pytree with data of such types.

    Raises:
        TypeError: the nodes contain mutable data.
    """
    held, rest = {}, [structure]
    while rest:
        here = rest.pop()
        rest += here.children()
        kind, data = here.node_data() or (NoneType, None)
        search = _Search()
        if _fault_of_node(kind, data, search) is not None:
            raise TypeError(kind)
        held |= dict.fromkeys(search.readers)
    return tuple(held)


def _fault_of_node(kind: type, data: Any, search: "_Search") -> _Fault | None:
    """The reason why the data and the class of a node cannot be part of a key."""
    if is_bare(kind, data):
        return None
    if _is_known(kind):
        return _found(search, search.data(data), data, False)
    fault = _found(search, search.kind(kind, ()), kind, False)
    return fault or _found(search, search.place(data, ()), data, True)


def _is_known(kind: type) -> bool:
    """Whether the data of a node is internal to its library, apart from the given values."""
    return of_arrays(kind) or kind.__module__ in ("builtins", "collections")


def _data(tree: Any, name: str) -> Iterator[tuple[str, Any, _Fault | None]]:
    """Data of the nodes of a pytree, by path, with the reasons against it."""
    kind, data = jax.tree.structure(tree).node_data() or (NoneType, None)
    children, _ = jax.tree_util.tree_flatten_with_path(tree, lambda x: x is not tree)
    if not is_bare(kind, data):
        own = {id(child) for _, child in children}
        parts = fields(kind) if is_dataclass(kind) else ()
        found = [(f".{f.name}", getattr(tree, f.name, None)) for f in parts]
        found = [(part, value) for part, value in found if id(value) not in own]
        for part, value in found or [("", data)]:
            yield name + part, value, _fault(value, _is_known(kind))
        yield name, tree, None if of_library(kind) else _fault_of_kind(kind)
    for path, child in children:
        if child is not tree:
            yield from _data(child, name + jax.tree_util.keystr(path))


def _text(x: Any) -> str:
    text = " ".join(_shown.repr(x).split())
    return f"a {type(x).__name__}" if "Traced" in text or "Tracer" in text else text


_OF_FUNCTION = (
    "Pass in params what it reads; numbers and arrays of jax.numpy may be read from outside."
)
_OF_CLASS = (
    "Make it a field, or pass it in params; numbers and arrays of jax.numpy may be read from "
    "outside."
)


def _fix(x: Any, place: _Place | None) -> str:
    """The remedy."""
    if place is not None and "methods read" in " ".join(place.path):
        return _OF_CLASS
    if _is_function(x) or (place is not None and "it reads" in " ".join(place.path)):
        return _OF_FUNCTION
    if place is not None and place.why.startswith("is no plain"):
        return (
            f"Write {place.why.split()[-1]}(...) of it, and pass in params what its methods read."
        )
    if place is not None and isinstance(x, tuple | frozenset | list | dict) and of_library(x):
        x = place.thing  # the keys of a dict and the like
    if isinstance(x, Enum | type | ModuleType):
        return "Write a dict of the numbers that are read from it."
    if isinstance(x, set):
        return "Write a tuple for a set."
    if isinstance(x, slice):
        return "Write a tuple of its bounds, and the slice where it is used."
    if isinstance(x, list | dict):
        return "Make its field not static: then its contents are read at every call."
    if isinstance(x, SimpleNamespace):
        return f"Write a dict, for example by vars(): {_LIVE}"
    if isinstance(x, Mapping):
        return f"Write a dict: {_LIVE}"
    if isinstance(x, np.ndarray):
        return "Make its field not static: then arrays are read at every call."
    if is_dataclass(x):
        kind = type(x).__name__
        return (
            f"Register its class, jax.tree_util.register_dataclass({kind}), or make it an "
            f"eqx.Module: {_LIVE}"
        )
    if hasattr(type(x), "__array__") or hasattr(type(x), "to_dict"):
        return f"Write a dict, for example by to_dict(), or an array, by to_numpy(): {_LIVE}"
    if type(x).__module__ == "builtins":
        return "Write a tuple or an array of the numbers that are read from it."
    return f"Make its class an eqx.Module or a registered dataclass, or write a dict: {_LIVE}"
