"""Straight-line code in multiprecision, from functions written in JAX.

A function is traced once. Every number in it becomes a node of a tape. The nodes on which the
results depend become the lines of a Python function on `gmpy2.mpfr`. Primitives that only move
numbers are applied to the indices of the nodes. Constants are the doubles of the program, taken
as exact.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax
import numpy as np
from jax.extend.core import Literal

_MOVING = {
    *("broadcast_in_dim", "reshape", "transpose", "squeeze", "slice", "dynamic_slice", "gather"),
    *("concatenate", "rev", "expand_dims", "copy", "copy_p", "pad", "split"),
    *("dynamic_update_slice", "scatter", "stack", "unstack"),
}
_INFIX = {"add": "+", "add_any": "+", "sub": "-", "mul": "*", "div": "/"}
_COMPARED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
_CALLED = {
    **{name: name for name in ("sin", "cos", "tan", "asin", "acos", "atan", "atan2")},
    **{name: name for name in ("sinh", "cosh", "tanh", "asinh", "exp", "expm1", "log", "log1p")},
    "sqrt": "sqrt",
    "abs": "abs",
    "rsqrt": "rec_sqrt",
    "cbrt": "cbrt",
}
_CHOICES = {"max": ">=", "min": "<="}


class Tape:
    """Nodes (operation, arguments), all different.

    Constants are nodes. Operations on constants are not evaluated here in double precision: the
    generated lines evaluate them in multiprecision.
    """

    def __init__(self) -> None:
        self.nodes: list[tuple] = []
        self._known: dict[tuple, int] = {}

    def add(self, *node: Any) -> int:
        """Index of a node; an equal node is reused."""
        if node not in self._known:
            self._known[node] = len(self.nodes)
            self.nodes.append(node)
        return self._known[node]

    def constants(self, values: Any) -> np.ndarray:
        """Nodes of an array of doubles."""
        values = np.asarray(values, np.float64)
        ids = [self.add("constant", float(x)) for x in values.ravel()]
        return np.array(ids, np.int32).reshape(values.shape)

    def inputs(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Nodes of an argument."""
        ids = [self.add("input", name, i) for i in range(int(np.prod(shape)))]
        return np.array(ids, np.int32).reshape(shape)

    def value(self, i: int) -> float | None:
        """The value of a node if it is a constant."""
        node = self.nodes[i]
        return node[1] if node[0] == "constant" else None

    def infix(self, sign: str, a: int, b: int) -> int:
        """A sum, difference, product or quotient, simplified if an operand is 0 or 1.

        Derivatives of arrays contain many of these. 0 times a number that is not finite is 0 here.
        """
        x, y = self.value(a), self.value(b)
        if (sign in "+-" and y == 0) or (sign in "*/" and y == 1):
            return a
        if (sign == "+" and x == 0) or (sign == "*" and x == 1):
            return b
        if sign == "-" and x == 0:
            return self.negative(b)
        if (sign == "*" and 0 in (x, y)) or (sign == "/" and x == 0):
            return self.add("constant", 0.0)
        if sign in "+*" and b < a:
            a, b = b, a
        return self.add(sign, a, b)

    def negative(self, a: int) -> int:
        x = self.value(a)
        return self.add("negative", a) if x is None else self.add("constant", -x)

    def reached(self, results: Sequence[int]) -> list[int]:
        """The nodes on which these depend, in order of evaluation."""
        needed, left = set(), list(results)
        while left:
            i = left.pop()
            if i not in needed:
                needed.add(i)
                left += self.arguments(i)
        return sorted(needed)  # arguments have smaller indices than their results

    def arguments(self, i: int) -> tuple[int, ...]:
        operation, *rest = self.nodes[i]
        if operation in ("constant", "input"):
            return ()
        return tuple(rest[1:]) if operation in ("call", "compare", "power") else tuple(rest)


class Floats:
    """An array of nodes; all other arrays of a program being read are NumPy arrays of values."""

    def __init__(self, ids: np.ndarray) -> None:
        self.ids = np.asarray(ids, np.int32)


class Truths(Floats):
    """An array of nodes with Boolean values."""


def read(tape: Tape, function: Callable, *args: Any) -> np.ndarray:
    """Nodes of the result of a function whose arguments are arrays of nodes or plain values."""
    leaves, tree = jax.tree.flatten(args, is_leaf=lambda x: isinstance(x, Floats))
    moving = [i for i, x in enumerate(leaves) if isinstance(x, Floats)]

    def of_moving(*given: Any) -> Any:
        whole = list(leaves)
        for i, x in zip(moving, given, strict=True):
            whole[i] = x
        return function(*jax.tree.unflatten(tree, whole))

    shapes = [jax.ShapeDtypeStruct(leaves[i].ids.shape, np.float64) for i in moving]
    closed = jax.make_jaxpr(of_moving)(*shapes)
    (result,) = _read(tape, closed, [leaves[i] for i in moving])
    return _floats(tape, result).ids


def _read(tape: Tape, closed: Any, args: Sequence[Any]) -> list[Any]:
    jaxpr = closed.jaxpr
    known: dict[Any, Any] = dict(zip(jaxpr.invars, args, strict=True))
    consts = (_held(tape, np.asarray(x)) for x in closed.consts)
    known |= dict(zip(jaxpr.constvars, consts, strict=True))

    def look(atom: Any) -> Any:
        if isinstance(atom, Literal):
            return _held(tape, np.asarray(atom.val))
        return known[atom]

    for equation in jaxpr.eqns:
        found = _apply(tape, equation, [look(atom) for atom in equation.invars])
        known |= dict(zip(equation.outvars, found, strict=True))
    return [look(atom) for atom in jaxpr.outvars]


def _held(tape: Tape, x: np.ndarray) -> Any:
    return Floats(tape.constants(x)) if np.issubdtype(x.dtype, np.floating) else x


def _floats(tape: Tape, x: Any) -> Floats:
    return x if isinstance(x, Floats) else Floats(tape.constants(x))


def _apply(tape: Tape, equation: Any, args: list[Any]) -> list[Any]:
    name, parameters = equation.primitive.name, equation.params
    inner = parameters.get("jaxpr", parameters.get("call_jaxpr"))
    if name in ("custom_jvp_call", "custom_vjp_call", "jit", "pjit", "closed_call", "core_call"):
        assert inner is not None
        return _read(tape, inner, args)
    out = equation.outvars[0].aval
    if not any(isinstance(x, Floats) for x in args):
        found = equation.primitive.bind(*args, **parameters)
        found = found if equation.primitive.multiple_results else [found]
        return [_held(tape, np.asarray(x)) for x in found]
    if name in _MOVING:
        return _moved(equation, args)
    if name in ("stop_gradient", "optimization_barrier"):
        return args
    if name == "convert_element_type":
        return [_converted(tape, args[0], out)]
    if name == "dot_general":
        return [Floats(_dotted(tape, *(x.ids for x in args), parameters["dimension_numbers"]))]
    if name == "cumsum":
        return [Floats(_running(tape, args[0].ids, parameters["axis"], parameters["reverse"]))]
    if name in ("reduce_sum", "reduce_max", "reduce_min"):

        def fold(a: int, b: int) -> int:
            return tape.infix("+", a, b) if name == "reduce_sum" else _choice(tape, name[7:], a, b)

        return [Floats(_reduced(args[0].ids, parameters["axes"], fold))]
    return [_elementwise(tape, name, parameters, args, out)]


def _moved(equation: Any, args: list[Any]) -> list[Any]:
    """A primitive that only moves numbers, applied to the indices of the nodes."""
    kind = next(type(x) for x in args if isinstance(x, Floats))
    plain = [x.ids if isinstance(x, Floats) else x for x in args]
    found = equation.primitive.bind(*plain, **equation.params)
    found = found if equation.primitive.multiple_results else [found]
    ids = [np.asarray(x) for x in found]
    if any(np.any(x < 0) for x in ids):
        raise NotImplementedError(f"{equation.primitive.name}: reads outside its array")
    return [kind(x) for x in ids]


def _converted(tape: Tape, x: Any, out: Any) -> Any:
    if isinstance(x, Truths):
        one, zero = tape.constants(1.0), tape.constants(0.0)
        return Floats(_mapped(lambda i: tape.add("select", i, int(zero), int(one)), x.ids))
    if not np.issubdtype(out.dtype, np.floating):
        raise NotImplementedError("a whole number made of one that moves")
    return x


def _dotted(tape: Tape, a: np.ndarray, b: np.ndarray, dimensions: Any) -> np.ndarray:
    (summed_a, summed_b), (batch_a, batch_b) = dimensions
    free_a = [i for i in range(a.ndim) if i not in (*summed_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*summed_b, *batch_b)]
    a, b = a.transpose(*batch_a, *free_a, *summed_a), b.transpose(*batch_b, *free_b, *summed_b)
    batch, count = a.shape[: len(batch_a)], int(np.prod(a.shape[a.ndim - len(summed_a) :]))
    shape = (*batch, *a.shape[len(batch) : a.ndim - len(summed_a)])
    shape += b.shape[len(batch) : b.ndim - len(summed_b)]
    groups = int(np.prod(batch))
    a, b = a.reshape(groups, -1, count), b.reshape(groups, -1, count)
    zero = int(tape.constants(0.0))
    products = [
        reduce(
            lambda total, pair: tape.infix("+", total, tape.infix("*", *map(int, pair))),
            zip(row, column, strict=True),
            zero,
        )
        for g in range(groups)
        for row in a[g]
        for column in b[g]
    ]
    return np.array(products, np.int32).reshape(shape)


def _reduced(ids: np.ndarray, axes: Sequence[int], fold: Callable[[int, int], int]) -> np.ndarray:
    rest = [i for i in range(ids.ndim) if i not in axes]
    lines = ids.transpose(*rest, *axes).reshape(int(np.prod([ids.shape[i] for i in rest])), -1)
    results = [reduce(fold, map(int, line)) for line in lines]
    return np.array(results, np.int32).reshape([ids.shape[i] for i in rest])


def _running(tape: Tape, ids: np.ndarray, axis: int, reverse: bool) -> np.ndarray:
    """Cumulative sums along an axis, from its start or, with `reverse`, from its end."""
    ids = np.moveaxis(ids, axis, 0)
    sums = list(ids[::-1] if reverse else ids)
    for i in range(1, len(sums)):
        sums[i] = _mapped(lambda a, b: tape.infix("+", a, b), sums[i - 1], sums[i])
    return np.moveaxis(np.stack(sums[::-1] if reverse else sums), 0, axis)


def _mapped(function: Callable[..., int], *ids: np.ndarray) -> np.ndarray:
    ids = np.broadcast_arrays(*ids)
    found = [function(*map(int, args)) for args in zip(*(x.ravel() for x in ids), strict=True)]
    return np.array(found, np.int32).reshape(ids[0].shape)


def _choice(tape: Tape, name: str, a: int, b: int) -> int:
    return tape.add("select", tape.add("compare", _CHOICES[name], a, b), b, a)


def _elementwise(tape: Tape, name: str, parameters: Any, args: list[Any], out: Any) -> Any:
    if name == "select_n" and not isinstance(args[0], Floats):
        which = np.broadcast_to(np.asarray(args[0]).astype(int), out.shape)
        cases = [np.broadcast_to(_floats(tape, x).ids, out.shape) for x in args[1:]]
        return Floats(np.choose(which, cases))
    ids = [_floats(tape, x).ids for x in args]
    if name == "select_n":
        return Floats(_mapped(lambda i, a, b: tape.add("select", i, a, b), *ids))
    if name in _COMPARED:
        return Truths(_mapped(lambda a, b: tape.add("compare", _COMPARED[name], a, b), *ids))
    if name in _INFIX:
        return Floats(_mapped(lambda a, b: tape.infix(_INFIX[name], a, b), *ids))
    if name in _CHOICES:
        return Floats(_mapped(lambda a, b: _choice(tape, name, a, b), *ids))
    if name == "neg":
        return Floats(_mapped(tape.negative, *ids))
    if name in ("square", "integer_pow"):
        power = 2 if name == "square" else parameters["y"]
        return Floats(_mapped(lambda a: tape.add("power", power, a), *ids))
    if name == "pow":
        return Floats(_mapped(lambda a, b: tape.add("raise", a, b), *ids))
    if name == "sign":
        return Floats(_mapped(lambda a: tape.add("sign", a), *ids))
    if name in _CALLED:
        return Floats(_mapped(lambda *a: tape.add("call", _CALLED[name], *a), *ids))
    raise NotImplementedError(f"the primitive {name}")


def compiled(tape: Tape, results: Sequence[int], arguments: Sequence[str]) -> Callable:
    """A Python function of sequences of mpfr, `f(*arguments)`, that returns a list of mpfr."""
    import gmpy2

    results = [int(i) for i in results]
    space: dict[str, Any] = {
        f"_{name}": getattr(gmpy2, name) for name in set(_CALLED.values()) - {"abs"}
    }
    space |= {"_abs": abs, "_sign": lambda x: gmpy2.mpfr(gmpy2.sign(x))}
    lines, held = [], []
    for i in tape.reached(results):
        operation, *rest = tape.nodes[i]
        if operation == "constant":
            space[f"c{i}"] = gmpy2.mpfr(rest[0])
            held.append(f"c{i}")
            lines.append(f"n{i} = c{i}")
            continue
        lines.append(f"n{i} = {_line(operation, rest)}")
    body = "\n ".join([*lines, f"return [{', '.join(f'n{i}' for i in results)}]"])
    # Constants are default values: these are local variables, which are faster to look up.
    head = ", ".join([*arguments, *(f"{name}={name}" for name in held)])
    exec(f"def program({head}):\n {body}\n", space)
    return space["program"]


def _line(operation: str, rest: list[Any]) -> str:
    if operation == "input":
        return f"{rest[0]}[{rest[1]}]"
    if operation == "negative":
        return f"-n{rest[0]}"
    if operation == "compare":
        return f"n{rest[1]} {rest[0]} n{rest[2]}"
    if operation == "power":
        power, x = rest
        return f"n{x} * n{x}" if power == 2 else f"n{x} ** {power}"
    if operation == "raise":
        return f"n{rest[0]} ** n{rest[1]}"
    if operation == "select":
        return f"n{rest[2]} if n{rest[0]} else n{rest[1]}"
    if operation == "sign":
        return f"_sign(n{rest[0]})"
    if operation == "call":
        return f"_{rest[0]}({', '.join(f'n{i}' for i in rest[1:])})"
    return f"n{rest[0]} {operation} n{rest[1]}"
