"""Rates of a state of quasi-velocities by both programs at one state, to be compared."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.linalg import norm

from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._symbolic._program_key import Key, traced
from jaxlag._lowering._symbolic._symbolic_system import Equations
from jaxlag._lowering._verification._compared_state import (
    SLACK,
    Results,
    State,
    is_definite,
    numbers,
    solution,
)
from jaxlag._tracing._interpret import NumpyProgram


class ComparedRates:
    """v and u' with B^T M B u' = B^T (Q - h - M s), v = B u + c and s = v' at u' = 0."""

    def __init__(self, key: Key, equations: Equations) -> None:
        terms, quasi = ArrayTerms(key.lagrangian, key.forces), key.quasi
        assert quasi is not None
        self.key, self.quasi, self.equations = key, quasi, equations
        self.mass, self.bias = (
            NumpyProgram(traced(key, f, False)) for f in (terms.mass, terms.bias)
        )
        self.force = NumpyProgram(traced(key, terms.force, True)) if key.forces else None
        if quasi.kinematics is None:
            self.slopes = NumpyProgram(traced(key, _slopes_of(quasi.of), False))
            self.drift = NumpyProgram(
                traced(key, _drift_of(quasi.of, lambda t, q, v, params: v), False)
            )
        else:
            V, speeds = quasi.velocities, quasi.size
            self.slopes = NumpyProgram(traced(key, _slopes_of(V), False, speeds=speeds))
            self.drift = NumpyProgram(traced(key, _drift_of(V, V), False, speeds=speeds))

    def __call__(self, at: State) -> Results | None:
        """The results at a state; None if it cannot be used."""
        t, q, w, params, inputs = at.arguments
        u = np.zeros(self.quasi.size)
        u[self.quasi.free] = w
        if self.quasi.kinematics is None:
            theta, theta_0 = self.slopes(t, q, np.zeros(self.key.size), *params)
            inverted = solution(self.key, theta, u - theta_0)
            if inverted is None:
                return None
            v, allowed = inverted
            (rate,) = self.drift(t, q, v, *params)
            B, s = np.linalg.inv(theta), np.linalg.solve(theta, -rate)
        else:
            B, c = self.slopes(t, q, np.zeros_like(u), *params)
            v, (s,) = B @ u + c, self.drift(t, q, u, *params)
            allowed = SLACK * float(jnp.finfo(self.key.dtype).eps) * (1.0 + norm(v))
        B = B[:, self.quasi.free]
        (M,) = self.mass(t, q, v, *params)
        (h,) = self.bias(t, q, v, *params)
        Q = self.force(t, q, v, *params, *inputs)[0] if self.force is not None else 0.0
        reduced, right = B.T @ M @ B, B.T @ (Q - h - M @ s)
        # The terms are larger than their projections, and B has errors of its own.
        parts = norm(Q) + norm(h) + norm(M) * norm(s)
        eps, size = float(jnp.finfo(self.key.dtype).eps), norm(B)
        if not is_definite(reduced):
            x = np.concatenate([np.ravel(reduced), -right, v])
            if not np.all(np.isfinite(x)):
                return None
            scale = (1.0 + size) ** 2 * (norm(M) * (1.0 + norm(v) ** 2) + parts) + 1.0
            mass = [x for row in self.equations.mass for x in row]
            roots = [*mass, *self.equations.bias, *self.equations.accelerations[: self.key.size]]
            return Results(x, SLACK * eps * scale + allowed, numbers(roots, at))
        found = solution(self.key, reduced, right)
        if found is None:
            return None
        more = SLACK * eps * parts * size * norm(np.linalg.inv(reduced))
        limits = [np.full(len(v), allowed), np.full(len(w), found[1] + more * (1.0 + size))]
        rates = numbers(self.equations.accelerations, at)
        return Results(np.concatenate([v, found[0]]), np.concatenate(limits), rates)


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
