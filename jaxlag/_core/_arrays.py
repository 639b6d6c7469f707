"""Arrays: conversion of user values to one precision; whether values are traced."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from jaxlag._core._errors import invalid


def concrete(*arrays: Any) -> bool:
    """Whether all of these have values and none is traced by a transform."""
    return not any(isinstance(x, Tracer) for x in jax.tree.leaves(arrays))


def array_of(x: Any) -> Any:
    """`jnp.asarray(x)`; of a list of Python's numbers a numpy array of floats, without dispatch."""
    if isinstance(x, jax.Array):
        return x
    if isinstance(x, list | tuple) and all(type(number) in (float, int) for number in x):
        with np.errstate(over="ignore"):  # then the number is infinite, and refused as such
            return np.asarray(x, jnp.result_type(float))
    return jnp.asarray(x)


def stop_gradient(tree: Any) -> Any:
    """The same without derivatives, for example for a status, which has none."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def real(argument: str, x: Any) -> Array:
    """`x` as a real inexact array of any shape; raises with the argument's name otherwise."""
    try:
        # float() keeps a Python number weakly typed: it takes the dtype of arrays in an operation.
        x = jnp.asarray(float(x) if isinstance(x, int) else x)
    except (TypeError, ValueError, OverflowError) as error:
        raise invalid(argument, "be real numbers", f"it was {x!r}") from error
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise invalid(argument, "be real", f"its dtype was {x.dtype}")
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def number(argument: str, must: str, x: Any, dtype: Any, fix: str = "") -> Array:
    """`x` as a scalar of this dtype, finite if its value is known; raises otherwise.

    Args:
        argument: its name in errors.
        must: the requirement, in words.
        x: anything.
        dtype: of the result.
        fix: what to do with an array.
    """
    try:
        x = jnp.asarray(x, dtype)
    except (TypeError, ValueError) as error:
        raise invalid(argument, must, f"it was {x!r}") from error
    if x.ndim != 0:
        raise invalid(argument, must, f"its shape was {x.shape}", fix)
    if concrete(x) and not np.isfinite(x):
        raise invalid(argument, "be finite", f"it was {x}")
    return x


def common(*arrays: Any) -> list[Any]:
    """Arrays of one dtype, the result type of all, for every promotion setting of JAX."""
    if all(x.dtype == arrays[0].dtype for x in arrays):
        return list(arrays)
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*arrays)
    return [x.astype(dtype) for x in arrays]


def of_state(argument: str, *arrays: Any) -> list[Any]:
    """Arrays of one dtype, that of a state; raises if it has less than 32 bits.

    In half precision the rounding of a motion is several percent, for all steps.
    """
    kinds = [x.dtype for x in arrays]
    if all(jnp.finfo(kind).bits < 32 for kind in kinds):
        digits = max(kinds, key=lambda kind: jnp.finfo(kind).precision)
        was = f"{digits.name} has {jnp.finfo(digits).precision} digits at most"
        fix = f"Write {argument.replace(',', ' ').split()[0]}.astype(float)."
        raise invalid(argument, "be float32 or float64", was, fix)
    return common(*arrays)


def reals(*given: tuple[str, Any, tuple[int, ...]]) -> list[Array]:
    """Real arrays of one dtype from (argument, value, shape); raises with the argument's name."""
    arrays = []
    for argument, x, shape in given:
        x = real(argument, x)
        if x.shape != shape:
            fix = "Use jax.vmap for batches." if x.ndim > len(shape) else ""
            raise invalid(argument, f"have shape {shape}", f"its shape was {x.shape}", fix)
        arrays.append(x)
    return common(*arrays)


def as_complex(x: Array) -> Array:
    """`x` as a complex array of the same precision."""
    return jax.lax.complex(x, jnp.zeros_like(x))


def elements(array: Array) -> list[Array]:
    """All elements of an array as a list, by static slices."""
    flat = jnp.reshape(array, (-1,))
    return [
        jax.lax.squeeze(jax.lax.slice_in_dim(flat, i, i + 1), (0,)) for i in range(flat.shape[0])
    ]
