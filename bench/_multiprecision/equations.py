"""Equations of motion in multiprecision, from the declaration and without the engine.

M a + h = Q + (A^T + C) lam and A a + gamma = 0, where C lam are forces that read the multipliers.
M, h, Q, A and gamma are plain derivatives of the user's functions. The linear system is solved by
elimination with pivoting.

Source: Pila, Introduction to Lagrangian Dynamics, eqs. 3.50 to 3.56 and 3.118.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from bench._multiprecision.jaxpr_code import Floats, Tape, compiled, read

DIGITS = 50
ROUNDS = 60  # iterations of Newton's method for a state on the constraints


def precise() -> Any:
    """gmpy2, after setting its precision to `DIGITS` decimal digits."""
    import gmpy2

    gmpy2.get_context().precision = int(DIGITS * 3.33) + 4
    return gmpy2


class Singular(ArithmeticError):
    """Equations that do not determine the accelerations."""


class Motion:
    """The equations of a declared system for one set of parameters.

    Attributes:
        size: number n of coordinates.
        rows: number m of constraint rows.
        positions: number of rows with a position residual.
    """

    def __init__(self, system: jl.System, params: Mapping[str, Any]) -> None:
        if not jax.config.jax_enable_x64:
            raise RuntimeError("constants must be read as doubles: set jax_enable_x64")
        precise()
        self.size = system.size
        self._declared = _Declared(system)
        tape = self._tape = Tape()
        # Parameters are exact doubles in the program: their sums and products are also computed
        # with all digits.
        self._params = {
            name: Floats(tape.constants(x)) if _inexact(x) else x for name, x in params.items()
        }
        t, q, v = (Floats(tape.inputs(x, s)) for x, s in (("t", (1,)), *self._states()))
        self._t, self._q, self._v = Floats(t.ids[0]), q, v
        at = self._t, q, v, self._params
        self.rows = len(read(tape, self._declared.rates, *at))
        self.positions = len(read(tape, self._declared.residuals, *at[:2], at[3]))
        lam = Floats(tape.inputs("lam", (self.rows,)))
        M = read(tape, self._declared.mass, *at)
        effort = read(tape, self._declared.effort, *at)
        A = read(tape, self._declared.A, *at)
        gamma = read(tape, self._declared.gamma, *at)
        C = read(tape, self._declared.C, *at, lam)
        read_too = {
            tape.nodes[i][1] for i in tape.reached(C.ravel()) if tape.nodes[i][0] == "input"
        }
        if "lam" in read_too:
            raise NotImplementedError("forces that are not affine in the multipliers")
        parts = M, effort, A, gamma, C
        self._terms = self._function(np.concatenate([x.ravel() for x in parts]))
        of_position = read(tape, self._declared.residuals, *at[:2], at[3])
        J = read(tape, self._declared.J, *at[:2], at[3])
        self._position = self._function(np.concatenate([of_position, J.ravel()]))
        psi = read(tape, self._declared.rates, *at)
        self._velocity = self._function(np.concatenate([psi, A.ravel()]))

    def _states(self) -> tuple:
        return ("q", (self.size,)), ("v", (self.size,))

    def _function(self, ids: np.ndarray) -> Callable:
        return compiled(self._tape, ids, ("t", "q", "v"))

    def rates(self, t: Any, y: Sequence) -> list:
        """dy/dt of y = (q, v)."""
        n, m = self.size, self.rows
        q, v = y[:n], y[n:]
        terms = self._terms((t,), q, v)
        M, effort, rest = terms[: n * n], terms[n * n : n * n + n], terms[n * n + n :]
        A, gamma, C = rest[: m * n], rest[m * n : m * n + m], rest[m * n + m :]
        matrix = [
            M[i * n : i * n + n] + [-A[k * n + i] - C[i * m + k] for k in range(m)] + [effort[i]]
            for i in range(n)
        ]
        zeros = [M[0] * 0] * m
        matrix += [A[k * n : k * n + n] + zeros + [-gamma[k]] for k in range(m)]
        return [*v, *solved(matrix)[:n]]

    def start(self, q: Sequence, v: Sequence, t: Any = 0) -> list:
        """The state y = (q, v) on the constraints nearest to this one: Newton's method."""
        gmpy2 = precise()
        q, v = ([gmpy2.mpfr(float(x)) for x in part] for part in (q, v))
        t = gmpy2.mpfr(t)
        if self.positions:
            q = self._nearest(lambda q: self._position((t,), q, v), q, self.positions)
        if self.rows:
            v = self._nearest(lambda v: self._velocity((t,), q, v), v, self.rows)
        return [*q, *v]

    def _nearest(self, found: Callable, x: list, count: int) -> list:
        n, least = self.size, 10.0 ** (8 - DIGITS)
        for _ in range(ROUNDS):
            values = found(x)
            residuals, J = values[:count], values[count:]
            if max(abs(r) for r in residuals) < least:
                return x
            J = [J[k * n : k * n + n] for k in range(count)]
            matrix = [
                [sum(a * b for a, b in zip(J[i], J[k], strict=True)) for k in range(count)]
                + [residuals[i]]
                for i in range(count)
            ]
            weights = solved(matrix)
            x = [x[i] - sum(J[k][i] * weights[k] for k in range(count)) for i in range(n)]
        raise Singular("no state on the constraints was found near the start")


def solved(matrix: list[list]) -> list:
    """x of matrix = [A | b], A x = b, by elimination with scaled partial pivots."""
    n = len(matrix)
    sizes = [max(abs(x) for x in row[:n]) for row in matrix]
    least = 10.0 ** (15 - DIGITS)
    for j in range(n):
        pivot = max(range(j, n), key=lambda i: abs(matrix[i][j]) / sizes[i] if sizes[i] else 0)
        row = matrix[pivot]
        if not sizes[pivot] or not abs(row[j]) > least * sizes[pivot]:
            raise Singular(f"no pivot in column {j}")
        matrix[j], matrix[pivot] = row, matrix[j]
        sizes[j], sizes[pivot] = sizes[pivot], sizes[j]
        top, tail = row[j], row[j + 1 :]
        for i in range(j + 1, n):
            below = matrix[i]
            if below[j]:
                factor = below[j] / top
                below[j + 1 :] = [a - factor * b for a, b in zip(below[j + 1 :], tail, strict=True)]
    x = [None] * n
    for i in range(n - 1, -1, -1):
        row = matrix[i]
        x[i] = (row[n] - sum(row[j] * x[j] for j in range(i + 1, n))) / row[i]
    return x


def _inexact(x: Any) -> bool:
    return np.issubdtype(np.asarray(x).dtype, np.floating)


class _Declared:
    """Derivatives of the declared functions, by forward mode only."""

    def __init__(self, system: jl.System) -> None:
        self.system = system

    def lagrangian(self, t: Any, q: Any, v: Any, params: Any) -> Any:
        system = self.system
        if system.written_in == "u":
            return system._in_u(t, q, system.quasi.U(t, q, v, params), params)
        return system.lagrangian(t, q, v, params)

    def mass(self, *at: Any) -> Any:
        return jax.jacfwd(jax.jacfwd(self.lagrangian, 2), 2)(*at)

    def effort(self, t: Any, q: Any, v: Any, params: Any) -> Any:
        """Q - h with h = d/dt(dL/dv) - dL/dq at a = 0, the forces at lam = 0."""

        def momentum(t: Any, q: Any) -> Any:
            return jax.jacfwd(self.lagrangian, 2)(t, q, v, params)

        along = jax.jvp(momentum, (t, q), (jnp.ones_like(t), v))[1]
        h = along - jax.jacfwd(self.lagrangian, 1)(t, q, v, params)
        rows = self.rates(t, q, v, params).shape[0]
        return self.force(t, q, v, params, jnp.zeros(rows)) - h

    def force(self, t: Any, q: Any, v: Any, params: Any, lam: Any) -> Any:
        total = jnp.zeros_like(q)
        for force in self.system.forces:
            total = total + self._one_force(force, t, q, v, params, lam)
        return total

    def _one_force(self, force: Any, t: Any, q: Any, v: Any, params: Any, lam: Any) -> Any:
        at = t, q, v, params
        if isinstance(force, jl.PointForce):
            J = jax.jacfwd(force.position, 1)(t, q, params)
            return jnp.sum(J * force.force(*at)[..., None], axis=tuple(range(J.ndim - 1)))
        if isinstance(force, jl.Torque):
            J = jax.jacfwd(force.angular_velocity, 2)(*at)
            torque = jnp.asarray(force.torque(*at))
            return jnp.sum(J * torque[..., None], axis=tuple(range(J.ndim - 1)))
        if isinstance(force, jl.Rayleigh):
            return -jax.jacfwd(force.R, 2)(*at)
        if isinstance(force, jl.GeneralizedForce):
            return force.Q(*at, self._by_name(at, lam)) if force.reaction else force.Q(*at)
        raise NotImplementedError(f"forces of the kind {type(force).__name__}")

    def _by_name(self, at: Any, lam: Any) -> dict[str, Any]:
        """Multipliers by name, as forces read them."""
        parts, start = {}, 0
        for constraint in self.system.constraints:
            names = constraint.all_names
            shape = jnp.shape(self._residual(constraint, *at))
            if len(names) == 1:
                count = int(np.prod(shape))
                parts[names[0]] = lam[start : start + count].reshape(shape)
                start += count
            else:
                parts |= {name: lam[start + k] for k, name in enumerate(names)}
                start += len(names)
        return parts

    def _residual(self, constraint: Any, t: Any, q: Any, v: Any, params: Any) -> Any:
        """A v + b."""
        if isinstance(constraint, jl.Holonomic):
            one = jnp.ones_like(t)
            return jax.jvp(lambda t, q: constraint.phi(t, q, params), (t, q), (one, v))[1]
        if isinstance(constraint, jl.Pfaffian):
            return constraint.residual(t, q, v, params)
        raise NotImplementedError(f"constraints of the kind {type(constraint).__name__}")

    def rates(self, *at: Any) -> Any:
        """A v + b of all rows."""
        parts = [jnp.ravel(self._residual(c, *at)) for c in self.system.constraints]
        return jnp.concatenate([jnp.zeros(0), *parts])

    def residuals(self, t: Any, q: Any, params: Any) -> Any:
        """phi of the holonomic rows."""
        held = [c for c in self.system.constraints if isinstance(c, jl.Holonomic)]
        return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(c.phi(t, q, params)) for c in held)])

    def J(self, *at: Any) -> Any:
        return jax.jacfwd(self.residuals, 1)(*at)

    def A(self, *at: Any) -> Any:
        return jax.jacfwd(self.rates, 2)(*at)

    def gamma(self, t: Any, q: Any, v: Any, params: Any) -> Any:
        def along(t: Any, q: Any) -> Any:
            return self.rates(t, q, v, params)

        return jax.jvp(along, (t, q), (jnp.ones_like(t), v))[1]

    def C(self, t: Any, q: Any, v: Any, params: Any, lam: Any) -> Any:
        """Derivative of the forces with respect to the multipliers, (n, m)."""
        return jax.jacfwd(self.force, 4)(t, q, v, params, lam)
