"""M, h, Q, A and gamma by both programs at one state, to be compared."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.linalg import norm

from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._graph._expression import Node
from jaxlag._lowering._symbolic._constraint_solve import SymbolicRows
from jaxlag._lowering._symbolic._program_key import Key, traced
from jaxlag._lowering._verification._compared_state import SLACK, Results, State, numbers
from jaxlag._tracing._interpret import NumpyProgram


class TermNodes(NamedTuple):
    """Terms of a scalar program as nodes.

    Attributes:
        mass: M.
        bias: h.
        rows: A and gamma; None without constraints.
        residuals: phi of the holonomic rows, then A v + b of all.
    """

    mass: Sequence[Sequence[Node]]
    bias: Sequence[Node]
    rows: SymbolicRows | None
    residuals: Sequence[Node]

    def at(self, at: State) -> tuple[np.ndarray, ...]:
        """M, h, A, gamma and the residuals at a state."""
        n = len(self.bias)
        A, gamma = ([], []) if self.rows is None else self.rows
        flat = [x for row in self.mass for x in row], [x for row in A for x in row]
        parts = [flat[0], self.bias, flat[1], gamma, self.residuals]
        found = numbers([x for part in parts for x in part], at)
        M, h, A, gamma, rest = np.split(found, np.cumsum([len(part) for part in parts])[:-1])
        return M.reshape(n, n), h, A.reshape(-1, n), gamma, rest


class ComparedTerms:
    """M a + h and A a + gamma for any a, phi and A v + b, by both programs.

    The array program has M a + h as one derivative, that of the momentum along the motion.
    """

    def __init__(self, key: Key, nodes: TermNodes) -> None:
        terms = ArrayTerms(key.lagrangian, (), key.constraints, baumgarte=key.baumgarte)
        self.key, self.nodes = key, nodes

        def parts(t: Any, q: Any, v: Any, params: Any, inputs: Any, a: Any) -> Any:
            balance = terms.euler_lagrange(t, q, v, a, params)
            if not key.constraints:
                return (balance,)
            residuals = terms.position(t, q, params), terms.velocity(t, q, v, params)
            return balance, _rates(terms, t, q, v, a, params), jnp.concatenate(residuals)

        self.parts = NumpyProgram(traced(key, parts, True, key.size))

    def __call__(self, at: State) -> Results | None:
        """The results at a state; None if it cannot be used."""
        t, q, v, params, inputs = at.arguments
        array = self.parts(t, q, v, *params, *inputs, at.a)
        M, h, A, gamma, rest = self.nodes.at(at)
        with np.errstate(all="ignore"):
            found = [M @ at.a + h, A @ at.a + gamma, rest][: len(array)]
        x = np.concatenate(array)
        if not np.all(np.isfinite(array[0])):
            defined = bool(self.key.constraints)
            return None if defined else Results(x, 0.0, found[0], defined=False)
        if not np.all(np.isfinite(x)):
            return None
        # Terms of h and gamma that cancel have the size of M v v and A v v.
        speed = norm(at.a) + norm(v) ** 2
        sizes = [
            norm(h) + norm(M) * (1.0 + speed),
            norm(gamma) + norm(A) * (1.0 + speed),
            norm(rest) + norm(A) * (1.0 + norm(q) + norm(v)),
        ]
        eps = float(jnp.finfo(self.key.dtype).eps)
        parts = zip(array, sizes, strict=False)
        allowed = [np.full(len(part), SLACK * eps * (1.0 + size)) for part, size in parts]
        return Results(x, np.concatenate(allowed), np.concatenate(found))


class ComparedForces:
    """Q by both programs."""

    def __init__(self, key: Key, force: Sequence[Node]) -> None:
        self.eps, self.force = float(jnp.finfo(key.dtype).eps), force
        terms = ArrayTerms(key.lagrangian, key.forces)
        self.on_arrays = NumpyProgram(traced(key, terms.force, True))

    def __call__(self, at: State) -> Results | None:
        """The results at a state."""
        t, q, v, params, inputs = at.arguments
        (Q,) = self.on_arrays(t, q, v, *params, *inputs)
        found = numbers(self.force, at)
        if not np.all(np.isfinite(Q)):
            return Results(Q, 0.0, found, defined=False)
        return Results(Q, SLACK * self.eps * (1.0 + norm(Q)), found)


def _rates(terms: ArrayTerms, t: Any, q: Any, v: Any, a: Any, params: Any) -> Any:
    """A a + gamma: the derivative of A v + b along (1, v, a), with Baumgarte's terms."""
    if not terms.constraints:
        return jnp.zeros((0,), q.dtype)

    def along(v: Any) -> Any:
        return terms.velocity(t, q, v, params)

    return jax.jvp(along, (v,), (a,))[1] + terms.gamma(t, q, v, params)
