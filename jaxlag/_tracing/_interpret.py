"""Interpreter of a jaxpr on numpy arrays, without compilation: the reference for programs.

NUMPY and PARTS hold primitives as functions of (equation, operands).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from jaxlag._core._jaxprs import called


class NumpyProgram:
    """A program for numpy arrays: one operation after another, nested programs written out.

    Operations whose results nobody reads are left out.
    """

    def __init__(self, program: ClosedJaxpr) -> None:
        self._values: list[Any] = []
        self._lines: list[tuple[Callable, list[int], list[int]]] = []
        self._given = [self._new() for _ in program.jaxpr.invars]
        self._results = self._write(program, self._given)
        needed, lines = set(self._results), []
        for line in reversed(self._lines):
            _, operands, results = line
            if not needed.isdisjoint(results):
                needed.update(operands)
                lines.append(line)
        self._lines = lines[::-1]

    def __call__(self, *args: Any) -> list:
        """The results at given arrays; overflow gives inf or nan."""
        values = list(self._values)
        for slot, x in zip(self._given, args, strict=True):
            values[slot] = x
        with np.errstate(all="ignore"):
            for operation, operands, results in self._lines:
                found = operation([values[slot] for slot in operands])
                for slot, x in zip(results, found, strict=True):
                    values[slot] = x
        return [values[slot] for slot in self._results]

    def _new(self, value: Any = None) -> int:
        self._values.append(value)
        return len(self._values) - 1

    def _write(self, program: ClosedJaxpr, operands: Sequence[int]) -> list[int]:
        """Append the operations of a program; returns the slots of its results."""
        jaxpr, known = program.jaxpr, dict(zip(program.jaxpr.invars, operands, strict=True))
        consts = [self._new(held(x)) for x in program.consts]
        known |= dict(zip(jaxpr.constvars, consts, strict=True))

        def slots(atoms: Sequence[Any]) -> list[int]:
            return [self._new(held(a.val)) if isinstance(a, Literal) else known[a] for a in atoms]

        for eqn in jaxpr.eqns:
            inner, given = called(eqn), slots(eqn.invars)
            if inner is not None:
                results = self._write(inner, given)
            else:
                results = [self._new() for _ in eqn.outvars]
                self._lines.append((operation_of(eqn), given, results))
            known |= dict(zip(eqn.outvars, results, strict=True))
        return slots(jaxpr.outvars)


def interpret(closed: ClosedJaxpr, *args: Any) -> list:
    """The results of a program at given arrays; overflow gives inf or nan."""
    return NumpyProgram(closed)(*args)


def held(value: Any) -> Any:
    """A known value as a numpy array; random keys are unchanged."""
    kind = getattr(value, "dtype", None)
    extended = kind is not None and jax.dtypes.issubdtype(kind, jax.dtypes.extended)
    return value if extended else np.asarray(value)


def equation(eqn: Any, operands: list) -> list:
    """The results of one equation at given numpy arrays."""
    inner = called(eqn)
    if inner is not None:
        return interpret(inner, *operands)
    return operation_of(eqn)(operands)


def operation_of(eqn: Any) -> Callable[[list], list]:
    """One equation as a function from its operands to its results."""
    name = eqn.primitive.name
    if name in NUMPY:
        function, kind = NUMPY[name], eqn.outvars[0].aval.dtype
        if np.issubdtype(kind, np.integer):
            # Integers keep their width, in which they wrap; real numbers are computed in double.
            return lambda operands: [np.asarray(function(eqn, *operands)).astype(kind)]
        return lambda operands: [np.asarray(function(eqn, *operands))]
    if name in PARTS:
        part = PARTS[name]
        return lambda operands: part(eqn, *operands)
    return partial(_by_jax, eqn)


def _by_jax(eqn: Any, operands: list) -> list:
    kinds = [v.aval.dtype for v in eqn.invars]
    with jax.ensure_compile_time_eval():
        given = [
            x.astype(kind) if isinstance(x, np.ndarray) else x
            for x, kind in zip(operands, kinds, strict=True)
        ]
        out = eqn.primitive.bind(*given, **eqn.params)
    return [held(x) for x in (out if eqn.primitive.multiple_results else [out])]


def _plain(function: Callable) -> Callable:
    return lambda eqn, *args: function(*args)


def _axes(function: Callable) -> Callable:
    return lambda eqn, x: function(x, axis=tuple(eqn.params["axes"]))


def _extreme(function: Callable, of_nothing: float, x: np.ndarray, axis: tuple) -> Any:
    if x.size or not np.issubdtype(x.dtype, np.floating):
        return function(x, axis=axis)
    return function(x, axis=axis, initial=of_nothing)


def _running(function: Callable) -> Callable:
    def cumulative(eqn: Any, x: np.ndarray) -> Any:
        axis = eqn.params["axis"]
        x = np.flip(x, axis) if eqn.params["reverse"] else x
        x = function(x, axis=axis)
        return np.flip(x, axis) if eqn.params["reverse"] else x

    return cumulative


def _broadcast(eqn: Any, x: np.ndarray) -> Any:
    shape, dimensions = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    wide = [1] * len(shape)
    for axis, place in enumerate(dimensions):
        wide[place] = x.shape[axis]
    return np.broadcast_to(x.reshape(wide), shape)


def _dot(eqn: Any, a: np.ndarray, b: np.ndarray) -> Any:
    ((left, right), (left_batch, right_batch)) = eqn.params["dimension_numbers"]
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    a_names, b_names = [""] * a.ndim, [""] * b.ndim
    for i, j in (*zip(left_batch, right_batch, strict=True), *zip(left, right, strict=True)):
        a_names[i] = b_names[j] = next(letters)
    a_names = [name or next(letters) for name in a_names]
    b_names = [name or next(letters) for name in b_names]
    free_a = [a_names[i] for i in range(a.ndim) if i not in (*left, *left_batch)]
    free_b = [b_names[i] for i in range(b.ndim) if i not in (*right, *right_batch)]
    out = "".join([*(a_names[i] for i in left_batch), *free_a, *free_b])
    return np.asarray(np.einsum(f"{''.join(a_names)},{''.join(b_names)}->{out}", a, b))


def _slice(eqn: Any, x: np.ndarray) -> Any:
    p = eqn.params
    strides = p["strides"] or (1,) * x.ndim
    bounds = zip(p["start_indices"], p["limit_indices"], strides, strict=True)
    return x[tuple(slice(*s) for s in bounds)]


def _select(eqn: Any, which: np.ndarray, *cases: np.ndarray) -> Any:
    return np.choose(which.astype(int), np.broadcast_arrays(*cases))


def _pad(eqn: Any, x: np.ndarray, filling: np.ndarray) -> list:
    """Entries spaced by `interior`, padded by `low` and `high`, which crop if negative."""
    config = eqn.params["padding_config"]
    sizes = [max(n + (n - 1) * gap, 0) for n, (_, _, gap) in zip(x.shape, config, strict=True)]
    spaced = np.full(sizes, filling, x.dtype)
    spaced[tuple(slice(None, None, gap + 1) for _, _, gap in config)] = x
    ends = [(low, high) for low, high, _ in config]
    wide = np.pad(spaced, np.maximum(ends, 0).reshape(-1, 2), constant_values=filling)
    crop = [
        slice(max(-low, 0), wide.shape[i] - max(-high, 0)) for i, (low, high) in enumerate(ends)
    ]
    return [wide[tuple(crop)]]


def _split(eqn: Any, x: np.ndarray) -> list:
    return np.split(x, np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"])


def _convert(eqn: Any, x: np.ndarray) -> Any:
    new = eqn.params["new_dtype"]
    # Everything is computed in double: a program in float32 is compared in its real arithmetic.
    real = np.issubdtype(x.dtype, np.floating) and np.issubdtype(new, np.floating)
    return x if real else x.astype(new)


def _whole(x: np.ndarray, y: np.ndarray) -> Any:
    """The quotient of integers, rounded towards zero."""
    return np.sign(x) * np.sign(y) * (np.abs(x) // np.abs(y))


NUMPY: dict[str, Callable] = {
    name: _plain(getattr(np, other))
    for name, other in {
        "add": "add",
        "add_any": "add",
        "sub": "subtract",
        "mul": "multiply",
        "neg": "negative",
        "max": "maximum",
        "min": "minimum",
        "sqrt": "sqrt",
        "square": "square",
        "sin": "sin",
        "cos": "cos",
        "tan": "tan",
        "asin": "arcsin",
        "acos": "arccos",
        "atan": "arctan",
        "atan2": "arctan2",
        "sinh": "sinh",
        "cosh": "cosh",
        "tanh": "tanh",
        "exp": "exp",
        "log": "log",
        "abs": "abs",
        "sign": "sign",
        "eq": "equal",
        "ne": "not_equal",
        "lt": "less",
        "le": "less_equal",
        "gt": "greater",
        "ge": "greater_equal",
        "stop_gradient": "asarray",
        "copy": "asarray",
        "copy_p": "asarray",
    }.items()
}
NUMPY |= {
    "div": lambda e, x, y: x / y if np.issubdtype(x.dtype, np.floating) else _whole(x, y),
    "pow": lambda e, x, y: np.power(x, y),
    "integer_pow": lambda e, x: (
        x ** (e.params["y"] if e.params["y"] >= 0 else float(e.params["y"]))
    ),
    "rsqrt": lambda e, x: 1 / np.sqrt(x),
    "broadcast_in_dim": lambda e, x, *_: _broadcast(e, x),
    "reshape": lambda e, x, *_: x.reshape(e.params["new_sizes"]),
    "transpose": lambda e, x: x.transpose(e.params["permutation"]),
    "squeeze": lambda e, x: x.squeeze(tuple(e.params["dimensions"])),
    "concatenate": lambda e, *xs: np.concatenate(xs, axis=e.params["dimension"]),
    "stack": lambda e, *xs: np.stack(xs, axis=e.params["axis"]),
    "rev": lambda e, x: np.flip(x, tuple(e.params["dimensions"])),
    "slice": _slice,
    "select_n": _select,
    "convert_element_type": _convert,
    "dot_general": _dot,
    "reduce_sum": _axes(np.sum),
    "reduce_prod": _axes(np.prod),
    "reduce_max": _axes(partial(_extreme, np.max, -np.inf)),
    "reduce_min": _axes(partial(_extreme, np.min, np.inf)),
    "cumsum": _running(np.cumsum),
    "cumprod": _running(np.cumprod),
}


def _unstack(eqn: Any, x: np.ndarray) -> list:
    return [np.asarray(row) for row in np.moveaxis(x, eqn.params["axis"], 0)]


def _iota(eqn: Any) -> list:
    """Numbers from 0 along one axis."""
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    along = np.arange(shape[axis]).astype(eqn.params["dtype"])
    return [np.broadcast_to(along.reshape((-1,) + (1,) * (len(shape) - axis - 1)), shape)]


# Other primitives of derivatives; not in NUMPY, which holds primitives with a scalar form.
PARTS: dict[str, Callable] = {"pad": _pad, "split": _split, "unstack": _unstack, "iota": _iota}
