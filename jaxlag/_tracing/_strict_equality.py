"""Strict equality of keys: values and types, for 1, True and 1.0; 0.0 and -0.0; named tuples.

Such values compare equal, but their programs differ: keys include the types of their contents.
"""

from dataclasses import fields, is_dataclass
from functools import lru_cache
from math import copysign
from types import FunctionType, NoneType
from typing import Any

_ALONE = {bool, int, str, NoneType, FunctionType}
BUILTIN = (dict, list, tuple, NoneType)


def is_bare(kind: type, data: Any) -> bool:
    """Whether a node of a pytree contains only its children and their names."""
    return kind in BUILTIN and all(type(key) is str for key in data or ())


def types_of(x: Any) -> Any:
    """The types of a value and of its contents, and the signs of zeros."""
    kind = type(x)
    if kind in _ALONE:
        return kind
    if kind is float or kind is complex:
        return (kind, *(copysign(1.0, part) for part in (x.real, x.imag))) if x == 0 else kind
    if isinstance(x, tuple | list):
        return kind, *map(types_of, x)
    if isinstance(x, frozenset):
        return kind, frozenset(map(types_of, x))
    if is_dataclass(x) and not isinstance(x, type):
        return kind, *(types_of(getattr(x, f.name, None)) for f in fields(x))
    return kind


def types_in(structure: Any) -> Any:
    """The same for the nodes of a pytree."""
    if _is_bare_throughout(structure):
        return None
    found, rest = [], [structure]
    while rest:
        here = rest.pop()
        rest += here.children()
        _, data = here.node_data() or (None, None)
        if data is not None:
            found.append(types_of(data))
    return tuple(found)


@lru_cache(maxsize=1024)
def _is_bare_throughout(structure: Any) -> bool:
    kind, data = structure.node_data() or (NoneType, None)
    bare = is_bare(kind, data) or data is None
    return bare and all(map(_is_bare_throughout, structure.children()))
