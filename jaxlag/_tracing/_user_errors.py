"""Errors inside user functions, reported in the form of all other errors."""

import linecache
import re
from collections.abc import Callable, Mapping, Sequence
from inspect import signature, unwrap
from textwrap import shorten
from types import TracebackType
from typing import Any

import jax
import jax.errors

from jaxlag._core._errors import invalid

_LONGEST = 80  # characters of a shown line of user code
_CONVERTED = (
    (
        jax.errors.TracerArrayConversionError,
        "compute with jax.numpy",
        "passes a traced array to numpy",
        "Write jnp.cos(q[0]) instead of np.cos(q[0]).",
    ),
    (
        jax.errors.TracerIntegerConversionError,
        "index with numbers that are known while it is traced",
        "converts a traced number to a Python index",
        "Keep indices and counts as Python ints in params, or use jnp.take.",
    ),
    (
        jax.errors.TracerBoolConversionError,
        "choose without `if`, `and`, `or` and `while` on traced numbers",
        "converts a traced number to a Python bool",
        "Write jnp.where(condition, a, b), jnp.minimum, jnp.maximum or jax.lax.cond.",
    ),
    (
        jax.errors.ConcretizationTypeError,
        "keep traced numbers as they are",
        "converts a traced number to a Python number",
        "Leave out float(), int() and .item(); pass constants as numbers in params.",
    ),
)


def translate(function: Callable, arguments: Sequence[Any], error: Exception) -> Exception | None:
    """The error in our form, for common mistakes; None if the message of JAX or Python is better.

    Args:
        function: the user function that raised it.
        arguments: its arguments.
        error: the error.
    """
    named = _arguments(function, arguments)
    name, place = f"function {_name(function)}", _place(function, error.__traceback__)
    for kind, must, was, fix in _CONVERTED:
        if isinstance(error, kind):
            return invalid(name, must, f"{place} {was}", fix)
    if isinstance(error, KeyError) and error.args and isinstance(error.args[0], str):
        return _missing(name, place, named, error.args[0])
    if isinstance(error, TypeError | AttributeError | IndexError):
        return _of_params(name, place, named)
    return None


def _missing(name: str, place: str, named: Mapping[str, Any], key: str) -> Exception | None:
    """The error for a missing key of a dict among the arguments."""
    lacking = {
        argument: sorted(map(str, value))
        for argument, value in named.items()
        if isinstance(value, Mapping) and key not in value
    }
    if not lacking:
        return None
    asked = [argument for argument in lacking if re.search(rf"\b{argument}\[", place)]
    argument = (*asked, *(["params"] if "params" in lacking else lacking))[0]
    must = f"have an entry {key!r}, which {name} reads"
    return invalid(argument, must, f"its names were {lacking[argument]}: {place}")


def _of_params(name: str, place: str, named: Mapping[str, Any]) -> Exception | None:
    """The error for params that are no numbers."""
    if "params" not in named:
        return None
    params = named["params"]
    if params is None:
        was = f"they were left out: {place}"
        return invalid("params", f"be given, since {name} reads them", was, "Pass params={...}.")
    shape = getattr(params, "shape", None)
    if (shape is not None or isinstance(params, list | tuple)) and re.search(
        r"""\[\s*["']""", place
    ):
        must = f"have the entries that {name} reads by name"
        what = f"a {type(params).__name__}" if shape is None else f"an array of shape {shape}"
        fix = "The order of the arguments is (q, v, params)."
        return invalid("params", must, f"they were {what}: {place}", fix)
    for path, leaf in jax.tree_util.tree_flatten_with_path(params)[0]:
        if isinstance(leaf, str):
            leaf_name = f"params{jax.tree_util.keystr(path)}"
            must = f"be a number where {name} calculates with it"
            return invalid(leaf_name, must, f"it was the text {leaf!r}: {place}")
    return None


def _arguments(function: Callable, arguments: Sequence[Any]) -> dict[str, Any]:
    """The arguments by our names: the fourth argument is called params."""
    try:
        names = list(signature(function).parameters)
    except (TypeError, ValueError):
        names = []
    names += [f"argument {i}" for i in range(len(names), len(arguments))]
    named = dict(zip(names, arguments, strict=False))
    position = 3 if len(arguments) > 3 else 2
    if "params" not in named and len(arguments) > position:
        named = {
            ("params" if i == position else key): value
            for i, (key, value) in enumerate(named.items())
        }
    return named


def _name(function: Callable) -> str:
    return repr(getattr(function, "__qualname__", type(function).__qualname__))


def _place(function: Callable, traceback: TracebackType | None) -> str:
    """The last line of the function's file in the traceback, as text."""
    code = getattr(unwrap(function), "__code__", None)
    found = None
    while traceback is not None:
        frame = traceback.tb_frame
        if code is not None and frame.f_code.co_filename == code.co_filename:
            found = (code.co_filename, traceback.tb_lineno)
        traceback = traceback.tb_next
    if found is None:
        return "it"
    text = shorten(linecache.getline(*found).strip(), _LONGEST, placeholder=" ...")
    return f"line {found[1]} (`{text}`)" if text else f"line {found[1]}"
