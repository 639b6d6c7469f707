"""Maximum and minimum of pairs of arrays and of several scalars, with sound derivatives.

JAX's derivative compares the result with the operands. XLA may compute an operand anew, with
another rounding. No operand is then equal to the result, and the derivative is zero (jaxlib 0.10.2,
CPU, inside `jax.jit`). Here operands are compared with one another.

Nested pairs would give the value of several scalars. If k of them are equal, the derivative is the
mean of theirs; nested pairs would weigh the last one as much as all before it. An array of the
scalars would give the derivative, but XLA does not turn operations on such rows into vector
instructions.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import ad, batching, mlir

from jaxlag._core._jaxprs import rewritten


def _made(name: str, pair: Callable, order: Callable) -> Primitive:
    """The primitive; `order` compares two operands, true for an extreme or a tie."""
    primitive = Primitive(name)

    def value(*args: Any) -> Any:
        return reduce(pair, args)

    def derivative(primals: Any, tangents: Any) -> tuple[Any, Any]:
        out = primitive.bind(*primals)
        given = [(x, d) for x, d in zip(primals, tangents, strict=True) if type(d) is not ad.Zero]
        if not given:
            return out, ad.Zero(ShapedArray(out.shape, out.dtype))
        # As in JAX's primitives, an operand may have axes of size 1 in place of others.
        moved = [tuple(jnp.broadcast_to(y, out.shape) for y in each) for each in given]
        primals = [jnp.broadcast_to(x, out.shape) for x in primals]

        def ties(x: Any) -> Any:
            return reduce(lax.bitwise_and, [order(x, y) for y in primals])

        zero, one = jnp.zeros_like(out), jnp.ones_like(out)
        count = reduce(lax.add, [lax.select(ties(x), one, zero) for x in primals])
        total = reduce(lax.add, [lax.select(ties(x), d, zero) for x, d in moved])
        return out, lax.div(total, lax.max(count, one))  # 0 for NaN, as JAX's

    def shape(*avals: Any) -> ShapedArray:
        return ShapedArray(jnp.broadcast_shapes(*(x.shape for x in avals)), avals[0].dtype)

    def batched(args: Any, axes: Any) -> tuple[Any, int]:
        (dtype, *_) = (x.dtype for x, axis in zip(args, axes, strict=True) if axis is not None)
        # A number of an interpreted program is no array.
        pairs = [(jnp.asarray(x, dtype), axis) for x, axis in zip(args, axes, strict=True)]
        rank = max(x.ndim - (axis is not None) for x, axis in pairs)

        def front(x: Any, axis: int | None) -> Any:
            """Lanes first, then as many axes as the operand with most: a scalar has none."""
            x = x[None] if axis is None else jnp.moveaxis(x, axis, 0)
            missing = rank + 1 - x.ndim
            return x.reshape(x.shape[0], *(1,) * missing, *x.shape[1:])

        return primitive.bind(*jnp.broadcast_arrays(*(front(*pair) for pair in pairs))), 0

    primitive.def_impl(value)
    primitive.def_abstract_eval(shape)
    mlir.register_lowering(primitive, mlir.lower_fun(value, multiple_results=False))
    ad.primitive_jvps[primitive] = derivative
    batching.primitive_batchers[primitive] = batched
    return primitive


largest_p = _made("largest", lax.max, lax.ge)
smallest_p = _made("smallest", lax.min, lax.le)

# By the names of JAX's primitives, which tables of operations know.
_PAIRS = {lax.max_p: _made("max", lax.max, lax.ge), lax.min_p: _made("min", lax.min, lax.le)}


def with_sound_extremes(program: ClosedJaxpr) -> ClosedJaxpr:
    """The same program; maximum and minimum of floats have the derivatives above."""
    return rewritten(program, _with_sound_extreme)


def _with_sound_extreme(eqn: Any) -> Any:
    if eqn.primitive not in _PAIRS or not jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating):
        return eqn
    return eqn.replace(primitive=_PAIRS[eqn.primitive], params={})
