"""Maximum and minimum of several scalars, with the derivative that JAX uses for arrays.

Nested pairs would give the value. If k of the scalars are equal, the derivative is the mean of
theirs; nested pairs would weigh the last one as much as all before it. An array of the scalars
would give the derivative, but XLA does not turn operations on such rows into vector instructions.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def _made(name: str, pair: Callable, order: Callable) -> Primitive:
    """The primitive; `order` compares two scalars, true for an extreme or a tie."""
    primitive = Primitive(name)

    def value(*args: Any) -> Any:
        return reduce(pair, args)

    def derivative(primals: Any, tangents: Any) -> tuple[Any, Any]:
        out = primitive.bind(*primals)
        moved = [(x, d) for x, d in zip(primals, tangents, strict=True) if type(d) is not ad.Zero]
        if not moved:
            return out, ad.Zero(ShapedArray(out.shape, out.dtype))

        def ties(x: Any) -> Any:
            return reduce(lax.bitwise_and, [order(x, y) for y in primals])

        zero, one = jnp.zeros_like(out), jnp.ones_like(out)
        count = reduce(lax.add, [lax.select(ties(x), one, zero) for x in primals])
        total = reduce(lax.add, [lax.select(ties(x), d, zero) for x, d in moved])
        return out, lax.div(total, count)

    def batched(args: Any, axes: Any) -> tuple[Any, int]:
        fronts = [
            x if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(args, axes, strict=True)
        ]
        return primitive.bind(*jnp.broadcast_arrays(*fronts)), 0

    primitive.def_impl(value)
    primitive.def_abstract_eval(lambda x, *_: ShapedArray(x.shape, x.dtype))
    mlir.register_lowering(primitive, mlir.lower_fun(value, multiple_results=False))
    ad.primitive_jvps[primitive] = derivative
    batching.primitive_batchers[primitive] = batched
    return primitive


largest_p = _made("largest", lax.max, lax.ge)
smallest_p = _made("smallest", lax.min, lax.le)
