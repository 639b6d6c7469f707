"""Code of Python functions and of their wrappers: names and attributes in it."""

import re
from collections.abc import Iterator
from enum import Enum
from functools import cached_property, partial, partialmethod, singledispatchmethod
from inspect import getattr_static, unwrap
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType
from typing import Any

import jax

FUNCTIONS = (FunctionType, MethodType)
# Attributes written by enum; those written by functools and JAX, and copied by wrappers.
_OF_ENUM = {"_value_", "_name_", "_sort_order_", "_inverted_", "__objclass__"}
_OF_WRAPPERS = {
    *("cache_parameters", "register", "dispatch", "registry", "_clear_cache"),
    *("_fun", "_jit_info", "jvp", "fwd", "bwd"),
    *vars(jax.custom_jvp(abs)),
    *vars(jax.custom_vjp(abs)),
}


def own_attributes(x: Any) -> dict[str, Any]:
    """Attributes added to a function, or to a member of an enumeration."""
    found = getattr(x, "__dict__", {})
    internal = _OF_ENUM if isinstance(x, Enum) else _OF_WRAPPERS if "__wrapped__" in found else ()
    if all(name in internal for name in found):  # the usual case
        return {}
    return {
        name: value
        for name, value in found.items()
        if not (name in internal or name.startswith("__"))
        and not isinstance(getattr_static(type(x), name, None), cached_property)
    }


def unwrapped(x: Any) -> Any:
    """The function inside jit and similar wrappers."""
    try:
        return unwrap(x)
    except ValueError:  # objects with arbitrary attributes
        return x


def is_generated(own: Any) -> bool:
    """Whether a method was made by dataclass or NamedTuple."""
    own = own.__func__ if isinstance(own, staticmethod) else own
    if not isinstance(own, FunctionType) or not own.__name__.startswith("__"):
        return False
    return own.__code__.co_filename == "<string>" or own.__code__.co_filename.startswith("<string ")


def behind(own: Any) -> Iterator[Any]:
    """The functions in a method, a property and the like."""
    if isinstance(own, property):
        yield from (x for x in (own.fget,) if x is not None)
    elif isinstance(own, cached_property | partialmethod):
        yield own.func
        yield from own.args if isinstance(own, partialmethod) else ()
    elif isinstance(own, singledispatchmethod):
        yield own.func
        yield from own.dispatcher.registry.values()
    elif isinstance(own, staticmethod | classmethod):
        yield from behind(own.__func__)
    elif isinstance(unwrapped(own), (*FUNCTIONS, partial, BuiltinFunctionType)):
        yield own


def codes_of(code: CodeType) -> Iterator[CodeType]:
    """A code object and those of its nested functions."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from codes_of(constant)


def texts_of(codes: list[CodeType]) -> set[str]:
    """All words in the string constants of code, and the attributes that it uses."""
    texts = [x for code in codes for x in code.co_consts if isinstance(x, str)]
    words = (x for text in texts for x in re.findall(r"\w+|[\w.]+", text))
    return {*texts, *words, *(name for code in codes for name in code.co_names)}


def named_in(function: Any) -> set[str]:
    """The attributes that a function may use, also by getattr."""
    if not isinstance(function, FunctionType):
        return set()
    codes = list(codes_of(function.__code__))
    texts = (x for code in codes for x in code.co_consts if isinstance(x, str) and x.isidentifier())
    return {*(name for code in codes for name in code.co_names), *texts}


def is_called(kind: type) -> bool:
    """Whether a user function implements calls of its instances."""
    return isinstance(getattr_static(kind, "__call__", None), FunctionType)
