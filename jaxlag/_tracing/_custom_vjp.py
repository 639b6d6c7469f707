"""Forward derivatives of user functions that have only a reverse rule (`jax.custom_vjp`).

JAX refuses forward derivatives of them. Rates along a motion, Jacobians of implicit steps and
`jax.jacfwd` need these. The rule x, y -> J(x)^T y gives the rows of J, and so J(x) x'.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxlag._core._custom_jvp import AbstractRule, Leaves, bind_rule, with_rule, with_rules_kept
from jaxlag._core._jaxprs import rewritten
from jaxlag._core._linear_map import LinearMap, linear


@dataclass(frozen=True, eq=False)
class _VjpRule(AbstractRule):
    """The rule of an equation made by `jax.custom_vjp`."""

    eqn: Any

    def __call__(self, primals: Leaves, dots: Leaves) -> tuple[Leaves, Leaves]:
        results = bind_rule(primals, self.eqn.params["call_jaxpr"], self)
        inexact = [x for x in primals if _is_inexact(x)]
        moves = [d for x, d in zip(primals, dots, strict=True) if _is_inexact(x)]
        moves = [jnp.zeros_like(x) if d is None else d for x, d in zip(inexact, moves, strict=True)]
        form = LinearMap(self._forward, self._backward, self._forward, self._backward, at_once=None)
        found = iter(linear(form, list(primals), moves))
        return results, [next(found) if _is_inexact(x) else None for x in results]

    def _backward(self, r: Leaves, y: Leaves) -> list:
        return list(jaxpr_as_fun(self._vjp_jaxpr)(*r, *y))

    def _forward(self, r: Leaves, x: Leaves) -> list:
        """By the rows of J, one for each number of the results."""
        like = [x.aval for x in self.eqn.outvars if _is_inexact(x.aval)]
        zeros = [jnp.zeros(each.shape, each.dtype) for each in like]
        found = []
        for k, each in enumerate(like):

            def row(unit: Any, k: int = k) -> list:
                return self._backward(r, [*zeros[:k], unit, *zeros[k + 1 :]])

            units = jnp.eye(each.size, dtype=each.dtype).reshape(each.size, *each.shape)
            rows = jax.vmap(row)(units)
            pairs = zip(rows, x, strict=True)
            parts = [a.reshape(each.size, -1) @ b.reshape(-1) for a, b in pairs]
            found.append(sum(parts[1:], parts[0]).reshape(each.shape))
        return found

    @cached_property
    def _vjp_jaxpr(self) -> ClosedJaxpr:
        """(arguments, y) -> J^T y as a jaxpr: the rule itself has no derivative in JAX."""
        given = [x.aval for x in self.eqn.invars]
        moving = [i for i, x in enumerate(given) if _is_inexact(x)]

        def vjp_fn(args: list, y: list) -> Any:
            def along(*moved: Any) -> list:
                whole = list(args)
                for i, x in zip(moving, moved, strict=True):
                    whole[i] = x
                params = self.eqn.primitive.get_bind_params(self.eqn.params)
                results = self.eqn.primitive.bind(*whole, **params)
                return [x for x in results if _is_inexact(x)]

            return jax.vjp(along, *(args[i] for i in moving))[1](y)

        like = [x.aval for x in self.eqn.outvars if _is_inexact(x.aval)]
        shapes = [[jax.ShapeDtypeStruct(x.shape, x.dtype) for x in some] for some in (given, like)]
        return with_rules_kept(with_forward_derivatives(jax.make_jaxpr(vjp_fn)(*shapes)))

    @property
    def key(self) -> Any:
        """The equation."""
        return id(self.eqn)


def with_forward_derivatives(program: ClosedJaxpr) -> ClosedJaxpr:
    """The same program; functions with a `jax.custom_vjp` rule have forward derivatives."""
    return rewritten(program, _with_vjp_rule)


def _with_vjp_rule(eqn: Any) -> Any:
    if not eqn.primitive.name.startswith("custom_vjp_call"):
        return eqn
    return with_rule(eqn, eqn.params["call_jaxpr"], _VjpRule(eqn))


def _is_inexact(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)
