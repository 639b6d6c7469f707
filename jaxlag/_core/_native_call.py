"""Calls that XLA compiles to one native function, where it can.

XLA runs a compiled program as a list of tasks: each of them starts a kernel or calls a library, and
allocates memory. For a few numbers this takes longer than the arithmetic. The tasks of a solve are
some hundred, apart from its loop. A native function has none.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from jaxlag._core import _xla
from jaxlag._core._jaxprs import equations
from jaxlag._core._tangents import derivative, from_jax, to_jax
from jaxlag._core._written_out import has_form, written_out

_native_call = Primitive("native_call")
_native_call.multiple_results = True


def native_call(function: Callable, *args: PyTree) -> PyTree:
    """function(*args), as one native function unless it is vmapped or differentiated.

    Args:
        function: of pytrees of arrays.
        args: these.
    """
    leaves, tree = jax.tree.flatten(args)
    program, like = jax.make_jaxpr(
        lambda *leaves: function(*jax.tree.unflatten(tree, leaves)), return_shape=True
    )(*leaves)
    marks = _only_lowering_remains(program)
    found = _called(program, leaves) if marks else jaxpr_as_fun(program)(*leaves)
    return jax.tree.unflatten(jax.tree.structure(like), found)


def _only_lowering_remains(program: ClosedJaxpr) -> bool:
    """Whether a program has no effects, and no operations that JAX 0.12 replaces before that."""
    return not program.effects and not getattr(program.jaxpr, "is_high", False)


def _called(program: ClosedJaxpr, leaves: Sequence[Any]) -> list[Any]:
    """The results; those that are arguments do not pass through the call."""
    jaxpr = program.jaxpr
    variables = *jaxpr.constvars, *jaxpr.invars
    given = [*program.consts, *leaves]
    known = dict(zip(variables, given, strict=True))
    outputs = [x for x in jaxpr.outvars if not isinstance(x, Literal) and x not in known]
    # JAX stores constants within a program: as arguments they are values of the call.
    inner: Any = jaxpr.replace(
        constvars=[],
        invars=list(variables),
        outvars=outputs,
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    found = iter(_native_call.bind(*given, program=ClosedJaxpr(inner, [])))

    def result(x: Any) -> Any:
        if isinstance(x, Literal):
            kind: Any = x.aval
            return jnp.asarray(x.val, kind.dtype)
        return known[x] if x in known else next(found)

    return list(map(result, jaxpr.outvars))


@_native_call.def_impl
def _evaluate(*args: Any, program: ClosedJaxpr) -> list:
    return jax.jit(jaxpr_as_fun(program))(*args)


@_native_call.def_abstract_eval
def _(*_: Any, program: ClosedJaxpr) -> list:
    return list(program.out_avals)


def _as_it_is(*args: Any, program: ClosedJaxpr) -> list:
    return jaxpr_as_fun(program)(*args)


def _on_cpu(*args: Any, program: ClosedJaxpr) -> list:
    known = all(map(_is_known, program.in_avals))
    if _xla.may_mark() and known and all(map(_is_native, equations(program))):
        return _xla.marked(jaxpr_as_fun(written_out(program)), args)
    return _as_it_is(*args, program=program)


def _is_known(aval: Any) -> bool:
    """Whether an array has numbers as sizes, not symbols of `jax.export`, and no random keys."""
    extended = jax.dtypes.issubdtype(aval.dtype, jax.dtypes.extended)
    return not extended and all(isinstance(n, int) for n in aval.shape)


def _is_native(eqn: Any) -> bool:
    return has_form(eqn) or _xla.is_plain_operation(eqn)


mlir.register_lowering(_native_call, mlir.lower_fun(_as_it_is, multiple_results=True))
mlir.register_lowering(_native_call, mlir.lower_fun(_on_cpu, multiple_results=True), platform="cpu")


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], *, program: ClosedJaxpr) -> tuple:
    found, dots = derivative(jaxpr_as_fun(program), primals, from_jax(tangents))
    return found, to_jax(found, dots)


ad.primitive_jvps[_native_call] = _jvp


def _batched(args: Sequence[Any], axes: Sequence[Any], *, program: ClosedJaxpr) -> tuple:
    found = jax.vmap(jaxpr_as_fun(program), tuple(axes))(*args)
    return found, [0] * len(found)


batching.primitive_batchers[_native_call] = _batched
