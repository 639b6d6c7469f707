"""Tangents of lists of arrays; None is the tangent of a constant."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.interpreters import ad

Leaves = Sequence[Any]


def derivative(function: Callable, primals: Leaves, dots: Leaves) -> tuple[list, list]:
    """(results, their tangents), with derivatives by the arguments that have a tangent only.

    Args:
        function: list of arrays -> list of arrays.
        primals: its arguments.
        dots: their tangents.
    """
    moving = [i for i, dot in enumerate(dots) if dot is not None]

    def along(*moved: Any) -> list:
        args = list(primals)
        for i, x in zip(moving, moved, strict=True):
            args[i] = x
        return function(*args)

    results, found = jax.jvp(along, [primals[i] for i in moving], [dots[i] for i in moving])
    return results, [None if is_constant(dot) else dot for dot in found]


def is_constant(dot: Any) -> bool:
    """Whether a tangent is that of integers, which have none."""
    return getattr(dot, "dtype", None) == jax.dtypes.float0


def from_jax(dots: Leaves) -> list:
    """Tangents as JAX gives them to the rule of a primitive."""
    return [None if type(dot) is ad.Zero else dot for dot in dots]


def to_jax(results: Leaves, dots: Leaves) -> list:
    """Tangents of results as JAX takes them from the rule of a primitive."""
    return [
        ad.Zero(jax.typeof(x).to_tangent_aval()) if dot is None else dot
        for x, dot in zip(results, dots, strict=True)
    ]
