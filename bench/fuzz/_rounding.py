"""The effect of rounding errors on the results of a computation, by random rounding.

Repeated random rounding of each operation shows how many digits of a result are significant
(Vignes 2004, Discrete stochastic arithmetic for validating results of numerical software).

Common operations use numpy functions written for this module only. They are independent of the
derivation of the scalar program and of its verification, and need no compilation. Other operations
use JAX.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxlag._tracing._dependence import scan_sizes

# Exact in floating point: numbers are moved, selected or change sign.
_CHOSEN = ("abs", "neg", "sign", "max", "min", "clamp", "floor", "round", "select_n", "sort")
_REDUCED = ("reduce_max", "reduce_min", "cummax", "cummin")
_MOVED = ("slice", "squeeze", "reshape", "broadcast_in_dim", "transpose", "concatenate", "stack")
_MOVED_ALSO = ("unstack", "split", "pad", "rev", "tile", "gather", "scatter", "dynamic_slice")
_EQUAL = ("stop_gradient", "copy", "optimization_barrier", "iota", "convert_element_type")
EXACT = {*_CHOSEN, *_REDUCED, *_MOVED, *_MOVED_ALSO, *_EQUAL, "dynamic_update_slice", "expand_dims"}
CALLS = {  # primitive: the name of its parameter with the called program
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "remat2": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}


def _sliced(p: Any, x: Any) -> Any:
    strides = p["strides"] or (1,) * x.ndim
    ranges = zip(p["start_indices"], p["limit_indices"], strides, strict=True)
    return x[tuple(slice(*r) for r in ranges)]


def _broadcast(p: Any, x: Any) -> Any:
    shape = [1] * len(p["shape"])
    for axis, size in zip(p["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), p["shape"])


def _counted(p: Any) -> Any:
    shape = [1] * len(p["shape"])
    shape[p["dimension"]] = -1
    counts = np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])
    return np.broadcast_to(counts.reshape(shape), p["shape"])


def _padded(p: Any, x: Any, fill: Any) -> Any:
    if any(low < 0 or high < 0 for low, high, _ in p["padding_config"]):
        return None
    sizes = [
        low + high + size + between * max(size - 1, 0)
        for size, (low, high, between) in zip(x.shape, p["padding_config"], strict=True)
    ]
    y = np.full(sizes, fill, x.dtype)
    inside = zip(x.shape, p["padding_config"], strict=True)
    places = (slice(a, a + size * (k + 1) - k if size else a, k + 1) for size, (a, _, k) in inside)
    y[tuple(places)] = x
    return y


def _dot(p: Any, x: Any, y: Any) -> Any:
    (contract_x, contract_y), (batch_x, batch_y) = p["dimension_numbers"]
    names_x = list(range(x.ndim))
    names_y = list(range(x.ndim, x.ndim + y.ndim))
    for i, j in (*zip(contract_x, contract_y, strict=True), *zip(batch_x, batch_y, strict=True)):
        names_y[j] = i
    free_x = [i for i in names_x if i not in (*contract_x, *batch_x)]
    free_y = [k for j, k in enumerate(names_y) if j not in (*contract_y, *batch_y)]
    return np.einsum(x, names_x, y, names_y, [*batch_x, *free_x, *free_y])


def _selected(p: Any, which: Any, *cases: Any) -> Any:
    return np.where(which, cases[1], cases[0]) if which.dtype == bool else None


def _converted(p: Any, x: Any) -> Any:
    to = p["new_dtype"]
    if x.dtype.kind not in "fb" or np.dtype(to).kind != "f":
        return None
    return x.astype(to)


def _power(x: Any, y: int) -> Any:
    return np.power(x, y) if y >= 0 else 1.0 / np.power(x, -y)


def _split(p: Any, x: Any) -> Any:
    return np.split(x, np.cumsum(p["sizes"])[:-1], p["axis"])


def _floats(function: Callable) -> Callable:
    """For floating-point numbers only; integer operations follow JAX's rules."""
    return lambda p, *xs: function(*xs) if all(x.dtype.kind == "f" for x in xs) else None


def _always(function: Callable) -> Callable:
    return lambda p, *xs: function(*xs)


# By primitive: a function of its parameters and operands; it returns None to use JAX.
NUMPY: dict[str, Callable] = {
    **{name: _floats(getattr(np, name)) for name in ("sqrt", "exp", "log", "floor")},
    **{name: _floats(getattr(np, name)) for name in ("sin", "cos", "tanh", "log1p", "expm1")},
    "add": _always(np.add),
    "add_any": _always(np.add),
    "sub": _always(np.subtract),
    "mul": _always(np.multiply),
    "div": _floats(np.divide),
    "neg": _floats(np.negative),
    "square": _floats(np.square),
    "integer_pow": lambda p, x: _power(x, p["y"]) if x.dtype.kind == "f" else None,
    "rsqrt": _floats(lambda x: 1.0 / np.sqrt(x)),
    "atan2": _floats(np.arctan2),
    "abs": _floats(np.abs),
    "sign": _floats(np.sign),
    "max": _always(np.maximum),
    "min": _always(np.minimum),
    "gt": _always(np.greater),
    "ge": _always(np.greater_equal),
    "lt": _always(np.less),
    "le": _always(np.less_equal),
    "eq": _always(np.equal),
    "ne": _always(np.not_equal),
    "and": _always(np.bitwise_and),
    "or": _always(np.bitwise_or),
    "not": _always(np.bitwise_not),
    "copy": _always(lambda x: x),
    "stop_gradient": _always(lambda x: x),
    "select_n": _selected,
    "convert_element_type": _converted,
    "iota": _counted,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda p, x: None if p["dimensions"] else x.reshape(p["new_sizes"]),
    "squeeze": lambda p, x: np.squeeze(x, tuple(p["dimensions"])),
    "transpose": lambda p, x: np.transpose(x, p["permutation"]),
    "rev": lambda p, x: np.flip(x, p["dimensions"]),
    "slice": _sliced,
    "pad": _padded,
    "concatenate": lambda p, *xs: np.concatenate(xs, p["dimension"]),
    "stack": lambda p, *xs: np.stack(xs, p["axis"]),
    "unstack": lambda p, x: list(np.moveaxis(x, p["axis"], 0)),
    "split": _split,
    "dot_general": lambda p, x, y: _dot(p, x, y) if x.dtype.kind == "f" else None,
    "reduce_sum": lambda p, x: np.sum(x, tuple(p["axes"])) if x.dtype.kind == "f" else None,
    "reduce_max": lambda p, x: np.max(x, tuple(p["axes"])) if x.size else None,
    "reduce_min": lambda p, x: np.min(x, tuple(p["axes"])) if x.size else None,
}


def evaluated(
    closed: Any, args: list[Any], eps: float = 0.0, rng: np.random.Generator | None = None
) -> list[Any]:
    """The results of a traced function, operation by operation.

    Args:
        closed: the result of `jax.make_jaxpr`.
        args: its arguments, flat.
        eps: each result of an operation that rounds is multiplied by 1 + eps u, u in -1 to 1.
        rng: the random generator of u; None: no result is changed.
    """
    return _run(getattr(closed, "jaxpr", closed), getattr(closed, "consts", ()), args, eps, rng)


def _run(jaxpr: Any, consts: Any, args: Any, eps: float, rng: Any) -> list[Any]:
    args = [x if _typed(x) else np.asarray(x) for x in (*consts, *args)]
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), args, strict=True))

    def read(x: Any) -> Any:
        return x.val if hasattr(x, "val") else known[x]

    for eqn in jaxpr.eqns:
        given = [read(x) for x in eqn.invars]
        name = eqn.primitive.name
        if name in CALLS:
            outs = evaluated(eqn.params[CALLS[name]], given, eps, rng)
        elif name == "cond":
            which, *given = given
            outs = evaluated(eqn.params["branches"][int(which)], given, eps, rng)
        elif name == "scan" and eqn.params["length"]:
            outs = _scanned(eqn, given, eps, rng)
        elif name == "custom_linear_solve":
            outs = _solved(eqn.params, given, eps, rng)
        else:
            outs = _operation(eqn, given)
            if rng is not None and name not in EXACT:
                outs = [_rounded(x, eps, rng) for x in outs]
        known.update(zip(eqn.outvars, outs, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _scanned(eqn: Any, given: list[Any], eps: float, rng: Any) -> list[Any]:
    p = eqn.params
    fixed, carries = scan_sizes(p)
    consts, carry, slices = given[:fixed], given[fixed : fixed + carries], given[fixed + carries :]
    written = []
    for k in range(p["length"])[:: -1 if p["reverse"] else 1]:
        found = evaluated(p["jaxpr"], [*consts, *carry, *(x[k] for x in slices)], eps, rng)
        carry = found[:carries]
        written.append(found[carries:])
    written = written[:: -1 if p["reverse"] else 1]
    return [*carry, *(np.stack(column) for column in zip(*written, strict=True))]


def _solved(p: Any, given: list[Any], eps: float, rng: Any) -> list[Any]:
    """Run the `solve` program; the others are for derivatives."""
    sizes = p["const_lengths"]
    before = sizes.matvec + sizes.vecmat
    consts, right = given[before : before + sizes.solve], given[sum(sizes) :]
    return evaluated(p["jaxprs"].solve, [*consts, *right], eps, rng)


def _operation(eqn: Any, given: list[Any]) -> list[Any]:
    own = None
    if eqn.primitive.name in NUMPY and not any(map(_typed, given)):
        with np.errstate(all="ignore"):
            own = NUMPY[eqn.primitive.name](eqn.params, *map(np.asarray, given))
    if own is None:
        own = eqn.primitive.bind(*given, **eqn.params)
    several = own if eqn.primitive.multiple_results else [own]
    return [
        x if _typed(x) else np.asarray(x, out.aval.dtype)
        for x, out in zip(several, eqn.outvars, strict=True)
    ]


def _typed(x: Any) -> bool:
    """Whether it is a random key, which numpy does not have."""
    return jax.dtypes.issubdtype(getattr(x, "dtype", np.float64), jax.dtypes.extended)


def _rounded(x: Any, eps: float, rng: np.random.Generator) -> Any:
    """The numbers with another rounding; zeros, integers and Booleans are unchanged."""
    if _typed(x) or x.dtype.kind != "f":
        return x
    factor = 1.0 + eps * rng.uniform(-1.0, 1.0, x.shape)
    with np.errstate(all="ignore"):
        return x * factor.astype(x.dtype)
