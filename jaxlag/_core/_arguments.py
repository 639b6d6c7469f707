"""Decorators and checks for the arguments of public functions: order, names, types."""

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from inspect import Parameter, signature
from typing import Any, ParamSpec, TypeVar

import numpy as np

from jaxlag._core._errors import invalid

P = ParamSpec("P")
R = TypeVar("R")


def state_first(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator of functions of a state: raises if more arguments are given by position.

    The message shows the order, (q, v, params) and the rest by name; Python's message does not.
    """
    parameters = list(signature(function).parameters.values())
    positional = [p.name for p in parameters if p.kind is Parameter.POSITIONAL_OR_KEYWORD]
    by_name = [p.name for p in parameters if p.kind is Parameter.KEYWORD_ONLY]
    shown = [name for name in positional if name != "self"]

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        if len(args) > len(positional):
            count = len(args) - (len(positional) - len(shown))
            raise invalid(
                function.__name__,
                f"get {_listed(by_name)} by name",
                f"it got {count} arguments by position",
                f"The order is ({', '.join(shown)}), then {'=..., '.join(by_name)}=... .",
            )
        return function(*args, **kwargs)

    return checked


def _listed(names: list[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def renamed(**names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator that refuses former keywords with a message that shows the new ones.

    Args:
        **names: by the former name, its replacement.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            for old in names.keys() & kwargs.keys():
                must, was = "be called with its current keywords", f"it got {old}="
                raise invalid(function.__name__, must, was, f"Write {names[old]}.")
            return function(*args, **kwargs)

        return checked

    return decorate


def required(**fixes: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator that raises with a message if required arguments are left out.

    Args:
        **fixes: by the argument's name, the code to write.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        places = {name: list(signature(function).parameters).index(name) for name in fixes}

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            for name, place in places.items():
                if len(args) <= place and name not in kwargs:
                    raise invalid(name, "be given", "it was left out", fixes[name])
            return function(*args, **kwargs)

        return checked

    return decorate


def positive_integer(argument: str, x: Any) -> int:
    """`x`, a whole number above 0; raises with the argument's name otherwise."""
    if isinstance(x, bool) or not isinstance(x, int | np.integer) or x < 1:
        raise invalid(argument, "be a positive integer", f"it was {x!r}")
    return int(x)


def name_sequence(argument: str, x: Any, fix: str | None = None) -> tuple[str, ...]:
    """`x`, a sequence of names; raises with the argument's name otherwise, also for one name."""
    if isinstance(x, str):
        raise invalid(
            argument,
            "be a sequence of names",
            f"it was {x!r}",
            fix or f"Write {argument.rpartition(': ')[2]}=({x!r},).",
        )
    if not isinstance(x, Sequence):
        raise invalid(argument, "be a sequence of names", f"it was {x!r}", fix or "")
    for name in x:
        if not isinstance(name, str):
            raise invalid(argument, "be a sequence of names", f"one was {name!r}", fix or "")
    return tuple(x)


def by_name(argument: str, x: Any, example: str = "") -> dict[str, Any]:
    """`x`, a dict by name, or None for an empty one; raises with the argument's name otherwise.

    Args:
        argument: its name in errors.
        x: anything.
        example: code of a value, for the error.
    """
    if x is None or isinstance(x, Mapping):
        return dict(x or {})
    own = argument.rpartition(": ")[2]
    fix = f"Write {own}={{'name': {example}}}." if example else ""
    raise invalid(argument, "be a dict by name", f"it was {x!r}", fix)


def former_names(module: str, present: Mapping[str, str]) -> Callable[[str], object]:
    """A module's `__getattr__` that refuses former names and says the present ones.

    Args:
        module: its name.
        present: by the former name, the present one.
    """

    def refuse(name: str) -> object:
        if name in present:
            raise AttributeError(f"{module}.{name} is {module}.{present[name]} now")
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return refuse
