"""Snapshots of captured values of a function, and the check whether they have changed."""

from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from functools import partial
from types import BuiltinFunctionType, MethodType, NoneType
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from jaxlag._tracing._defining_package import of_library
from jaxlag._tracing._function_code import FUNCTIONS, unwrapped

LEAVES = 1000  # largest number of leaves examined in a container
ELEMENTS = 100_000  # largest number of elements compared in an array
GONE = object()
OPAQUE = object()  # no comparable value
_NUMBERS = (bool, int, float, complex, str, np.generic)
_PLAIN = (*_NUMBERS, bytes, NoneType, Enum, range, np.dtype)


class Read(NamedTuple):
    """A value from outside.

    Attributes:
        look: function that reads it again.
        value: its value when first read; arrays that can be changed in place are copied.
    """

    look: Callable[[], Any]
    value: Any


Outside = dict[str, Read]


def changes(read: Outside) -> Iterator[tuple[str, str, str]]:
    """(name, old value, new value) of all changed values."""
    for name, (look, before) in read.items():
        current = look()
        if current is before:  # the usual case
            continue
        now = value_of(current)
        if not _same(before, now):
            yield name, _text(before), _text(now)


def value_of(x: Any) -> Any:
    """The current value of a number, an array or a container of these; else OPAQUE."""
    if x is GONE or isinstance(x, (*_PLAIN, jax.Array)) or isinstance(unwrapped(x), FUNCTIONS):
        return x
    if isinstance(x, type | partial) or (callable(x) and of_library(x)):
        return x
    if isinstance(x, np.ndarray):
        return OPAQUE if x.dtype == object else _sampled(x)
    if isinstance(x, set | frozenset):
        return frozenset(x) if all(isinstance(y, _PLAIN) for y in x) else OPAQUE
    if isinstance(x, dict | list | tuple):
        return _leaves(x)
    if isinstance(x, Mapping):
        return value_of(dict(x))
    if hasattr(type(x), "__array__"):  # series and frames
        array = np.asarray(x)
        return OPAQUE if array.dtype == object else _sampled(array)
    return OPAQUE


def _sampled(x: np.ndarray) -> np.ndarray:
    """A copy; for a large array, of evenly spaced elements."""
    return x.copy() if x.size <= ELEMENTS else x.flat[:: -(-x.size // ELEMENTS)].copy()


def _leaves(x: dict | list | tuple) -> Any:
    """The structure and the numbers of a container of numbers only."""
    try:
        leaves, tree = jax.tree.flatten(x)
    except (TypeError, ValueError):  # keys that do not sort
        return OPAQUE
    nested = any(isinstance(y, dict | list | tuple) for y in leaves)
    if len(leaves) > LEAVES or nested:
        return OPAQUE
    values = list(map(value_of, leaves))
    return OPAQUE if any(value is OPAQUE for value in values) else (tree, values)


def _same(before: Any, now: Any) -> bool:
    if before is now:
        return True
    if isinstance(before, tuple) and isinstance(now, tuple):
        pairs = zip(before[1], now[1], strict=False)
        return before[0] == now[0] and all(_same(x, y) for x, y in pairs)
    if isinstance(before, Tracer) or isinstance(now, Tracer):
        return False
    kinds = (*_PLAIN, frozenset, MethodType, BuiltinFunctionType)
    plain = type(before) is type(now) and isinstance(before, kinds)
    if plain and before == now:
        return True
    kinds = (np.ndarray, jax.Array, *_NUMBERS)
    if not isinstance(before, kinds) or not isinstance(now, kinds):
        return False
    x, y = np.asarray(before), np.asarray(now)
    return (
        x.shape == y.shape and x.dtype == y.dtype and bool(np.all((x == y) | ((x != x) & (y != y))))
    )


def _text(value: Any) -> str:
    if value is GONE:
        return "gone"
    if value is OPAQUE:
        return "another object"
    if isinstance(value, tuple):
        value = jax.tree.unflatten(*value)
    if isinstance(value, Tracer):
        return "a traced value"
    if isinstance(value, FUNCTIONS):
        return f"{value.__qualname__} at {id(value):#x}"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
