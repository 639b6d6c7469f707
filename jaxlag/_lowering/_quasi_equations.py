"""Equations of motion in quasi-velocities on arrays: v and u' of a state (q, u)."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag._linalg._independent_rows import independent_rows, least_norm
from jaxlag._linalg._kkt import masked, units_of
from jaxlag._linalg._mass_solve import factor_mass, solve_mass
from jaxlag._linalg._row_residuals import row_sizes
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._tracing._signature import gradient


class QuasiState:
    """One state (t, q, u), u the free quasi-velocities, and its rates.

    Attributes:
        v: velocities.
    """

    def __init__(
        self,
        terms: ArrayTerms,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        u: Float[Array, " r"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> None:
        assert terms.quasi is not None
        self.terms, self.quasi = terms, terms.quasi
        self.t, self.q, self.u, self.params, self.inputs = t, q, u, params, inputs
        self.v, self._jvp_fn = jax.linearize(lambda u: self._velocities(t, q, u), u)
        self._vjp_fn = jax.linear_transpose(self._jvp_fn, u)

    def _velocities(self, t: Array, q: Array, u: Array) -> Array:
        return self.quasi.velocities(t, q, self.quasi.full(u), self.params)

    def _along(self, function: Any, *more: tuple[Array, Array]) -> Any:
        """d/dt of function(t, q, *more) along (1, v), each of `more` a (value, rate)."""
        values, rates = zip((self.t, jnp.ones_like(self.t)), (self.q, self.v), *more, strict=True)
        return jax.jvp(function, values, rates)[1]

    def velocity_rate(self, du: Float[Array, " r"]) -> Float[Array, " n"]:
        """dv/dt = B u' + s for a given u'."""
        return self._along(self._velocities, (self.u, du))

    def accelerations(self) -> Float[Array, " r"]:
        """u' of the free quasi-velocities; NaN if it does not exist."""
        mass, right = self._projected() if self.terms.in_u is None else self._hamel()
        return solve_mass(mass, right)

    def _force(self) -> Array:
        terms = self.terms
        if not terms.forces:
            return jnp.zeros_like(self.q)
        return terms.force(self.t, self.q, self.v, self.params, self.inputs)

    def _projected(self) -> tuple[Array, Array]:
        """(B^T M B, B^T (Q - (M s + h))): M s + h is Lagrange's left side at a = s."""
        terms, t, q, v, params = self.terms, self.t, self.q, self.v, self.params
        s = self._along(lambda t, q: self._velocities(t, q, self.u))
        (right,) = self._vjp_fn(self._force() - terms.euler_lagrange(t, q, v, s, params))

        def column(e: Array) -> Array:
            momentum = jax.jvp(lambda v: terms.momentum(t, q, v, params), (v,), (self._jvp_fn(e),))
            return self._vjp_fn(momentum[1])[0]

        return jax.vmap(column)(jnp.eye(self.u.shape[0], dtype=q.dtype)), right

    def _hamel(self) -> tuple[Array, Array]:
        """(dp/du, B^T (Q + dL/dq - Gamma p) - dp/dt at u' = 0) from L(t, q, u), p = dL/du.

        Gamma p = d/dt(Theta) p - (dU/dq)^T p at fixed p and v. It is computed without Gamma: one
        derivative of Theta p along the motion, one gradient.

        Source: Pila, eqs. 4.44 to 4.58, with the terms of explicit time and of affine U.
        """
        t, q, v, params, free = self.t, self.q, self.v, self.params, self.quasi.free
        assert self.terms.in_u is not None
        L = self.terms.in_u
        u = self.quasi.full(self.u)

        def momentum(t: Array, q: Array, u: Array) -> Array:
            return gradient("lagrangian", L, 2)(t, q, self.quasi.full(u), params)

        p = momentum(t, q, self.u)

        def weighted(t: Array, q: Array, v: Array) -> Array:
            return p @ self.quasi.of(t, q, v, params)

        turning = self._along(lambda t, q: jax.grad(weighted, argnums=2)(t, q, v))
        gamma_p = turning - jax.grad(weighted, argnums=1)(t, q, v)
        effort = self._force() + gradient("lagrangian", L, 1)(t, q, u, params) - gamma_p
        rate = self._along(lambda t, q: momentum(t, q, self.u))[free]

        def column(e: Array) -> Array:
            return jax.jvp(lambda u: momentum(t, q, u)[free], (self.u,), (e,))[1]

        mass = jax.vmap(column)(jnp.eye(self.u.shape[0], dtype=q.dtype))
        return mass, self._vjp_fn(effort)[0] - rate

    def reactions(self) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """(a, lam) with A^T lam = M a + h - Q, lam of least norm for dependent rows."""
        terms, t, q, v, params = self.terms, self.t, self.q, self.v, self.params
        a = self.velocity_rate(self.accelerations())
        left = terms.euler_lagrange(t, q, v, a, params) - self._force()
        A, _ = terms.rows(t, q, v, params)
        stop_gradient = jax.lax.stop_gradient
        nonzero = row_sizes(
            lambda q: terms.rows(t, q, v, params)[0], *stop_gradient((q, A))
        ).nonzero
        units = units_of(*stop_gradient((terms.mass(t, q, v, params), A)))
        metric = jnp.diag(units**-2)
        active_rows = independent_rows(metric, stop_gradient(A), nonzero=nonzero, mobile_first=True)
        rows = masked(A, active_rows) * units
        sizes = jnp.sqrt(jnp.sum(stop_gradient(rows) ** 2, axis=1))
        sizes = jnp.where(active_rows, sizes, 1.0)
        rows = rows / sizes[:, None]
        gram = rows @ rows.T + jnp.diag((~active_rows).astype(q.dtype))
        factor = factor_mass(stop_gradient(gram))
        left = units * left
        lam = solve_mass(gram, rows @ left, factor)
        lam = lam + solve_mass(gram, rows @ (left - lam @ rows), factor)
        return a, least_norm(A, lam / sizes, active_rows, nonzero, units)
