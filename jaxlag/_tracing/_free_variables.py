"""Free variables of a Python function: globals, closures, attributes that it reads.

A function is traced once, and its program keeps the values that it read. A later change of them
would give the results of before in silence: JAX detects no such change. From the free variables
jaxlag warns of it by name, and refuses functions in params that read a mutable object.
"""

import re
import sys
from collections.abc import Callable, Mapping, MutableMapping
from dis import get_instructions
from enum import Enum
from functools import cached_property, lru_cache, partial
from inspect import getattr_static
from logging import Logger
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple

import jax

from jaxlag._tracing._defining_package import is_installed, of_arrays, of_library
from jaxlag._tracing._function_code import (
    FUNCTIONS,
    behind,
    codes_of,
    is_called,
    is_generated,
    named_in,
    own_attributes,
    texts_of,
    unwrapped,
)
from jaxlag._tracing._watched_values import GONE, LEAVES, OPAQUE, Outside, Read, value_of

DEPTH = 12  # of functions that call functions, and of objects in objects


class Reading(NamedTuple):
    """All values that a function, or a class, reads from outside.

    Attributes:
        found: values that can be compared with later ones.
        sources: the objects themselves, each with its name; of user code only.
    """

    found: Outside
    sources: list[tuple[str, Any]]


_STORES = ("STORE_GLOBAL", "STORE_DEREF")
# Types of functions with attributes of the user's; other types have their own attributes.
_WRITTEN_TO = (
    *(FunctionType, type(jax.jit(abs)), type(lru_cache(abs))),
    *(jax.custom_jvp, jax.custom_vjp),
)
_GLOBALS = ("LOAD_GLOBAL", "LOAD_NAME")
_LOOKED_UP = {"globals", "eval", "exec", "__globals__"}  # names are then strings
_IMPORTED = {"__import__", "import_module"}
_CHANGING = (dict, list, set, bytearray, MutableMapping)
# Methods that make an instance: the values that they read are in its fields.
_MAKING = {"__init__", "__new__", "__post_init__", "__check_init__", "__init_subclass__"}
_GENERATED = {"_abc_impl", "_fields", "_field_defaults", "_make", "_replace", "_asdict"}


def outside(function: Any) -> Outside:
    """The values that a function reads from outside, by name: numbers, arrays, user functions.

    Containers of numbers are read whole; of other objects, the attributes that the code names.
    """
    return _reading(function).found


def reading(x: Any) -> Reading:
    """The same for a function with its attributes, or for the methods and attributes of a class."""
    if isinstance(x, type):
        reader = _Reader()
        reader.kind(x)
        reader.makers()
    else:
        reader = _reading(x)
        reader.own(x)
    return Reading(reader.found, reader.sources)


def _reading(function: Any) -> "_Reader":
    reader = _Reader()
    reader.function(function, DEPTH)
    return reader


class _Reader:
    """Follows the names in code, from functions to objects and to their methods.

    Attributes:
        found: the values read, for comparison.
        sources: the objects themselves, by name.
    """

    def __init__(self) -> None:
        self.found: Outside = {}
        self.sources: list[tuple[str, Any]] = []
        self._met: set[Any] = set()
        self._places: dict[str, Any] = {}
        self._stored: set[str] = set()  # attributes that the code writes, such as counters
        self._watching = False  # whether only changes are watched, without sources
        self._making: list[Any] = []
        self._skips_installed = False  # True while methods are read: these plot and save

    def function(self, x: Any, depth: int) -> None:
        """All values that a callable reads; for library callables, their arguments."""
        if depth == 0 or not self._is_new(x):
            return
        if isinstance(x, partial):
            args, keywords = x.args, x.keywords
            names = named_in(unwrapped(x.func))
            for i, _ in enumerate(args):
                place = id(args), i
                self._source(f"args[{i}]", place, partial(_item, args, i), names, depth)
            for name in keywords:
                place = id(keywords), name
                self._source(name, place, partial(_item, keywords, name), names, depth)
            self.function(x.func, depth)
        elif isinstance(x, MethodType):
            owner = x.__self__
            self._source("self", id(owner), lambda: owner, named_in(x.__func__), depth)
            self.function(x.__func__, depth)
        elif isinstance(x, FunctionType):
            self._plain(x, depth)
        elif isinstance(x, BuiltinFunctionType) and not isinstance(x.__self__, ModuleType):
            owner = x.__self__
            self._source("self", id(owner), lambda: owner, set(), depth)
        elif is_called(type(x)) and not of_library(x):
            self.function(MethodType(type(x).__call__, x), depth)
        registry = getattr_static(x, "registry", None) if isinstance(x, FunctionType) else None
        for part in registry.values() if isinstance(registry, Mapping) else ():
            self.function(part, depth - 1)  # of functools.singledispatch
        for rule in ("jvp", "fwd", "bwd"):
            if of_library(x) and callable(part := getattr_static(x, rule, None)):
                self.function(part, depth)
        if unwrapped(x) is not x:
            self.function(_inner(x), depth)

    def kind(self, kind: type) -> None:
        """The values read by methods of a class, its attributes, and those of its members."""
        self._skips_installed = not is_installed(sys.modules.get(kind.__module__))
        members = [*kind] if issubclass(kind, Enum) else []
        skipped = {*_GENERATED, *getattr(kind, "__members__", ())}
        for base in kind.__mro__ if self._is_new(kind) else ():
            for name, own in () if of_library(base) else list(vars(base).items()):
                if name in skipped or (issubclass(base, Enum) and re.match("_[a-z].*_$", name)):
                    continue
                title, place = f"{base.__name__}.{name}", (base, name)
                parts = [] if is_generated(own) else list(behind(own))
                if parts:
                    self._keep(title, place, partial(_of_class, base, name), own)
                    made = name in _MAKING or isinstance(own, classmethod)
                    for part in () if made else parts:
                        self.function(part, DEPTH)
                    self._making += parts if made else ()
                elif isinstance(own, type):
                    self.kind(own)
                elif not name.startswith("__") and not hasattr(own, "__get__"):
                    self._source(title, place, partial(getattr, base, name, GONE), set(), DEPTH)
                elif not of_library(own):  # a descriptor of the user's
                    self._source(title, place, partial(_of_class, base, name), set(), DEPTH)
                    for part in vars(type(own)).values():
                        if isinstance(part, FunctionType) and part.__name__ not in _MAKING:
                            self.function(MethodType(part, own), DEPTH)
        watching, self._watching = self._watching, True
        for member in members:
            self._own(f"{kind.__name__}.{member.name}", member)
        self._watching = watching

    def makers(self) -> None:
        """The values read by constructors: last, as these are only watched."""
        self._watching = True
        for part in self._making:
            self.function(part, DEPTH)

    def own(self, x: Any) -> None:
        """The attributes of a function."""
        users = isinstance(x, _WRITTEN_TO) and not of_library(unwrapped(x))
        if users or isinstance(x, partial) or not of_library(type(x)):
            self._own(getattr(unwrapped(x), "__name__", type(x).__name__), x)

    def _own(self, owner: str, x: Any) -> None:
        for name in own_attributes(x):
            if name not in self._stored:
                look = partial(getattr, x, name, GONE)
                self._source(f"{owner}.{name}", (id(x), name), look, set(), DEPTH)

    def _plain(self, x: FunctionType, depth: int) -> None:
        watching = self._watching
        installed = is_installed(x)
        self._watching = watching or installed
        if not of_library(x):  # reloaded modules in notebooks modify functions
            place = id(x), "__code__"
            self._keep(f"{x.__name__}.__code__", place, lambda: x.__code__, x.__code__)
        if not (installed and self._skips_installed):
            self._code(x, depth)
        self._watching = watching

    def _code(self, x: FunctionType, depth: int) -> None:
        codes = list(codes_of(x.__code__))
        lines = [i for code in codes for i in get_instructions(code)]
        stored = {i.argval for i in lines if i.opname in _STORES}  # such as counters
        self._stored |= {i.argval for i in lines if i.opname == "STORE_ATTR"}
        names, space = named_in(x), x.__globals__
        looks: dict[str, tuple[Any, Callable[[], Any]]] = {}
        if not of_library(x):
            asked = {i.argval for i in lines if i.opname in _GLOBALS}
            looked_up = (
                asked - space.keys() | {n for n in names if n == "__globals__"}
            ) & _LOOKED_UP
            for name in asked | (texts_of(codes) if looked_up else set()):
                if name in space:
                    looks[name] = (id(space), name), partial(_item, space, name)
            modules = {i.argval for i in lines if i.opname == "IMPORT_NAME"}
            for name in modules | (texts_of(codes) if names & _IMPORTED else set()):
                looks[name] = name, partial(_item, sys.modules, name)
            if looked_up and not self._watching:
                self.sources += [(min(looked_up), space)]
        for name, cell in zip(x.__code__.co_freevars, x.__closure__ or (), strict=True):
            if not of_library(x) or unwrapped(x) is x:  # else the inner function is used
                looks[name] = id(cell), partial(_content, cell)
        count = x.__code__.co_argcount
        given = x.__code__.co_varnames[count - len(x.__defaults__ or ()) : count]
        for i, name in enumerate(given):
            looks[name] = (id(x), name), lambda i=i: _item(x.__defaults__, i)
        for name in x.__kwdefaults__ or ():
            looks[name] = (id(x), name), lambda name=name: _item(x.__kwdefaults__, name)
        for name, (place, look) in looks.items():
            if name not in stored and look() is not GONE:
                self._source(name, place, look, names, depth)

    def _source(
        self, name: str, place: Any, look: Callable[[], Any], names: set[str], depth: int
    ) -> None:
        """An object that a name refers to, in code that uses these attributes."""
        x = look()
        if depth == 0 or isinstance(x, Logger):  # it provides no number
            return
        if isinstance(unwrapped(x), (*FUNCTIONS, partial, BuiltinFunctionType)):
            self._keep(name, place, look, x)
            self.function(x, depth - 1)
            own = names & own_attributes(x).keys() - self._stored
            if own and not of_library(unwrapped(x)):
                self._attributes(name, place, look, own, depth)
            return
        if isinstance(x, ModuleType) and of_library(x):  # os.environ, sys.modules
            names = {n for n in names if isinstance(vars(x).get(n), _CHANGING)} - _LOOKED_UP
            if not of_arrays(x) and names:
                self._attributes(name, place, look, names, depth)
            return
        if isinstance(x, ModuleType | type):
            if not of_library(x) and not (self._skips_installed and is_installed(x)):
                self._attributes(name, place, look, names, depth)
                self._made(x, depth)
            return
        value = value_of(x)
        if not self._watching:
            self.sources.append((name, x))
        opaque = value is OPAQUE
        if not opaque:
            self._keep(name, place, look, value)
            names = names - set(getattr(x, "_fields", ()))  # a named tuple is kept as a whole
        elif isinstance(x, dict | list | tuple):
            self._items(name, place, look, names, depth)
            opaque = False
        if not of_library(x) or (opaque and not of_arrays(x)):
            self._attributes(name, place, look, names, depth)
            self.function(x, depth - 1)

    def _made(self, x: Any, depth: int) -> None:
        """Values read by the constructors of a class: watched only."""
        watching, self._watching = self._watching, True
        for name in _MAKING if isinstance(x, type) else ():
            if isinstance(part := getattr_static(x, name, None), FunctionType):
                self.function(part, depth - 1)
        self._watching = watching

    def _keep(self, name: str, place: Any, look: Callable[[], Any], value: Any) -> None:
        while self._places.setdefault(name, place) != place:
            name += "'"  # the same name in another function
        self.found.setdefault(name, Read(look, value))

    def _items(
        self, name: str, place: Any, look: Callable[[], Any], names: set[str], depth: int
    ) -> None:
        """The elements of a container of objects."""
        x = look()
        self._keep(f"len({name})", place, lambda: _length(look()), len(x))
        keys = list(x) if isinstance(x, dict) else range(len(x))
        for key in list(keys)[:LEAVES]:
            again = lambda key=key: _item(look(), key)  # noqa: E731
            self._source(f"{name}[{key!r}]", (place, key), again, names, depth - 1)

    def _attributes(
        self, owner: str, place: Any, look: Callable[[], Any], names: set[str], depth: int
    ) -> None:
        """The attributes that the code names, and values read by their methods and properties."""
        x = look()
        if not self._is_new((owner, frozenset(names)), x):
            return
        for name in sorted(names):
            own = getattr_static(x, name, GONE)
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
            elif own is not GONE and getattr(x, name, GONE) is not GONE:
                again = lambda name=name: getattr(look(), name, GONE)  # noqa: E731
                self._source(f"{owner}.{name}", (place, name), again, names, depth - 1)

    def _is_new(self, x: Any, owner: Any = None) -> bool:
        key = (id(x.__func__), id(x.__self__)) if isinstance(x, MethodType) else id(x)
        if owner is not None:
            key = x, id(owner)
        new = key not in self._met
        self._met.add(key)
        return new


def _of_class(kind: type, name: str) -> Any:
    return vars(kind).get(name, GONE)


def _inner(x: Any) -> Any:
    """The wrapped object."""
    return x.__wrapped__


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not set yet
        return GONE


def _item(container: Any, key: Any) -> Any:
    try:
        return container[key]
    except (LookupError, TypeError):
        return GONE


def _length(container: Any) -> Any:
    return len(container) if hasattr(container, "__len__") else GONE
