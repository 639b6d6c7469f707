"""Accelerations by a scalar program and by numpy at one state, to be compared."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.linalg import norm

from jaxlag._linalg._independent_rows import shared
from jaxlag._linalg._kkt import augmented
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._graph._expression import Node
from jaxlag._lowering._row_layout import layout_of
from jaxlag._lowering._symbolic._program_key import Key, traced
from jaxlag._lowering._symbolic._read_system import rows_that_forces_read
from jaxlag._lowering._verification._compared_state import (
    Results,
    State,
    is_definite,
    numbers,
    solution,
)
from jaxlag._lowering._verification._compared_terms import TermNodes
from jaxlag._model._forces import reads_lam
from jaxlag._tracing._interpret import NumpyProgram

_NOTHING = Results(np.zeros(0), 0.0, np.zeros(0))


class ComparedAccelerations:
    """The a with M a + h = Q + A^T lam, A a + gamma = 0, by a scalar program and by numpy.

    numpy solves with the terms of the same graph, which `ComparedTerms` and `ComparedForces`
    compare with the array program. Only forces that read multipliers are evaluated on arrays.
    """

    def __init__(
        self, key: Key, nodes: TermNodes, force: Sequence[Node], accelerations: Sequence[Node]
    ) -> None:
        self.key, self.nodes, self.force, self.accelerations = key, nodes, force, accelerations
        self.reactive, self.read = None, ()
        if any(map(reads_lam, key.forces)):
            terms = ArrayTerms(key.lagrangian, key.forces, key.constraints)
            self.reactive = NumpyProgram(_slopes(key, terms))
            self.read = rows_that_forces_read(key, terms)

    def __call__(self, at: State) -> Results | None:
        """The results at a state; None if it cannot be used.

        Where M is not clearly definite, nothing is compared; None if reactions are read.
        """
        t, q, v, params, inputs = at.arguments
        n = self.key.size
        M, h, A, gamma, _ = self.nodes.at(at)
        right = numbers(self.force, at) - h if self.force else -h
        active_rows: Any = ()
        if not (np.all(np.isfinite(M)) and np.all(np.isfinite(right))):
            if len(gamma):
                return None
            return Results(right, 0.0, numbers(self.accelerations, at), defined=False)
        if len(gamma):
            active_rows = _independent(A, self.read)
            if not is_definite(M if self.key.regular else _augmented(M, A[active_rows])):
                return None if self.reactive is not None else _NOTHING
            G = np.zeros((n, len(A)))
            if self.reactive is not None:
                rest, G = self.reactive(t, q, v, *params, *inputs, np.zeros(len(A)))
                right = right + rest
                G = G if np.all(active_rows) else G @ _as_read(A, active_rows, self.read)
            M, right = _bordered(M, A[active_rows], right, gamma[active_rows], G[:, active_rows])
            if self.reactive is not None and not np.linalg.det(_pressing(M, n)) > 0:
                return None
        elif not is_definite(M):
            return _NOTHING
        found = solution(self.key, M, right)
        if found is None:
            return None
        return Results(found[0][:n], found[1], numbers(self.accelerations, at, active_rows))


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
