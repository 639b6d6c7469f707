"""What a Python function reads from outside its arguments: globals, closures, attributes."""

import sys
from collections.abc import Callable, Iterator, Mapping
from dis import get_instructions
from enum import Enum
from functools import cached_property, partial
from inspect import getattr_static, unwrap
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType, NoneType
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

LEAVES = 1000  # of a container that are looked at
ELEMENTS = 100_000  # of an array
DEPTH = 12  # of functions that call functions, and of objects in objects


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
_OPAQUE = object()
_STORES = ("STORE_GLOBAL", "STORE_DEREF")
_GLOBALS = ("LOAD_GLOBAL", "LOAD_NAME")
_FUNCTIONS = (FunctionType, MethodType)
_NUMBERS = (bool, int, float, complex, str, np.generic)
_PLAIN = (*_NUMBERS, bytes, NoneType, Enum, range, np.dtype)
_ARRAYS = {
    *("jax", "jaxlib", "numpy", "equinox", "diffrax", "optax", "optimistix", "lineax"),
    *("jaxtyping", "jaxlag"),
}
_LIBRARIES = {*_ARRAYS, *sys.stdlib_module_names}


def outside(function: Any) -> Outside:
    """By name, what a function reads from outside: numbers, arrays, and functions of the user's.

    Containers of numbers are read whole, of other objects the attributes that the code names.
    """
    return _reading(function).found


def sources(function: Any) -> list[tuple[str, Any]]:
    """The objects that a function reads from outside, as they are, each with its name."""
    return _reading(function).sources


def changes(read: Outside) -> Iterator[tuple[str, str, str]]:
    """(name, what it was, what it is now) of all that has changed."""
    for name, (look, before) in read.items():
        now = _value(look())
        if not _same(before, now):
            yield name, _words(before), _words(now)


def of_class(kind: type) -> Outside:
    """What the methods of a class read from outside, and its own attributes besides methods."""
    reader = _Reader()
    for base in kind.__mro__:
        for name in () if of_library(base) else vars(base):
            own = getattr(base, name, _GONE)
            if isinstance(own, property):
                own = own.fget
            if isinstance(own, FunctionType):
                reader.function(own, DEPTH)
            elif not name.startswith("__") and not hasattr(own, "__get__"):
                look = partial(getattr, base, name, _GONE)
                reader.attribute(f"{base.__name__}.{name}", look)
    return reader.found


def of_library(x: Any) -> bool:
    """Whether a module, a class, a function or an object is of Python or of a library of JAX's."""
    return _home(x) in _LIBRARIES


def of_arrays(x: Any) -> bool:
    """Whether it is of a library of JAX's, or of this one."""
    return _home(x) in _ARRAYS


def _home(x: Any) -> str:
    """The name of the package that it is of."""
    if isinstance(x, ModuleType):
        name = x.__name__
    elif isinstance(x, FunctionType):
        name = x.__globals__.get("__name__")
    else:
        name = (x if isinstance(x, type) else type(x)).__module__
    return str(name).partition(".")[0]


def _reading(function: Any) -> "_Reader":
    reader = _Reader()
    reader.function(function, DEPTH)
    return reader


class _Reader:
    """Follows what code names, from functions to objects and on to their methods.

    Attributes:
        found: what was read, to be compared.
        sources: the objects themselves, by name.
    """

    def __init__(self) -> None:
        self.found: Outside = {}
        self.sources: list[tuple[str, Any]] = []
        self._met: set[Any] = set()
        self._places: dict[str, Any] = {}

    def function(self, x: Any, depth: int) -> None:
        """All that something callable reads; of those of libraries, what they were made with."""
        if depth == 0 or not self._is_new(x):
            return
        if isinstance(x, partial):
            args, keywords = x.args, x.keywords
            names = _named(unwrapped(x.func))
            for i, _ in enumerate(args):
                place = id(args), i
                self._source(f"args[{i}]", place, partial(_item, args, i), names, depth)
            for name in keywords:
                place = id(keywords), name
                self._source(name, place, partial(_item, keywords, name), names, depth)
            self.function(x.func, depth)
        elif isinstance(x, MethodType):
            owner = x.__self__
            self._source("self", id(owner), lambda: owner, _named(x.__func__), depth)
            self.function(x.__func__, depth)
        elif isinstance(x, FunctionType):
            self._plain(x, depth)
        elif isinstance(x, BuiltinFunctionType) and not isinstance(x.__self__, ModuleType):
            owner = x.__self__
            self._source("self", id(owner), lambda: owner, set(), depth)
        elif _is_called(type(x)) and not of_library(x):
            self.function(MethodType(type(x).__call__, x), depth)
        for rule in ("jvp", "fwd", "bwd"):
            if of_library(x) and callable(part := getattr_static(x, rule, None)):
                self.function(part, depth)
        if unwrapped(x) is not x:
            self.function(_inner(x), depth)

    def attribute(self, name: str, look: Callable[[], Any]) -> None:
        """One value that is looked at by itself."""
        self._source(name, name, look, set(), DEPTH)

    def _plain(self, x: FunctionType, depth: int) -> None:
        codes = list(_codes(x.__code__))
        lines = [i for code in codes for i in get_instructions(code)]
        stored = {i.argval for i in lines if i.opname in _STORES}  # counters and the like
        names, space = _named(x), x.__globals__
        looks: dict[str, tuple[Any, Callable[[], Any]]] = {}
        if not of_library(x):
            for name in {i.argval for i in lines if i.opname in _GLOBALS}:
                if name in space:
                    looks[name] = (id(space), name), partial(_item, space, name)
            for name in {i.argval for i in lines if i.opname == "IMPORT_NAME"}:
                looks[name] = name, partial(_item, sys.modules, name)
        for name, cell in zip(x.__code__.co_freevars, x.__closure__ or (), strict=True):
            if not of_library(x) or unwrapped(x) is x:  # else what it wraps is looked at itself
                looks[name] = id(cell), partial(_content, cell)
        count = x.__code__.co_argcount
        given = x.__code__.co_varnames[count - len(x.__defaults__ or ()) : count]
        for i, name in enumerate(given):
            looks[name] = (id(x), name), partial(_item, x.__defaults__, i)
        for name in x.__kwdefaults__ or ():
            looks[name] = (id(x), name), partial(_item, x.__kwdefaults__, name)
        for name, (place, look) in looks.items():
            if name not in stored and look() is not _GONE:
                self._source(name, place, look, names, depth)

    def _source(
        self, name: str, place: Any, look: Callable[[], Any], names: set[str], depth: int
    ) -> None:
        """Something that a name stands for, in a place, for code that names these attributes."""
        x = look()
        if depth == 0:
            return
        if isinstance(unwrapped(x), (*_FUNCTIONS, partial, BuiltinFunctionType)):
            self._keep(name, place, look, x)
            self.function(x, depth - 1)
            return
        if isinstance(x, ModuleType | type):
            if not of_library(x):
                self._attributes(name, place, look, names, depth)
            return
        value = _value(x)
        self.sources.append((name, x))
        if value is not _OPAQUE:
            self._keep(name, place, look, value)
        elif isinstance(x, dict | list | tuple):
            self._items(name, place, look, names, depth)
        elif not of_arrays(x):
            self._attributes(name, place, look, names, depth)
            self.function(x, depth - 1)

    def _keep(self, name: str, place: Any, look: Callable[[], Any], value: Any) -> None:
        while self._places.setdefault(name, place) != place:
            name += "'"  # another one of the same name, of another function
        self.found.setdefault(name, Read(look, value))

    def _items(
        self, name: str, place: Any, look: Callable[[], Any], names: set[str], depth: int
    ) -> None:
        """Of a container of objects."""
        x = look()
        self._keep(f"len({name})", place, lambda: _length(look()), len(x))
        keys = list(x) if isinstance(x, dict) else range(len(x))
        for key in list(keys)[:LEAVES]:
            again = lambda key=key: _item(look(), key)  # noqa: E731
            self._source(f"{name}[{key!r}]", (place, key), again, names, depth - 1)

    def _attributes(
        self, owner: str, place: Any, look: Callable[[], Any], names: set[str], depth: int
    ) -> None:
        """Those attributes that the code names, and what methods and properties among them read."""
        x = look()
        if not self._is_new((owner, frozenset(names)), x):
            return
        for name in sorted(names):
            own = getattr_static(x, name, _GONE)
            if isinstance(own, property | cached_property):
                get: Any = own.fget if isinstance(own, property) else own.func
                self.function(MethodType(get, x), depth - 1)
            elif isinstance(own, FunctionType) and name not in getattr(x, "__dict__", {name}):
                self.function(MethodType(own, x), depth - 1)
            elif isinstance(own, staticmethod):
                self.function(own.__func__, depth - 1)
            elif isinstance(own, classmethod):
                kind = x if isinstance(x, type) else type(x)
                self.function(MethodType(own.__func__, kind), depth - 1)
            elif own is not _GONE and getattr(x, name, _GONE) is not _GONE:
                again = lambda name=name: getattr(look(), name, _GONE)  # noqa: E731
                self._source(f"{owner}.{name}", (place, name), again, names, depth - 1)

    def _is_new(self, x: Any, owner: Any = None) -> bool:
        key = (id(x.__func__), id(x.__self__)) if isinstance(x, MethodType) else id(x)
        if owner is not None:
            key = x, id(owner)
        new = key not in self._met
        self._met.add(key)
        return new


def unwrapped(x: Any) -> Any:
    """The function inside jit and the like."""
    try:
        return unwrap(x)
    except ValueError:  # whatever has every attribute
        return x


def _inner(x: Any) -> Any:
    """What a wrapper wraps."""
    return x.__wrapped__


def _codes(code: CodeType) -> Iterator[CodeType]:
    """A code and those of the functions written inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _is_called(kind: type) -> bool:
    """Whether its instances are called by a function of the user's."""
    return isinstance(getattr_static(kind, "__call__", None), FunctionType)


def _named(function: Any) -> set[str]:
    """The attributes that a function may ask for, by getattr as well."""
    if not isinstance(function, FunctionType):
        return set()
    codes = list(_codes(function.__code__))
    texts = (x for code in codes for x in code.co_consts if isinstance(x, str) and x.isidentifier())
    return {*(name for code in codes for name in code.co_names), *texts}


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not set yet
        return _GONE


def _item(container: Any, key: Any) -> Any:
    try:
        return container[key]
    except (LookupError, TypeError):
        return _GONE


def _length(container: Any) -> Any:
    return len(container) if hasattr(container, "__len__") else _GONE


def _value(x: Any) -> Any:
    """A number, an array or a container of them as it is now; _OPAQUE for anything else."""
    if x is _GONE or isinstance(x, (*_PLAIN, jax.Array)) or isinstance(unwrapped(x), _FUNCTIONS):
        return x
    if isinstance(x, type | partial) or (callable(x) and of_library(x)):
        return x
    if isinstance(x, np.ndarray):
        return _OPAQUE if x.dtype == object else _sampled(x)
    if isinstance(x, set | frozenset):
        return frozenset(x) if all(isinstance(y, _PLAIN) for y in x) else _OPAQUE
    if isinstance(x, dict | list | tuple):
        return _leaves(x)
    if isinstance(x, Mapping):
        return _value(dict(x))
    if hasattr(type(x), "__array__"):  # series and frames
        array = np.asarray(x)
        return _OPAQUE if array.dtype == object else _sampled(array)
    return _OPAQUE


def _sampled(x: np.ndarray) -> np.ndarray:
    """A copy; of a large array, of evenly spread numbers of it."""
    return x.copy() if x.size <= ELEMENTS else x.flat[:: -(-x.size // ELEMENTS)].copy()


def _leaves(x: dict | list | tuple) -> Any:
    """The structure and the numbers of a container of nothing else."""
    try:
        leaves, tree = jax.tree.flatten(x)
    except (TypeError, ValueError):  # keys that do not sort
        return _OPAQUE
    nested = any(isinstance(y, dict | list | tuple) for y in leaves)
    if len(leaves) > LEAVES or nested:
        return _OPAQUE
    values = list(map(_value, leaves))
    return _OPAQUE if any(value is _OPAQUE for value in values) else (tree, values)


def _same(before: Any, now: Any) -> bool:
    if before is now:
        return True
    if isinstance(before, tuple) and isinstance(now, tuple):
        pairs = zip(before[1], now[1], strict=False)
        return before[0] == now[0] and all(_same(x, y) for x, y in pairs)
    if isinstance(before, Tracer) or isinstance(now, Tracer):
        return False
    plain = type(before) is type(now) and isinstance(before, (*_PLAIN, frozenset, MethodType))
    if plain and before == now:
        return True
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
    if value is _OPAQUE:
        return "another object"
    if isinstance(value, tuple):
        value = jax.tree.unflatten(*value)
    if isinstance(value, Tracer):
        return "a traced value"
    if isinstance(value, _FUNCTIONS):
        return f"{value.__qualname__} at {id(value):#x}"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
