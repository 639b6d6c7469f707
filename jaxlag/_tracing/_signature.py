"""Signatures of user functions: arguments and results."""

from collections.abc import Callable
from inspect import Parameter, signature
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxlag._core._errors import invalid
from jaxlag._tracing._closure_params import plain
from jaxlag._tracing._source_lines import line_of


def real_scalar(argument: str, function: Callable) -> Callable:
    """`function`, with an error in our form while tracing unless it returns a real scalar."""

    def checked(*arguments: Any) -> Any:
        value = function(*arguments)
        must, fix = (
            "return a real scalar",
            "Sum with jnp.sum; for one coordinate write v[0]; use real energies.",
        )
        if not eqx.is_array_like(value):
            raise invalid(argument, "return an array", f"it returned {value!r}", fix)
        value = jnp.asarray(value)
        if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
            was = f"it returned {value.dtype} of shape {value.shape}"
            raise invalid(argument, must, was, _narrowed(arguments[-1]) or fix)
        return value

    return checked


def real_array(argument: str, value: Any) -> jax.Array:
    """A real array, or an error with the argument's name while tracing."""
    if not eqx.is_array_like(value):
        raise invalid(argument, "return an array", f"it returned {value!r}")
    value = jnp.asarray(value)
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise invalid(argument, "return real numbers", f"it returned {value.dtype}")
    return value


def gradient(argument: str, function: Callable, argnums: int | tuple[int, ...]) -> Callable:
    """The gradient of a real scalar function of (t, q, v, params), as by `jax.grad`.

    Raises in our form if a loop in the function has no reverse derivative.
    """
    scalar = real_scalar(argument, function)

    def of(*arguments: Any) -> Any:
        try:
            return jax.grad(scalar, argnums)(*arguments)
        except ValueError as error:
            if "Reverse-mode differentiation does not work" not in str(error):
                raise
            *state, params = arguments
            line = line_of(jax.make_jaxpr(lambda *state: scalar(*state, params))(*state), "while")
            raise invalid(
                argument,
                "have reverse derivatives, since these give momenta and forces",
                f"a loop in it has no fixed number of iterations: {line}",
                "Use jax.lax.scan, or fori_loop between constant bounds; or define the derivative "
                "by jax.custom_jvp, or by jax.lax.custom_root if the loop solves an equation.",
            ) from error

    return of


def _narrowed(params: Any) -> str:
    """The remedy for a parameter of shape (1,), which makes arrays of scalars."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(plain(params))[0]:
        if jnp.shape(leaf) == (1,):
            return f"params{jax.tree_util.keystr(path)} has shape (1,): give a number, or index it."
    return ""


def wants(function: Callable, position: int, name: str) -> bool:
    """Whether `function` has a positional argument there that is required or called `name`."""
    try:
        parameters = list(signature(function).parameters.values())
    except ValueError:
        return False
    if any(p.kind is Parameter.VAR_POSITIONAL for p in parameters):
        return True
    kinds = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
    at_position = [p for p in parameters if p.kind in kinds][position : position + 1]
    return any(p.default is Parameter.empty or p.name == name for p in at_position)


def takes_inputs(function: Any, place: int) -> bool:
    """Whether a function of a state also takes `inputs`, at this place behind params.

    Also if `inputs` stands in the place of params, so that the error shows the whole form.
    """
    if not callable(function) or not accepts(function, place):
        return True
    return wants(function, place, "inputs") or _positional(function)[place - 1 : place] == [
        "inputs"
    ]


def accepts(function: Callable, count: int) -> bool:
    """Whether `function` can be called with `count` positional arguments."""
    try:
        signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # builtins without a signature: let the call itself decide
        return True
    return True


def require_arity(argument: str, function: Callable, names: tuple[str, ...]) -> None:
    """Raise unless `function` is callable as `function(*names)`."""
    form = f"({', '.join(names)})"
    if not callable(function):
        raise invalid(argument, f"be a function of {form}", f"it was {function!r}")
    if not accepts(function, len(names)):
        raise invalid(
            argument,
            f"be callable as {form}",
            f"its signature was {signature(function)}",
            "Add or drop arguments so that it takes exactly these, in this order.",
        )
    for place, (name, other) in enumerate(zip(names, _positional(function), strict=False)):
        if other in names and names.index(other) != place:
            raise invalid(
                argument,
                f"take {form} in this order",
                f"its signature was {signature(function)}",
                f"{other!r} is in the place of {name!r}.",
            )


def _positional(function: Callable) -> list[str]:
    """Names of its positional arguments, if known."""
    try:
        parameters = signature(function).parameters.values()
    except ValueError:
        return []
    kinds = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
    return [p.name for p in parameters if p.kind in kinds]
