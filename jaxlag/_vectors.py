"""States given by the user: lists, arrays or dicts by name, as flat vectors."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxlag._coordinates import Coordinates
from jaxlag._errors import bad


def vector(coordinates: Coordinates, argument: str, x: Any) -> Array:
    """`x` as an inexact array of shape (n,); raises naming `argument` if it cannot be one."""
    n = coordinates.size
    fix = f"Give one entry per coordinate, in the order {list(coordinates.labels)}."
    if isinstance(x, Mapping):
        x = coordinates.flatten(x, argument)
    try:
        x = jnp.asarray(x)
    except (TypeError, ValueError) as error:
        raise bad(argument, f"be {n} numbers", f"it was {x!r}", fix) from error
    if x.shape != (n,):
        raise bad(argument, f"have shape ({n},)", f"its shape was {x.shape}", fix)
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise bad(argument, "be real", f"its dtype was {x.dtype}")
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def state_vectors(coordinates: Coordinates, q: Any, v: Any) -> tuple[Array, Any]:
    """(q, v) as flat vectors of one dtype, the result type of both; v may be None."""
    q = vector(coordinates, "q", q)
    if v is None:
        return q, None
    v = vector(coordinates, "v", v)
    dtype = jnp.result_type(q, v)
    return q.astype(dtype), v.astype(dtype)
