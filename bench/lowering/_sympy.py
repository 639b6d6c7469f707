"""Equations of motion by sympy: L in symbols, Lagrange's equations, cse, printed as JAX code.

M a = -h is solved by straight-line L D L^T (Golub, Van Loan, Matrix Computations, sec. 4.1) on the
entries after cse; for two unknowns Cramer's rule is used. Rotations are as in `jaxlag.rotation`.
"""

import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax.numpy as jnp
import sympy as sp
from sympy.printing.pycode import PythonCodePrinter

from bench._problems.scenes import Scene
from bench.lowering._rk4 import Equations, Field, Parts

PATIENCE_S = 20.0
RADIAL = {"elastic_pendulum", "kepler", "kepler_polar"}  # the first coordinate is a distance

Tidy = Callable[[Any], Any]
Lines = list[tuple[sp.Symbol, sp.Expr]]


class Model(NamedTuple):
    """Symbols of a scene; `tidy` simplifies kinematics or is the identity."""

    q: list[sp.Symbol]
    v: list[sp.Symbol]
    p: dict[str, Any]  # symbols, or tuples of them
    tidy: Tidy

    def rate(self, r: sp.Matrix) -> sp.Matrix:
        return r.jacobian(self.q) * sp.Matrix(self.v)

    def kinetic(self, m: Any, r: sp.Matrix) -> sp.Expr:
        """Energy of a point mass at r."""
        dr = self.rate(r)
        return m * self.tidy(dr.dot(dr)) / 2


def pendulum(s: Model) -> sp.Expr:
    m, rod, g = s.p["m"], s.p["l"], s.p["g"]
    r = rod * sp.Matrix([sp.sin(s.q[0]), -sp.cos(s.q[0])])
    return s.kinetic(m, r) - m * g * r[1]


def double_pendulum(s: Model) -> sp.Expr:
    m1, m2, l1, l2, g = (s.p[name] for name in ("m1", "m2", "l1", "l2", "g"))
    (a, b), (da, db) = s.q, s.v
    T = (m1 + m2) * (l1 * da) ** 2 / 2 + m2 * (l2 * db) ** 2 / 2
    T += m2 * l1 * l2 * da * db * sp.cos(a - b)
    return T + g * ((m1 + m2) * l1 * sp.cos(a) + m2 * l2 * sp.cos(b))


def _links(s: Model, m: Sequence[Any], rods: Sequence[Any], g: Any) -> sp.Expr:
    r, L = sp.zeros(2, 1), sp.Integer(0)
    for q, mass, length in zip(s.q, m, rods, strict=True):
        r += length * sp.Matrix([sp.sin(q), -sp.cos(q)])
        L += s.kinetic(mass, r) - mass * g * r[1]
    return L


def double_pendulum_positions(s: Model) -> sp.Expr:
    return _links(s, (s.p["m1"], s.p["m2"]), (s.p["l1"], s.p["l2"]), s.p["g"])


def chain(s: Model) -> sp.Expr:
    return _links(s, s.p["m"], s.p["l"], s.p["g"])


def cart_pole(s: Model) -> sp.Expr:
    M, m, rod, g = (s.p[name] for name in ("M", "m", "l", "g"))
    r = sp.Matrix([s.q[0] + rod * sp.sin(s.q[1]), rod * sp.cos(s.q[1])])
    return M * s.v[0] ** 2 / 2 + s.kinetic(m, r) - m * g * r[1]


def spherical_pendulum(s: Model) -> sp.Expr:
    m, rod, g = s.p["m"], s.p["l"], s.p["g"]
    a, b = s.q
    r = rod * sp.Matrix([sp.sin(a) * sp.cos(b), sp.sin(a) * sp.sin(b), -sp.cos(a)])
    return s.kinetic(m, r) - m * g * r[2]


def elastic_pendulum(s: Model) -> sp.Expr:
    m, rod, k, g = (s.p[name] for name in ("m", "l", "k", "g"))
    r = s.q[0] * sp.Matrix([sp.sin(s.q[1]), -sp.cos(s.q[1])])
    return s.kinetic(m, r) - m * g * r[1] - k * (s.q[0] - rod) ** 2 / 2


def kepler(s: Model) -> sp.Expr:
    r = s.q[0] * sp.Matrix([sp.cos(s.q[1]), sp.sin(s.q[1])])
    return s.kinetic(s.p["m"], r) + s.p["k"] / sp.sqrt(s.tidy(r.dot(r)))


def kepler_polar(s: Model) -> sp.Expr:
    return s.p["m"] * (s.v[0] ** 2 + (s.q[0] * s.v[1]) ** 2) / 2 + s.p["k"] / s.q[0]


def symmetric_top(s: Model) -> sp.Expr:
    A, C, m, rod, g = (s.p[name] for name in ("A", "C", "m", "l", "g"))
    precession, nutation, spin = s.v
    T = A * (nutation**2 + (precession * sp.sin(s.q[1])) ** 2) / 2
    T += C * (spin + precession * sp.cos(s.q[1])) ** 2 / 2
    return T - m * g * rod * sp.cos(s.q[1])


def _rotation(axis: int, angle: Any) -> sp.Matrix:
    """Rotation by `angle` about an axis, body to space."""
    s, c = sp.sin(angle), sp.cos(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = sp.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def _rates(s: Model, R: sp.Matrix) -> sp.Matrix:
    """Body rates, R^T dR/dt = [w]x."""
    rate = sum((R.diff(q) * v for q, v in zip(s.q, s.v, strict=True)), sp.zeros(3, 3))
    W = R.T * rate
    return sp.Matrix([s.tidy(W[i]) for i in ((2, 1), (0, 2), (1, 0))])


def top(s: Model) -> sp.Expr:
    R = _rotation(2, s.q[0]) * _rotation(0, s.q[1]) * _rotation(2, s.q[2])
    w = _rates(s, R)
    T = sum(moment * rate**2 for moment, rate in zip(s.p["I"], w, strict=True)) / 2
    return T - s.p["m"] * s.p["g"] * s.p["l"] * R[2, 2]


def _yaw_pitch_roll(s: Model) -> sp.Matrix:
    return _rotation(2, s.q[3]) * _rotation(1, s.q[4]) * _rotation(0, s.q[5])


def rigid_body(s: Model) -> sp.Expr:
    w = _rates(s, _yaw_pitch_roll(s))
    T = s.p["m"] * sum(rate**2 for rate in s.v[:3]) / 2
    T += sum(moment * rate**2 for moment, rate in zip(s.p["I"], w, strict=True)) / 2
    return T - s.p["m"] * s.p["g"] * s.q[2]


def aircraft(s: Model) -> sp.Expr:
    R, m, c = _yaw_pitch_roll(s), s.p["m"], sp.Matrix(s.p["c"])
    w, v = _rates(s, R), sp.Matrix(s.v[:3])
    xx, yy, zz, xy, xz, yz = s.p["J"]
    J = sp.Matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    T = m * v.dot(v) / 2 + m * v.dot(R * w.cross(c)) + w.dot(J * w) / 2
    return T - m * s.p["g"] * (s.q[2] + (R * c)[2])


LAGRANGIANS: Mapping[str, Callable[[Model], sp.Expr]] = {
    "pendulum": pendulum,
    "double_pendulum": double_pendulum,
    "double_pendulum_positions": double_pendulum_positions,
    "cart_pole": cart_pole,
    "spherical_pendulum": spherical_pendulum,
    "elastic_pendulum": elastic_pendulum,
    "kepler": kepler,
    "kepler_polar": kepler_polar,
    "symmetric_top": symmetric_top,
    "top": top,
    "rigid_body": rigid_body,
    "aircraft": aircraft,
    "chain_3": chain,
    "chain_4": chain,
    "chain_6": chain,
}


def forms(name: str, scene: Scene) -> dict[str, Equations]:
    """The equations as derived, and simplified versions if sympy takes at most `PATIENCE_S`."""
    found = {"as derived": _equations(name, scene, _same, _same)}
    for label, tidy, last in (("trigsimp in L", _tidy, _same), ("trigsimp", _tidy, _tidy)):
        try:
            with _time_limit(PATIENCE_S):
                found[label] = _equations(name, scene, tidy, last)
        except TimeoutError:
            break
    return found


def _same(x: Any) -> Any:
    return x


def _tidy(x: Any) -> Any:
    return sp.trigsimp(sp.expand(x))


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _equations(name: str, scene: Scene, tidy: Tidy, last: Tidy) -> Equations:
    n = len(scene.q0)
    q, v = ([sp.Symbol(f"{letter}{i}", real=True) for i in range(n)] for letter in ("q", "v"))
    if name in RADIAL:
        q[0] = sp.Symbol("q0", positive=True)
    p = {key: _symbols(key, value) for key, value in scene.params.items()}
    L = LAGRANGIANS[name](Model(q, v, p, tidy))
    momentum = [sp.diff(L, x) for x in v]
    M = [[last(sp.diff(momentum[i], v[j])) for j in range(i + 1)] for i in range(n)]
    right = [
        last(sp.diff(L, q[i]) - sum(sp.diff(momentum[i], q[j]) * v[j] for j in range(n)))
        for i in range(n)
    ]
    flat = [x for row in M for x in row]
    lines, entries = sp.cse([*flat, *right], sp.numbered_symbols("x"))
    filled = iter(entries[: len(flat)])
    lower = [[next(filled) for _ in range(i + 1)] for i in range(n)]
    a = solve_by_lines(lower, list(entries[len(flat) :]), lines)
    return _printed(lines, a, q, v, p)


def _symbols(name: str, value: Any) -> Any:
    size = getattr(value, "size", None)
    if size is None:
        return sp.Symbol(name, positive=True)
    return sp.symbols(f"{name}_:{size}", real=True)


def solve_by_lines(M: list[list[sp.Expr]], r: list[sp.Expr], lines: Lines) -> list[sp.Expr]:
    """The a with M a = r; each operation is a new line. M is given by its lower triangle."""
    n, names = len(r), sp.numbered_symbols("z")

    def line(x: sp.Expr) -> sp.Expr:
        if x.is_Atom:
            return x
        lines.append((next(names), x))
        return lines[-1][0]

    M, r = [[line(x) for x in row] for row in M], [line(x) for x in r]
    if n == 2 and M[1][0] != 0:
        (a,), (b, c) = M
        scale = line(1 / (a * c - b**2))
        return [(c * r[0] - b * r[1]) * scale, (a * r[1] - b * r[0]) * scale]
    pivots = []
    for k in range(n):
        pivots.append(line(1 / M[k][k]))
        below = [i for i in range(k + 1, n) if M[i][k] != 0]
        for i in below:
            ratio = line(M[i][k] * pivots[k])
            for j in below:
                if j <= i:
                    M[i][j] = line(M[i][j] - ratio * M[j][k])
            r[i] = line(r[i] - ratio * r[k])
    a = list(r)
    for k in reversed(range(n)):
        known = sum((M[i][k] * a[i] for i in range(k + 1, n)), sp.Integer(0))
        a[k] = line((r[k] - known) * pivots[k])
    return a


class _Printer(PythonCodePrinter):
    """Integer powers stay powers, half-integer powers become roots."""

    def _print_Pow(self, expr: sp.Pow, **_: Any) -> str:
        base, exponent = self._print(expr.base), expr.exp
        if exponent.is_Integer:
            return f"1/({base})" if exponent == -1 else f"({base})**({exponent})"
        assert (2 * exponent).is_Integer
        power = f"sqrt({base})**({2 * exponent})"
        return {sp.S.Half: f"sqrt({base})", -sp.S.Half: f"1/sqrt({base})"}.get(exponent, power)


def _printed(
    lines: Lines, a: list[sp.Expr], q: list[sp.Symbol], v: list[sp.Symbol], p: dict[str, Any]
) -> Equations:
    """Code; lines that depend on params alone are outside of the function of the state."""
    show = _Printer({"fully_qualified_modules": False}).doprint
    fixed = {x for value in p.values() for x in (value if isinstance(value, tuple) else [value])}
    outer, inner = [], []
    for name, value in lines:
        here = outer if value.free_symbols <= fixed else inner
        if here is outer:
            fixed.add(name)
        here.append(f"{name} = {show(value)}")
    for name, value in p.items():
        vector = isinstance(value, tuple)
        outer.insert(
            0,
            f"{', '.join(map(str, value))}, = p[{name!r}]" if vector else f"{value} = p[{name!r}]",
        )
    code = ["def equations(p):", *(f"    {text}" for text in outer), "    def field(q, v):"]
    code += [f"        {', '.join(map(str, x))}, = {name}" for name, x in (("q", q), ("v", v))]
    code += [f"        {text}" for text in inner]
    code += [f"        return [{', '.join(map(show, a))}]", "    return field"]
    space: dict[str, Any] = {"sin": jnp.sin, "cos": jnp.cos, "sqrt": jnp.sqrt}
    exec("\n".join(code), space)
    return _as_arrays(space["equations"])


def _as_arrays(equations: Equations) -> Equations:
    """The equations with results as arrays, also where these are constant numbers."""

    def wrapped(p: Any) -> Field:
        field = equations(p)

        def checked(q: Parts, v: Parts) -> Parts:
            return [jnp.asarray(x, q[0].dtype) for x in field(q, v)]

        return checked

    return wrapped
