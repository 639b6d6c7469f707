"""The same mechanism by sympy: L in symbols, Lagrange's equations, cse, straight-line code.

L and the rows are read from the program that JAX traces, number by number. The equations
[[M, A^T], [A, 0]] (a, -lam) = (Q - h, -gamma) are solved by straight-line L D L^T without zeros.
"""

import ctypes
import math
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import sympy as sp
from sympy.printing.c import C99CodePrinter
from sympy.printing.pycode import PythonCodePrinter

from bench._multiprecision.jaxpr_code import Floats, Tape, read
from bench.lowering._sympy import solve_by_lines
from bench.mechanisms._by_hand import rows_of
from bench.mechanisms._scene import Scene

FLAGS = ("-O3", "-march=native", "-shared", "-fPIC")
FUNCTIONS = {"sin": sp.sin, "cos": sp.cos, "sqrt": sp.sqrt, "rec_sqrt": lambda x: 1 / sp.sqrt(x)}
FUNCTIONS["abs"] = sp.Abs
COMPARED = {"<": sp.Lt, "<=": sp.Le, ">": sp.Gt, ">=": sp.Ge}


class Code(NamedTuple):
    """Lines `name = expression`; those that depend on params alone come first.

    Attributes:
        fixed: lines of params alone.
        moving: the other lines.
        accelerations: one for each coordinate.
        symbols: of the coordinates, the velocities and the params.
    """

    fixed: list[tuple[sp.Symbol, sp.Expr]]
    moving: list[tuple[sp.Symbol, sp.Expr]]
    accelerations: list[sp.Expr]
    symbols: Mapping[str, list[sp.Symbol]]


class _Reader:
    """Symbolic values of what JAX functions compute."""

    def __init__(self, scene: Scene) -> None:
        n = len(scene.names)
        self.tape = Tape()
        leaves, self.tree = jax.tree.flatten(dict(scene.params))
        shapes = [np.shape(leaf) for leaf in leaves]
        self.q, self.v = (Floats(self.tape.inputs(name, (n,))) for name in "qv")
        sizes = [int(np.prod(shape)) for shape in shapes]
        whole = self.tape.inputs("p", (sum(sizes),))
        parts = np.split(whole, np.cumsum(sizes)[:-1])
        self.params = jax.tree.unflatten(
            self.tree, [Floats(x.reshape(shape)) for x, shape in zip(parts, shapes, strict=True)]
        )
        self.symbols = {
            name: [sp.Symbol(f"{name}_{i}", real=True) for i in range(count)]
            for name, count in (("q", n), ("v", n), ("p", sum(sizes)))
        }
        self.known: dict[int, Any] = {}

    def values(self, function: Callable[..., Any], *args: Any) -> list[sp.Expr]:
        """The results in symbols."""
        ids = np.ravel(read(self.tape, function, *args))
        for i in self.tape.reached([int(i) for i in ids]):
            if i not in self.known:
                self.known[i] = self._expression(*self.tape.nodes[i])
        return [self.known[int(i)] for i in ids]

    def _expression(self, operation: str, *rest: Any) -> Any:
        if operation == "constant":
            return sp.Integer(int(rest[0])) if rest[0] == int(rest[0]) else sp.Float(rest[0])
        if operation == "input":
            return self.symbols[rest[0]][rest[1]]
        if operation == "power":
            return self.known[rest[1]] ** rest[0]
        if operation == "call":
            return FUNCTIONS[rest[0]](*(self.known[i] for i in rest[1:]))
        if operation == "compare":
            return COMPARED[rest[0]](*(self.known[i] for i in rest[1:]))
        args = [self.known[i] for i in rest]
        if operation == "negative":
            return -args[0]
        if operation == "select":
            return sp.Piecewise((args[2], args[0]), (args[1], True))
        a, b = args
        return {"+": lambda: a + b, "-": lambda: a - b, "*": lambda: a * b, "/": lambda: a / b}[
            operation
        ]()


def derived(scene: Scene) -> Code:
    """The accelerations of a scene as straight-line code."""
    reader = _Reader(scene)
    q, v, p = (reader.symbols[name] for name in "qvp")
    n, state = len(q), (reader.q, reader.v, reader.params)
    (L,) = reader.values(lambda q, v, p: scene.lagrangian(0.0, q, v, p), *state)
    force = [sp.Integer(0)] * n
    if scene.force is not None:
        given = scene.force
        force = reader.values(lambda q, v, p: given(0.0, q, v, p), *state)
    momentum = [sp.diff(L, x) for x in v]
    M = [[sp.diff(momentum[i], v[j]) for j in range(i + 1)] for i in range(n)]
    right = [
        sp.diff(L, q[i]) - sum(sp.diff(momentum[i], q[j]) * v[j] for j in range(n)) + force[i]
        for i in range(n)
    ]
    rows = rows_of(scene)
    speeds = [] if rows is None else reader.values(rows, *state)
    A = [[sp.diff(speed, x) for x in v] for speed in speeds]
    gamma = [sum(sp.diff(speed, q[j]) * v[j] for j in range(n)) for speed in speeds]
    if speeds and _singular(scene):  # the rows are added to M, which changes no solution
        for i in range(n):
            for j in range(i + 1):
                M[i][j] += sum(row[i] * row[j] for row in A)
            right[i] -= sum(row[i] * rate for row, rate in zip(A, gamma, strict=True))
    whole = [*M, *([*row, *([sp.Integer(0)] * (k + 1))] for k, row in enumerate(A))]
    flat = [x for row in whole for x in row]
    lines, entries = sp.cse([*flat, *right, *(-x for x in gamma)], sp.numbered_symbols("x"))
    filled = iter(entries[: len(flat)])
    lower = [[next(filled) for _ in row] for row in whole]
    a = solve_by_lines(lower, list(entries[len(flat) :]), lines)[:n]
    fixed, known = [], set(p)
    for name, value in lines:
        if value.free_symbols <= known:
            known.add(name)
            fixed.append((name, value))
    apart = {name for name, _ in fixed}
    moving = [line for line in lines if line[0] not in apart]
    return Code(fixed, moving, a, reader.symbols)


def _singular(scene: Scene) -> bool:
    M = jax.hessian(scene.lagrangian, 2)(0.0, jnp.asarray(scene.q0), jnp.asarray(scene.v0),
                                         scene.params)  # fmt: skip
    sizes = np.linalg.eigvalsh(np.asarray(M))
    return bool(sizes[0] < 1e-10 * sizes[-1])


def numbers(scene: Scene) -> np.ndarray:
    """The params in the order of their symbols."""
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(dict(scene.params))])


# ---- Python, for scipy ---------------------------------------------------------------------------


class _Printer(PythonCodePrinter):
    def _print_Pow(self, expr: sp.Pow, **_: Any) -> str:
        return _power(self, expr)


class _CPrinter(C99CodePrinter):
    def _print_Pow(self, expr: sp.Pow, **_: Any) -> str:
        return _power(self, expr)


def _power(printer: Any, expr: sp.Pow) -> str:
    """Products in place of small integer powers; roots."""
    base, exponent = printer._print(expr.base), expr.exp
    doubled = 2 * exponent
    if not doubled.is_Integer:
        return f"pow({base}, {printer._print(exponent)})"
    count = abs(int(doubled))
    factors = [f"({base})"] * (count // 2) + [f"sqrt({base})"] * (count % 2)
    product = "*".join(factors)
    return f"(1.0/({product}))" if doubled < 0 else f"({product})"


def in_python(code: Code, params: np.ndarray) -> Callable[[Any, Any], list[float]]:
    """The function dy/dt(t, y) of plain numbers."""
    show = _Printer({"fully_qualified_modules": False}).doprint
    outer = [f"{', '.join(map(str, code.symbols['p']))}, = p"]
    outer += [f"{name} = {show(value)}" for name, value in code.fixed]
    q, v = code.symbols["q"], code.symbols["v"]
    inner = [f"{', '.join(map(str, [*q, *v]))} = y"]
    inner += [f"{name} = {show(value)}" for name, value in code.moving]
    inner.append(f"return [{', '.join(map(show, [*v, *code.accelerations]))}]")
    lines = ["def equations(p):", *(f"    {line}" for line in outer), "    def field(t, y):"]
    lines += [*(f"        {line}" for line in inner), "    return field"]
    space: dict[str, Any] = {name: getattr(math, name) for name in ("sin", "cos", "sqrt", "pow")}
    exec("\n".join(lines), space)
    field = space["equations"](params.tolist())
    return lambda t, y: field(t, y.tolist())


# ---- C -------------------------------------------------------------------------------------------


def _c_source(code: Code) -> str:
    show = _CPrinter().doprint
    q, v, p = (code.symbols[name] for name in "qvp")
    held = [str(name) for name, _ in code.fixed]
    out = ["#include <math.h>", f"static double {', '.join(['unused', *map(str, p), *held])};"]
    out += ["void prepare(const double *p) {"]
    out += [f"{name} = p[{i}];" for i, name in enumerate(p)]
    out += [f"{name} = {show(value)};" for name, value in code.fixed] + ["}"]
    out += ["void field(const double *y, double *a) {"]
    out += [f"const double {name} = y[{i}];" for i, name in enumerate([*q, *v])]
    out += [f"const double {name} = {show(value)};" for name, value in code.moving]
    out += [f"a[{i}] = {show(value)};" for i, value in enumerate(code.accelerations)] + ["}"]
    n = len(q)
    out += [
        "void steps(double *y, double h, long count) {",
        f"double a[{n}];",
        "for (long k = 0; k < count; ++k) { field(y, a);",
        f"for (int i = 0; i < {n}; ++i) {{",
        f"y[{n} + i] += h * a[i]; y[i] += h * y[{n} + i]; }} }} }}",
    ]
    return "\n".join(out)


class InC:
    """The accelerations in compiled C, and a loop of steps v += h a, q += h v around them."""

    def __init__(self, code: Code, params: np.ndarray, folder: str) -> None:
        source, library = Path(folder) / "field.c", Path(folder) / "field.so"
        source.write_text(_c_source(code))
        subprocess.run(["gcc", *FLAGS, str(source), "-o", str(library), "-lm"], check=True)
        self._library = ctypes.CDLL(str(library))
        self._library.steps.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_long]
        self._library.prepare(params.ctypes.data_as(ctypes.c_void_p))

    def acceleration(self, y: np.ndarray) -> np.ndarray:
        """At y = (q, v)."""
        a = np.zeros(y.size // 2)
        y = np.array(y)
        self._library.field(*(x.ctypes.data_as(ctypes.c_void_p) for x in (y, a)))
        return a

    def steps(self, y: np.ndarray, h: float, count: int) -> np.ndarray:
        """The state after `count` steps."""
        y = np.array(y)
        self._library.steps(y.ctypes.data, h, count)
        return y
