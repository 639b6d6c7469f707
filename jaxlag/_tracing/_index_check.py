"""Check of out-of-range indices in user functions: JAX silently clamps them."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import requirement
from jaxlag._core._jaxprs import called
from jaxlag._tracing._interpret import NUMPY, equation


class OutOfRange(ValueError):
    """An index beyond the coordinates."""


def check_indices(
    closed: ClosedJaxpr, watched: Sequence[str | None], of: str = "lagrangian and forces"
) -> None:
    """Raise if a fixed index is beyond a vector of coordinates or velocities.

    Indices with an explicit mode (`jnp.take(..., mode="clip")`) are accepted. Indices that
    depend on values are unknown here.

    Args:
        closed: a traced function.
        watched: names of its arguments that are such vectors; None for others.
        of: name of the function in errors.

    Raises:
        OutOfRange: an index is out of range.
    """
    pairs = zip(closed.jaxpr.invars, watched, strict=True)
    vectors = {var: name for var, name in pairs if name is not None}
    _walk(closed.jaxpr, vectors, _fixed(closed), of)


def _fixed(closed: ClosedJaxpr) -> dict[Any, Any]:
    pairs = zip(closed.jaxpr.constvars, closed.consts, strict=True)
    return {var: x for var, x in pairs if _small(x)}


def _small(x: Any) -> bool:
    kind = getattr(x, "dtype", None)
    if kind is None or not concrete(x) or jax.dtypes.issubdtype(kind, jax.dtypes.extended):
        return False
    whole = np.issubdtype(kind, np.integer) or np.issubdtype(kind, np.bool_)
    return whole and x.size <= 1000


def _walk(jaxpr: Jaxpr, vectors: dict[Any, str], known: dict[Any, Any], of: str) -> None:
    def value(atom: Any) -> Any:
        return np.asarray(atom.val) if isinstance(atom, Literal) else known.get(atom)

    for eqn in jaxpr.eqns:
        values = [value(atom) for atom in eqn.invars]
        first = eqn.invars[0] if eqn.invars else None
        if not isinstance(first, Literal) and first in vectors:
            _check(eqn, vectors[first], values[1:], of)
        inner = called(eqn)
        if inner is not None:
            inside = list(zip(inner.jaxpr.invars, eqn.invars, values, strict=True))
            _walk(
                inner.jaxpr,
                {
                    var: vectors[atom]
                    for var, atom, _ in inside
                    if not isinstance(atom, Literal) and atom in vectors
                },
                {var: x for var, _, x in inside if x is not None} | _fixed(inner),
                of,
            )
        elif eqn.primitive.name in NUMPY and all(x is not None for x in values):
            results = equation(eqn, [np.asarray(x) for x in values])
            known |= {v: x for v, x in zip(eqn.outvars, results, strict=True) if _small(x)}


def _check(eqn: Any, name: str, indices: list[Any], of: str) -> None:
    (size,) = eqn.invars[0].aval.shape
    kind, params = eqn.primitive.name, eqn.params
    if kind == "dynamic_slice" or (
        kind == "gather" and params["mode"] == jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    ):
        (start,), (width,) = indices, params["slice_sizes"]
    else:
        return
    if start is None:
        return
    off = [int(i) for i in np.ravel(start) if not 0 <= i <= size - width]
    if off:
        where = source_info_util.summarize(eqn.source_info)
        taken = off[0] if off[0] >= 0 else off[0] - size
        raise OutOfRange(
            requirement(
                of,
                f"take indices from {-size} to {size - 1} of {name}, which has {size} entries",
                f"{name}[{taken}] was taken" + (f" at {where}" if where else ""),
                "JAX would read the nearest entry. For that, write jnp.take(..., mode='clip').",
            )
        )
