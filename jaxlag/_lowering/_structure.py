"""Structure of the traced equations: their dependences, from the jaxprs."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxlag._core._arrays import concrete
from jaxlag._tracing._dependence import outputs_depend_on


class Structure(NamedTuple):
    """Dependencies on "t", "q", "v" and "params" of the mass matrix, the bias and the Lagrangian.

    Read from the traced program, never from numbers: a dependence that cancels only
    algebraically is still listed, one that is not listed is certainly absent.
    """

    mass: frozenset[str]
    bias: frozenset[str]
    lagrangian: frozenset[str]
    bias_zero: bool

    @property
    def quadratic(self) -> bool:
        """Whether M does not depend on v."""
        return "v" not in self.mass

    @property
    def mass_constant(self) -> bool:
        """Whether M depends on params alone."""
        return not self.mass & {"t", "q", "v"}

    @property
    def explicit_time(self) -> bool:
        """Whether L depends on t at fixed q and v."""
        return "t" in self.lagrangian


def find_structure(
    mass: Callable, bias: Callable, lagrangian: Callable, state: tuple, params: Any
) -> Structure:
    """Trace M, h and L, functions of (t, q, v, params), and follow each argument.

    Args:
        mass: M(t, q, v, params).
        bias: h(t, q, v, params).
        lagrangian: L(t, q, v, params).
        state: shapes and dtypes of (t, q, v).
        params: shapes and dtypes of the traced parameters.
    """

    def depends_on(function: Any) -> frozenset[str]:
        closed = jax.make_jaxpr(function)(*state, params)
        given = [frozenset({name}) for name in ("t", "q", "v")]
        given += [frozenset({"params"})] * (len(closed.jaxpr.invars) - 3)
        return frozenset().union(*outputs_depend_on(closed.jaxpr, given))

    of_bias = depends_on(bias)
    bias_zero = not of_bias and _vanishes(bias, state, params)
    return Structure(depends_on(mass), of_bias, depends_on(lagrangian), bias_zero)


def _vanishes(function: Any, state: tuple, params: Any) -> bool:
    """Whether a function that depends on none of its arguments is zero, from one value.

    False if it has no value, as under a transform that traces its closure.
    """
    with jax.ensure_compile_time_eval():
        state, params = jax.tree.map(_ones, (state, params))
        anything = jnp.any(function(*state, params))
        return concrete(anything) and not bool(anything)


def _ones(like: jax.ShapeDtypeStruct) -> Any:
    ones = jnp.ones(like.shape, like.dtype)
    return jnp.broadcast_to(1.0, like.shape) if like.weak_type else ones
