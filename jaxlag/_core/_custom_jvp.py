"""Functions with custom derivative rules that every transform keeps.

`jax.custom_jvp` has the same purpose. But the reverse derivative of a scan splits its body into a
known and a linear part, and JAX then drops the rule (0.10): the second derivative of a loop is
that of the body. The rule of a primitive is kept.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, update_wrapper
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from jaxlag._core._jaxprs import rewritten
from jaxlag._core._tangents import Leaves, derivative, from_jax, is_constant, to_jax

NAME = "custom_jvp_call"


class AbstractRule(ABC):
    """The derivative of a function between lists of arrays."""

    @abstractmethod
    def __call__(self, primals: Leaves, dots: Leaves, /) -> tuple[Leaves, Leaves]:
        """(results, their tangents) at the arguments and tangents; None for a zero tangent."""

    @property
    @abstractmethod
    def key(self) -> Any:
        """Equal for equal rules."""


class CustomJVP:
    """A function of pytrees of arrays, with a rule for its derivatives.

    It is used as `jax.custom_jvp`, with these differences: neither the function nor its rule may
    have a traced value in its closure; zero tangents are None for a rule with `symbolic_zeros`;
    any rule may return None for zero tangents, or for all of them.

    Attributes:
        function: of arrays.
    """

    function: Callable

    def __init__(self, function: Callable) -> None:
        self.function = function
        self._traced = jax.jit(function)
        self._rule: Callable | None = None
        self._symbolic_zeros = False
        update_wrapper(self, function)

    def defjvp(self, rule: Callable, symbolic_zeros: bool = False) -> Callable:
        """Set the rule (arguments, tangents) -> (results, tangents)."""
        self._rule, self._symbolic_zeros = rule, symbolic_zeros
        return rule

    def __call__(self, *args: Any) -> Any:
        """The results of the function."""
        leaves, tree = jax.tree.flatten(args)
        if not any(isinstance(x, Tracer) for x in leaves):  # no derivative is possible
            return self.function(*args)
        with jax.disable_jit(False):
            traced = self._traced.trace(*args)
        results = bind_rule(list(map(jnp.asarray, leaves)), traced.jaxpr, _Flat(self, tree))
        return jax.tree.unflatten(jax.tree.structure(traced.out_info), results)

    def derivative(self, args: tuple, dots: tuple) -> tuple[Any, Any]:
        """(results, their tangents); None for a zero tangent."""
        assert self._rule is not None
        if not self._symbolic_zeros:
            leaves, tree = jax.tree.flatten(args)
            pairs = zip(leaves, tree.flatten_up_to(dots), strict=True)
            dots = tree.unflatten([_zero(x) if dot is None else dot for x, dot in pairs])
        return self._rule(args, dots)


@dataclass(frozen=True)
class _Flat(AbstractRule):
    """The rule of a function between lists of leaves; `tree` is the structure of its arguments."""

    custom: CustomJVP
    tree: Any

    def __call__(self, primals: Leaves, dots: Leaves) -> tuple[Leaves, Leaves]:
        args, tangents = (jax.tree.unflatten(self.tree, x) for x in (primals, dots))
        results, result_dots = self.custom.derivative(args, tangents)
        leaves, tree = jax.tree.flatten(results)
        if result_dots is None:
            return leaves, [None] * len(leaves)
        return leaves, [None if is_constant(x) else x for x in tree.flatten_up_to(result_dots)]

    @property
    def key(self) -> Any:
        """The function, and the structure of its arguments."""
        return self


@dataclass(frozen=True, eq=False)
class _Users(AbstractRule):
    """The rule of an equation made by `jax.custom_jvp`.

    Its program is traced, so that rules in it are kept, too.
    """

    eqn: Any

    def __call__(self, primals: Leaves, dots: Leaves) -> tuple[Leaves, Leaves]:
        def call(*args: Any) -> list:
            params = self.eqn.primitive.get_bind_params(self.eqn.params)
            return self.eqn.primitive.bind(*args, **params)

        return keeping_rules(partial(derivative, call))(list(primals), list(dots))

    @property
    def key(self) -> Any:
        """The user's function."""
        rule = self.eqn.params["jvp_jaxpr_fun"]
        return id(getattr(rule, "f", rule))


@dataclass(frozen=True)
class _Rows(AbstractRule):
    """The rule of a function vmapped over the arguments whose axis is 0, not None."""

    rule: AbstractRule
    axes: tuple[int | None, ...]
    size: Any

    def __call__(self, primals: Leaves, dots: Leaves) -> tuple[Leaves, Leaves]:
        axes = list(self.axes)
        moving = [None if dot is None else axis for axis, dot in zip(axes, dots, strict=True)]
        over = jax.vmap(self.rule, (axes, moving), axis_size=self.size)
        return over(list(primals), list(dots))

    @property
    def key(self) -> Any:
        """The rule, and the mapped arguments."""
        return self.rule.key, self.axes, self.size


def with_rules_kept(program: ClosedJaxpr) -> ClosedJaxpr:
    """The same program; rules by `jax.custom_jvp` are kept with their functions."""
    return rewritten(program, with_rule_kept)


def keeping_rules(function: Callable) -> Callable:
    """The function with `with_rules_kept` applied to its program; traced by every call."""

    def wrapped(*args: Any) -> Any:
        program, like = jax.make_jaxpr(function, return_shape=True)(*args)
        found = jaxpr_as_fun(with_rules_kept(program))(*jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(like), found)

    return wrapped


def with_rule_kept(eqn: Any) -> Any:
    """The same equation; a rule by `jax.custom_jvp` is kept with it."""
    if eqn.primitive.name != NAME or eqn.primitive is _custom_jvp:
        return eqn
    return with_rule(eqn, eqn.params["call_jaxpr"], _Users(eqn))


def with_rule(eqn: Any, call_jaxpr: ClosedJaxpr, rule: AbstractRule) -> Any:
    """An equation of this program and rule in place of another."""
    params = {"call_jaxpr": call_jaxpr, "rule": rule}
    return eqn.replace(primitive=_custom_jvp, params=params)


def _zero(x: Any) -> Any:
    """The tangent of a constant."""
    if jnp.issubdtype(jnp.result_type(x), jnp.inexact):
        return jnp.zeros_like(x)
    return np.zeros(jnp.shape(x), jax.dtypes.float0)


_custom_jvp = Primitive(NAME)
_custom_jvp.multiple_results = True


def bind_rule(args: Leaves, call_jaxpr: ClosedJaxpr, rule: AbstractRule) -> list:
    """The results of a program with this rule."""
    return _custom_jvp.bind(*args, call_jaxpr=call_jaxpr, rule=rule)


def _evaluate(*args: Any, call_jaxpr: ClosedJaxpr, rule: AbstractRule) -> list:
    del rule
    return jaxpr_as_fun(call_jaxpr)(*args)


_custom_jvp.def_impl(_evaluate)
# From jax 0.12 on programs are rewritten in simpler primitives before they are compiled, after all
# derivatives: the rule is no longer needed.
_custom_jvp.to_lojax = _evaluate
mlir.register_lowering(_custom_jvp, mlir.lower_fun(_evaluate, multiple_results=True))


@_custom_jvp.def_effectful_abstract_eval
def _shapes(*_: Any, call_jaxpr: ClosedJaxpr, rule: AbstractRule) -> tuple[list[ShapedArray], Any]:
    del rule
    return list(call_jaxpr.out_avals), call_jaxpr.effects


def _derivative(
    primals: Leaves, tangents: Leaves, *, call_jaxpr: ClosedJaxpr, rule: AbstractRule
) -> tuple[list, list]:
    del call_jaxpr
    results, found = rule(list(map(jnp.asarray, primals)), from_jax(tangents))
    return list(results), to_jax(results, found)


ad.primitive_jvps[_custom_jvp] = _derivative


def _transposed(
    cotangents: Leaves, *args: Any, call_jaxpr: ClosedJaxpr, rule: AbstractRule
) -> list:
    """The transpose of the function itself, as in JAX: a rule may call it on linear arguments."""
    del rule
    linear = [i for i, x in enumerate(args) if ad.is_undefined_primal(x)]

    def of(*moving: Any) -> Leaves:
        whole = list(args)
        for i, x in zip(linear, moving, strict=True):
            whole[i] = x
        return jaxpr_as_fun(call_jaxpr)(*whole)

    like = [jax.ShapeDtypeStruct(args[i].aval.shape, args[i].aval.dtype) for i in linear]
    pairs = zip(cotangents, call_jaxpr.out_avals, strict=True)
    given = [jnp.zeros(y.shape, y.dtype) if type(x) is ad.Zero else x for x, y in pairs]
    found = dict(zip(linear, jax.linear_transpose(of, *like)(given), strict=True))
    return [found.get(i) for i in range(len(args))]


ad.primitive_transposes[_custom_jvp] = _transposed


def _batched(args: Leaves, axes: Leaves, *, call_jaxpr: ClosedJaxpr, rule: AbstractRule) -> tuple:
    """Batch axes in front of all results: one program for every result of the rule."""
    pairs = list(zip(args, axes, strict=True))
    (size, *_) = (x.shape[i] for x, i in pairs if i is not None)
    args = [x if i is None else jnp.moveaxis(x, i, 0) for x, i in pairs]
    over = tuple(None if i is None else 0 for i in axes)
    function = jax.vmap(jaxpr_as_fun(call_jaxpr), over, axis_size=size)
    results = bind_rule(args, jax.make_jaxpr(function)(*args), _Rows(rule, over, size))
    return results, [0] * len(results)


batching.primitive_batchers[_custom_jvp] = _batched
