"""Verification of a scalar program against the array program, at random states, uncompiled."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.linalg import norm

from jaxlag._linalg._independent_rows import shared
from jaxlag._linalg._kkt import augmented
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._row_layout import layout_of
from jaxlag._lowering._symbolic._evaluate import evaluate
from jaxlag._lowering._symbolic._program_key import Key, traced
from jaxlag._lowering._symbolic._read_system import rows_that_forces_read
from jaxlag._lowering._symbolic._symbolic_system import Equations, SymbolicSystem
from jaxlag._model._forces import reads_lam
from jaxlag._tracing._interpret import interpret

STATES = 8  # random states at which both programs are compared
LEAST = 6  # least number of comparable states
DRAWS = 32  # largest number of states drawn
SLACK = 1e4  # roundings between two ways to compute one acceleration
NUDGES = 3  # changes of q and v by one rounding each, if the slack is exceeded
SENSITIVE = 1e-3  # relative change of an acceleration by a nudge beyond which a state is not used


class Verification(NamedTuple):
    """The comparison of a program with the array program.

    Attributes:
        states: number of compared states.
        difference: the largest, in units of SLACK roundings; inf if only one has a value.
    """

    states: int
    difference: float

    @property
    def message(self) -> str:
        """The result as text."""
        if not self.difference <= 1.0:
            if np.isinf(self.difference):
                return "differs from the array program: only one of them is finite"
            return f"differs from the array program by {SLACK * self.difference:.1e} roundings"
        if self.states < LEAST:
            return f"only {self.states} of {DRAWS} random states to compare with the array program"
        return f"equal to the array program at {self.states} random states"

    @property
    def sound(self) -> bool:
        """Whether they are equal at enough states."""
        return bool(self.difference <= 1.0) and self.states >= LEAST


def compare(
    key: Key, scene: SymbolicSystem, equations: Equations, known: list | None
) -> Verification:
    """Compare a program with the array program, with the known params and with random ones.

    Known params may be special, and random ones may be impossible for a system: both are used,
    until there are enough states. If M is not positive definite, M, h, Q, A and gamma are
    compared instead of the acceleration, with quasi-velocities their projections, and v. If
    forces read multipliers, such states are left out. If the array program has no value, the
    other must have none.
    """
    expected = _Plain(key) if key.quasi is None else _Quasi(key)
    rng = np.random.default_rng(0)
    n = key.size
    speeds = n if key.quasi is None else len(key.quasi.free)
    eps = float(jnp.finfo(key.dtype).eps)
    like, given = jax.tree.leaves(key.params.tree), jax.tree.leaves(key.inputs.tree)

    def drawn(from_known: bool) -> float | None:
        """The difference at one more state; None if there is nothing to compare."""
        t, q, v = rng.uniform(0, 1), rng.uniform(-1.5, 1.5, n), rng.uniform(-1.5, 1.5, speeds)
        params = [
            rng.uniform(0.5, 1.5, leaf.shape)
            if jnp.issubdtype(leaf.dtype, jnp.floating)
            else rng.integers(1, 4, leaf.shape).astype(leaf.dtype)
            for leaf in like
        ]
        if from_known and known is not None:
            params = [
                np.asarray(x, np.float64 if jnp.issubdtype(x.dtype, jnp.floating) else x.dtype)
                for x in known
            ]
        inputs = [rng.uniform(-1, 1, leaf.shape) for leaf in given]
        values: dict[tuple[str, int], Any] = {("t", 0): t, ("time_direction", 0): 1.0}
        for name, rows in (("q", [q]), ("v", [v]), ("params", params), ("inputs", inputs)):
            flat = np.concatenate([np.ravel(x) for x in rows]) if rows else []
            values |= {(name, i): x for i, x in enumerate(flat)}
        right = expected(t, q, v, params, inputs)
        if right is None:
            return None
        values |= {("active_rows", k): float(x) for k, x in enumerate(right.active_rows)}
        values |= {("nonzero", k): 1.0 for k in range(len(right.active_rows))}
        roots = equations.accelerations
        if right.parts:
            roots = [*(x for row in equations.mass for x in row), *equations.bias]
            roots += (scene.force or []) if key.quasi is None else equations.accelerations[:n]
            if equations.rows is not None:
                roots += [*(x for row in equations.rows.A for x in row), *equations.rows.gamma]
        found = np.array([float(x) for x in evaluate(roots, values)])
        if not right.defined:
            return np.inf if np.all(np.isfinite(found)) else None
        off = float(np.max(np.abs(found - right.x) / right.allowed, initial=0.0))
        if 1.0 < off < np.inf:
            # Sines of a million lose digits in both programs: as many as a nudge changes.
            change = 0.0
            for _ in range(NUDGES):
                signs = 1.0 + eps * rng.choice([-1.0, 1.0], (2, max(n, speeds)))
                near = expected(t, q * signs[0, :n], v * signs[1, :speeds], params, inputs)
                if near is None or near.x.shape != right.x.shape:
                    return None
                change = max(change, float(np.max(np.abs(near.x - right.x))))
            if change > SENSITIVE * norm(right.x):
                return None
            off = float(np.max(np.abs(found - right.x) / (right.allowed + SLACK * change)))
        return off if np.isfinite(off) else np.inf

    compared, worst = 0, 0.0
    for from_known, wanted in (
        ((True, STATES), (False, STATES // 2)) if known else ((False, STATES),)
    ):
        states, wanted = 0, max(wanted, LEAST - compared)
        for _ in range(DRAWS):
            off = drawn(from_known)
            if off is not None:
                worst = max(worst, off)
                states += bool(np.isfinite(off))
            if states == wanted or worst > 1.0:
                break
        compared += states
    return Verification(compared, worst)


class _Right(NamedTuple):
    """The result of the array program.

    Attributes:
        x: the acceleration, or M, h and Q.
        allowed: allowed difference.
        active_rows: rows used in solves.
        defined: whether there is a value.
        parts: whether x is M, h, Q, A and gamma; with quasi-velocities B^T M B, B^T (h + M s - Q)
            and v.
    """

    x: np.ndarray
    allowed: Any
    active_rows: Any = ()
    defined: bool = True
    parts: bool = False


_NONE = _Right(np.zeros(0), 0.0, defined=False)


def _solved(key: Key, M: Any, right: Any) -> tuple[Any, float] | None:
    """(x with M x = right, allowed difference of another method); None if M is ill-conditioned."""
    if not (np.all(np.isfinite(M)) and np.all(np.isfinite(right))):
        return None
    if not np.linalg.cond(M) < 1e9:
        return None
    x = np.linalg.solve(M, right)
    size = norm(right) + norm(M) * norm(x) + 1.0
    eps = float(jnp.finfo(key.dtype).eps)
    return x, float(SLACK * eps * size * norm(np.linalg.inv(M)))


def _definite(M: Any) -> bool:
    """Whether M is finite and clearly positive definite."""
    if not np.all(np.isfinite(M)):
        return False
    return bool(np.min(np.linalg.eigvalsh(M), initial=1.0) > 1e-9 * norm(M))


class _Plain:
    """The accelerations a with M a + h = Q + A^T lam, A a + gamma = 0."""

    def __init__(self, key: Key) -> None:
        terms = ArrayTerms(key.lagrangian, key.forces, key.constraints, baumgarte=key.baumgarte)
        self.key = key
        self.mass, self.bias = (traced(key, f, False) for f in (terms.mass, terms.bias))
        self.force = traced(key, terms.force, True) if key.forces else None
        self.bound = []
        if key.constraints:
            self.bound = [traced(key, f, False) for f in (terms.rows, terms.gamma)]
        self.reactive, self.read = None, ()
        if any(map(reads_lam, key.forces)):
            self.reactive, self.read = _slopes(key, terms), rows_that_forces_read(key, terms)

    def __call__(self, t: Any, q: Any, v: Any, params: list, inputs: list) -> _Right | None:
        n = self.key.size
        (M,) = interpret(self.mass, t, q, v, *params)
        (h,) = interpret(self.bias, t, q, v, *params)
        Q = np.zeros(0)
        right = -h
        if self.force is not None:
            (Q,) = interpret(self.force, t, q, v, *params, *inputs)
            right = Q + right
        if not (np.all(np.isfinite(M)) and np.all(np.isfinite(right))):
            return None if self.bound else _NONE
        active_rows: Any = ()
        if self.bound:
            (A, _), (gamma,) = (interpret(f, t, q, v, *params) for f in self.bound)
            active_rows = _independent(A, self.read)
            if not _definite(M if self.key.regular else _augmented(M, A[active_rows])):
                return None if self.reactive is not None else self._parts(v, M, h, Q, A, gamma)
            G = np.zeros((n, len(A)))
            if self.reactive is not None:
                rest, G = interpret(self.reactive, t, q, v, *params, *inputs, np.zeros(len(A)))
                right = right + rest
                G = G if np.all(active_rows) else G @ _as_read(A, active_rows, self.read)
            M, right = _bordered(M, A[active_rows], right, gamma[active_rows], G[:, active_rows])
            if self.reactive is not None and not np.linalg.det(_pressing(M, n)) > 0:
                return None
        elif not _definite(M):
            return self._parts(v, M, h, Q)
        found = _solved(self.key, M, right)
        return None if found is None else _Right(found[0][:n], found[1], active_rows)

    def _parts(self, v: Any, M: Any, *others: Any) -> _Right | None:
        """M, h, Q, A and gamma instead of the accelerations; None if one has no value."""
        parts = np.concatenate([np.ravel(x) for x in (M, *others)])
        if not np.all(np.isfinite(parts)):
            return None
        # Terms of h and gamma that cancel have the size of M v v and A v v.
        size = 1.0 + sum(map(norm, others)) + (norm(M) + sum(map(norm, others[2:]))) * norm(v) ** 2
        eps = float(jnp.finfo(self.key.dtype).eps)
        return _Right(parts, SLACK * eps * (size + norm(M)), parts=True)


class _Quasi:
    """v and u' with B^T M B u' = B^T (Q - h - M s), v = B u + c and s = v' at u' = 0."""

    def __init__(self, key: Key) -> None:
        terms, quasi = ArrayTerms(key.lagrangian, key.forces), key.quasi
        assert quasi is not None
        self.key, self.quasi = key, quasi
        self.mass, self.bias = (traced(key, f, False) for f in (terms.mass, terms.bias))
        self.force = traced(key, terms.force, True) if key.forces else None
        if quasi.kinematics is None:
            self.slopes = traced(key, _slopes_of(quasi.of), False)
            self.drift = traced(key, _drift_of(quasi.of, lambda t, q, v, params: v), False)
        else:
            V, speeds = quasi.velocities, quasi.size
            self.slopes = traced(key, _slopes_of(V), False, speeds=speeds)
            self.drift = traced(key, _drift_of(V, V), False, speeds=speeds)

    def __call__(self, t: Any, q: Any, w: Any, params: list, inputs: list) -> _Right | None:
        u = np.zeros(self.quasi.size)
        u[self.quasi.free] = w
        if self.quasi.kinematics is None:
            theta, theta_0 = interpret(self.slopes, t, q, np.zeros(self.key.size), *params)
            inverted = _solved(self.key, theta, u - theta_0)
            if inverted is None:
                return None
            v, allowed = inverted
            (rate,) = interpret(self.drift, t, q, v, *params)
            B, s = np.linalg.inv(theta), np.linalg.solve(theta, -rate)
        else:
            B, c = interpret(self.slopes, t, q, np.zeros_like(u), *params)
            v, (s,) = B @ u + c, interpret(self.drift, t, q, u, *params)
            allowed = SLACK * float(jnp.finfo(self.key.dtype).eps) * (1.0 + norm(v))
        B = B[:, self.quasi.free]
        (M,) = interpret(self.mass, t, q, v, *params)
        (h,) = interpret(self.bias, t, q, v, *params)
        Q = interpret(self.force, t, q, v, *params, *inputs)[0] if self.force is not None else 0.0
        reduced, right = B.T @ M @ B, B.T @ (Q - h - M @ s)
        # The terms are larger than their projections, and B has errors of its own.
        parts = norm(Q) + norm(h) + norm(M) * norm(s)
        eps, size = float(jnp.finfo(self.key.dtype).eps), norm(B)
        if not _definite(reduced):
            x = np.concatenate([np.ravel(reduced), -right, v])
            if not np.all(np.isfinite(x)):
                return None
            scale = (1.0 + size) ** 2 * (norm(M) * (1.0 + norm(v) ** 2) + parts) + 1.0
            return _Right(x, SLACK * eps * scale + allowed, parts=True)
        found = _solved(self.key, reduced, right)
        if found is None:
            return None
        more = SLACK * eps * parts * size * norm(np.linalg.inv(reduced))
        limits = [np.full(len(v), allowed), np.full(len(w), found[1] + more * (1.0 + size))]
        return _Right(np.concatenate([v, found[0]]), np.concatenate(limits))


def _slopes_of(function: Callable) -> Callable:
    """(slopes in the third argument, value at zero) of a function that is affine in it."""

    def slopes(t: Any, q: Any, x: Any, params: Any) -> Any:
        return jax.jacfwd(lambda x: function(t, q, x, params))(x), function(t, q, 0.0 * x, params)

    return slopes


def _drift_of(function: Callable, velocity: Callable) -> Callable:
    """The rate of a function of (t, q, x, params) along (1, velocity) at fixed x."""

    def drift(t: Any, q: Any, x: Any, params: Any) -> Any:
        along = jnp.ones_like(t), velocity(t, q, x, params)
        return jax.jvp(lambda t, q: function(t, q, x, params), (t, q), along)[1]

    return drift


def _slopes(key: Key, terms: ArrayTerms) -> Any:
    """The jaxpr of (Q_0, G) of the forces Q_0 + G lam."""

    def affine(t: Any, q: Any, v: Any, params: Any, inputs: Any, lam: Any) -> Any:
        def reaction(lam: Any) -> Any:
            return terms.reactive(t, q, v, params, inputs, lam)

        return reaction(lam), jax.jacfwd(reaction)(lam)

    m = layout_of(key.constraints, key.params, key.static, key.size, key.dtype).size
    return traced(key, affine, True, m)


def _bordered(M: Any, A: Any, r: Any, c: Any, G: Any) -> tuple[Any, Any]:
    """[M, A^T + G; A, 0] and (r, -c), for the unknowns (a, -lam)."""
    none = np.zeros((len(A), len(A)))
    return np.block([[M, A.T + G], [A, none]]), np.concatenate([r, -c])


def _pressing(whole: Any, n: int) -> Any:
    """[M + A^T A, -(A^T + G); A, 0]; its determinant is positive for a regular sense of rows."""
    whole = whole.copy()
    A = whole[n:, :n]
    whole[:n, :n] += A.T @ A
    whole[:n, n:] *= -1.0
    return whole


def _augmented(M: Any, A: Any) -> np.ndarray:
    """M + A^T W A, the divisor of the scalar program for a possibly singular M, as numbers."""
    with jax.ensure_compile_time_eval():
        return np.asarray(augmented(jnp.asarray(M), jnp.asarray(A))[0])


def _as_read(A: Any, active_rows: np.ndarray, read: Sequence[bool]) -> np.ndarray:
    """The matrix from multipliers of the active rows to those that forces read, as numbers."""
    with jax.ensure_compile_time_eval():
        rows, given = jnp.asarray(A), (jnp.asarray(active_rows), jnp.asarray(norm(A, axis=1) > 0))
        columns = [shared(rows, e, *given, read) for e in jnp.eye(len(A), dtype=rows.dtype)]
        return np.asarray(jnp.stack(columns, axis=1))


def _independent(A: Any, read: Sequence[bool]) -> np.ndarray:
    """A largest set of clearly independent rows; rows that forces read come first."""
    active_rows, Y = np.zeros(len(A), bool), np.zeros((0, A.shape[1]))
    for k in sorted(range(len(A)), key=lambda k: bool(read) and not read[k]):
        rest = A[k] - (Y @ A[k]) @ Y
        size = norm(rest)
        if size > 1e-3 * norm(A[k]):
            active_rows[k], Y = True, np.vstack([Y, rest / size])
    return active_rows
