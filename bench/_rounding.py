"""What the roundings inside a computation may do to its results: every one drawn at random.

Random rounding of each operation, repeated, shows how many digits of a result are significant
(Vignes 2004, Discrete stochastic arithmetic for validating results of numerical software).
"""

from typing import Any

import jax
import numpy as np

# Exact in floating point: a number moved, chosen or of another sign.
_CHOSEN = ("abs", "neg", "sign", "max", "min", "clamp", "floor", "round", "select_n", "sort")
_REDUCED = ("reduce_max", "reduce_min", "cummax", "cummin")
_MOVED = ("slice", "squeeze", "reshape", "broadcast_in_dim", "transpose", "concatenate", "stack")
_MOVED_ALSO = ("unstack", "split", "pad", "rev", "tile", "gather", "scatter", "dynamic_slice")
_KEPT = ("stop_gradient", "copy", "optimization_barrier", "iota", "convert_element_type")
EXACT = {*_CHOSEN, *_REDUCED, *_MOVED, *_MOVED_ALSO, *_KEPT, "dynamic_update_slice", "expand_dims"}
CALLS = {  # primitive: the name of what it calls
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "remat2": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}


def evaluated(
    closed: Any, args: list[Any], eps: float = 0.0, rng: np.random.Generator | None = None
) -> list[Any]:
    """The results of a traced function, operation by operation.

    Args:
        closed: what `jax.make_jaxpr` gives.
        args: its arguments, flat.
        eps: each result of an operation that rounds is multiplied by 1 + eps u, u in -1 to 1.
        rng: where u comes from; None: no result is changed.
    """
    return _run(getattr(closed, "jaxpr", closed), getattr(closed, "consts", ()), args, eps, rng)


def _run(jaxpr: Any, consts: Any, args: Any, eps: float, rng: Any) -> list[Any]:
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *args), strict=True))

    def read(x: Any) -> Any:
        return x.val if hasattr(x, "val") else known[x]

    for eqn in jaxpr.eqns:
        given = [read(x) for x in eqn.invars]
        name = eqn.primitive.name
        if name in CALLS:
            outs = evaluated(eqn.params[CALLS[name]], given, eps, rng)
        else:
            found = eqn.primitive.bind(*given, **eqn.params)
            outs = list(found) if eqn.primitive.multiple_results else [found]
            if rng is not None and name not in EXACT:
                outs = [_rounded(x, eps, rng) for x in outs]
        known.update(zip(eqn.outvars, outs, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _rounded(x: Any, eps: float, rng: np.random.Generator) -> Any:
    """The number with another rounding; zeros, whole numbers and truths stay as they are."""
    if not jax.numpy.issubdtype(x.dtype, np.floating):
        return x
    factor = 1.0 + eps * rng.uniform(-1.0, 1.0, x.shape)
    return x * factor.astype(x.dtype)
