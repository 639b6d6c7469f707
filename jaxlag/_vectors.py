"""Numbers given by the user: lists, arrays or dicts by name, as real arrays of one precision."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag._coordinates import Coordinates
from jaxlag._errors import bad
from jaxlag._params import concrete


def real(argument: str, x: Any) -> Array:
    """`x` as a real inexact array of any shape; raises naming `argument` if it cannot be one."""
    try:
        # float() keeps a Python number weakly typed: it takes the dtype of the arrays it meets.
        x = jnp.asarray(float(x) if isinstance(x, int) else x)
    except (TypeError, ValueError, OverflowError) as error:
        raise bad(argument, "be real numbers", f"it was {x!r}") from error
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise bad(argument, "be real", f"its dtype was {x.dtype}")
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def number(argument: str, must: str, x: Any, dtype: Any) -> Array:
    """`x` as a scalar of this dtype, finite where its value is known; raises if it cannot be one.

    Args:
        argument: as errors name it.
        must: what it is to be, in words.
        x: anything.
        dtype: of the result.
    """
    try:
        x = jnp.asarray(x, dtype)
    except (TypeError, ValueError) as error:
        raise bad(argument, must, f"it was {x!r}") from error
    if x.ndim != 0:
        raise bad(argument, must, f"its shape was {x.shape}")
    if concrete(x) and not np.isfinite(x):
        raise bad(argument, "be finite", f"it was {x}")
    return x


def common(*arrays: Array) -> list[Array]:
    """Arrays of one dtype, the result type of all, whatever the promotion JAX is set to."""
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*arrays)
    return [x.astype(dtype) for x in arrays]


def of_state(argument: str, *arrays: Array) -> list[Array]:
    """Arrays of one dtype, that of a state; raises where it has less than 32 bits.

    Of a motion in half precision whole percents are rounding, whatever the steps are.
    """
    state = common(*arrays)
    dtype = state[0].dtype
    if jnp.finfo(dtype).bits < 32:
        was = f"in {dtype.name} equations keep {jnp.finfo(dtype).precision} digits at most"
        fix = f"Write {argument.replace(',', ' ').split()[0]}.astype(float)."
        raise bad(argument, "be float32 or float64", was, fix)
    return state


def reals(*given: tuple[str, Any, tuple[int, ...]]) -> list[Array]:
    """Real arrays of one dtype from (argument, value, shape); raises naming the argument."""
    arrays = []
    for argument, x, shape in given:
        x = real(argument, x)
        if x.shape != shape:
            fix = "Use jax.vmap for batches." if x.ndim > len(shape) else ""
            raise bad(argument, f"have shape {shape}", f"its shape was {x.shape}", fix)
        arrays.append(x)
    return common(*arrays)


def vector(coordinates: Coordinates, argument: str, x: Any) -> Array:
    """`x` as an inexact array of shape (n,); raises naming `argument` if it cannot be one.

    A number will do for a single coordinate.
    """
    n = coordinates.size
    fix = f"Give one entry per coordinate, in the order {list(coordinates.labels)}."
    if isinstance(x, Mapping):
        x = coordinates.flatten(x, argument)
    try:
        x = jnp.asarray(x)
    except (TypeError, ValueError) as error:
        raise bad(argument, f"be {n} numbers", f"it was {x!r}", fix) from error
    if n == 1 and x.shape == ():
        x = x[None]
    if x.shape != (n,):
        raise bad(argument, f"have shape ({n},)", f"its shape was {x.shape}", fix)
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise bad(argument, "be real", f"its dtype was {x.dtype}")
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def state_vectors(coordinates: Coordinates, q: Any, v: Any) -> tuple[Array, Any]:
    """(q, v) as flat vectors of one dtype, the result type of both; v may be None."""
    q = vector(coordinates, "q", q)
    if v is None:
        return of_state("q", q)[0], None
    q, v = of_state("q and v", q, vector(coordinates, "v", v))
    return q, v
