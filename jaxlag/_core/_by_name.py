"""Values by name, and attributes of other tools: a wrong name is told the right ones."""

from collections.abc import Mapping
from difflib import get_close_matches
from inspect import getattr_static
from types import MappingProxyType
from typing import Any

import jax

from jaxlag._core._errors import requirement

NOTHING: Mapping[str, str] = MappingProxyType({})


@jax.tree_util.register_pytree_with_keys_class
class ByName(dict[str, Any]):
    """A dict by name, whose KeyError says which names there are.

    For JAX it is a node of its own: beside plain dicts, as in `jax.tree.map` of both, write
    `dict(values)`.
    """

    def __missing__(self, name: object) -> Any:
        close = get_close_matches(str(name), self, 1)
        fix = f"Write {close[0]!r}." if close else ""
        message = requirement("name", f"be one of {list(self)}", f"it was {name!r}", fix)
        raise UnknownName(name, message)

    def tree_flatten_with_keys(self) -> tuple[list[tuple[Any, Any]], tuple[str, ...]]:
        """For JAX's pytree registry: in the order of the names, as JAX's own dicts."""
        names = tuple(sorted(self))
        return [(jax.tree_util.DictKey(name), self[name]) for name in names], names

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], values: Any) -> "ByName":
        """For JAX's pytree registry."""
        return cls(zip(names, values, strict=True))


class UnknownName(KeyError):
    """A KeyError of a name, with a message that is shown without quotes."""

    def __init__(self, name: object, message: str = "") -> None:
        super().__init__(name)
        self.message = message

    def __str__(self) -> str:
        return self.message or super().__str__()


def no_attribute(owner: object, name: str, instead: Mapping[str, str] = NOTHING) -> Any:
    """For `__getattr__`: raise the AttributeError for a name that an object does not have.

    Python calls `__getattr__` also if a property raises an AttributeError itself; then this error
    is raised again.

    Args:
        owner: the object.
        name: the attribute.
        instead: what to write for names of other tools.
    """
    own = getattr_static(type(owner), name, None)
    if isinstance(own, property):
        return own.__get__(owner)
    hint = f". Write {instead[name]}" if name in instead else ""
    raise AttributeError(f"{type(owner).__name__!r} object has no attribute {name!r}{hint}")
