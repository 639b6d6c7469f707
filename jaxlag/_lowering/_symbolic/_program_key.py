"""The cache key of a scalar program, and the jaxprs that the program is derived from."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxlag._linalg._kkt import FORMULATIONS
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._model._constraints import Baumgarte
from jaxlag._model._quasi_velocities import QuasiVelocities
from jaxlag._tracing import _params
from jaxlag._tracing._input_values import InputValues


class Key(NamedTuple):
    """The key of a scalar program: one program for each combination of shapes and static values."""

    lagrangian: Callable
    forces: tuple
    constraints: tuple
    size: int
    dtype: Any
    params: _params.Static  # shapes and dtypes
    static: _params.Static  # values that are not traced
    inputs: _params.Static  # shapes and dtypes of the inputs' values
    limit: int | None
    formulation: str
    baumgarte: Baumgarte | None
    regular: bool
    contact_rows_independent: bool
    quasi: QuasiVelocities | None
    in_u: Callable | None
    crossing: bool

    @property
    def of_terms(self) -> "Key":
        """The key of M, h, A and gamma, without forces, quasi-velocities and options of solves."""
        return self._replace(
            forces=(),
            inputs=_params.Static({}),
            formulation=FORMULATIONS[0],
            regular=False,
            contact_rows_independent=False,
            crossing=False,
            quasi=None,
            in_u=None,
        )


def key_of(terms: ArrayTerms, q: Any, params: Any, inputs: Mapping[str, Any], limit: Any) -> Key:
    """The key of a system with these params and values of its inputs, concrete or traced."""
    traced, static = _params.split(params)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), traced)
    given = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), dict(inputs)
    )
    return Key(
        terms.lagrangian,
        terms.forces,
        terms.constraints,
        q.shape[0],
        jnp.dtype(q.dtype),
        _params.Static(like),
        _params.Static(static),
        _params.Static(given),
        limit,
        terms.formulation,
        terms.baumgarte,
        terms.regular,
        terms.contact_rows_independent,
        terms.quasi,
        terms.in_u,
        terms.crossing,
    )


def _state(key: Key) -> tuple[Any, Any, Any]:
    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    q = jax.ShapeDtypeStruct((key.size,), key.dtype)
    return t, q, q


def traced(
    key: Key,
    function: Callable,
    with_inputs: bool,
    multipliers: int = 0,
    speeds: int | None = None,
) -> Any:
    """The jaxpr of a function of (t, q, v, params), with inputs and multipliers after them.

    With `speeds` it is a function of (t, q, u, params) with that number of u.
    """
    t, q, v = _state(key)
    if speeds is not None:
        v = jax.ShapeDtypeStruct((speeds,), key.dtype)

    def flat(t: Any, q: Any, v: Any, params: Any, inputs: Any, *lam: Any) -> Any:
        params = _params.join(params, key.static.tree)
        if not with_inputs:
            return function(t, q, v, params)
        return function(t, q, v, params, InputValues(inputs), *lam)

    if with_inputs:
        like = [jax.ShapeDtypeStruct((multipliers,), key.dtype)] if multipliers else []
        return jax.make_jaxpr(flat)(t, q, v, key.params.tree, key.inputs.tree, *like)
    return jax.make_jaxpr(partial(flat, inputs=None))(t, q, v, key.params.tree)
