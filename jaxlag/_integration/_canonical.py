"""Canonical variables: momenta and forces for structure-preserving methods."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxlag._core._arrays import stop_gradient
from jaxlag._integration._step_arguments import Arguments
from jaxlag._integration._vector_field import VectorField
from jaxlag._linalg._kkt import augmented, masked
from jaxlag._linalg._mass_solve import factor_mass
from jaxlag._tracing._signature import gradient


class Canonical(eqx.Module):
    """p = dL/dv,   p' = dL/dq + Q + A^T lam,   phi(t, q) = 0, at times tau of the loop.

    The multiplier of a row that is left out as dependent is 0.

    Attributes:
        dynamics: the vector field.
        args: arguments within a step.
    """

    dynamics: VectorField
    args: Arguments

    def span(self, tau0: Float[Array, ""], tau1: Float[Array, ""]) -> Float[Array, ""]:
        """t1 - t0 in the user's time; negative if time runs backwards."""
        return self.dynamics.signed(tau1 - tau0, self.args)

    @property
    def rows(self) -> int:
        """Number of constraint rows."""
        return self.dynamics.rows.size

    def canonical(
        self, tau: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """(p, dL/dq + Q)."""
        t, params, values = self._given(tau, q, v)
        slopes = gradient("lagrangian", self.dynamics.system.lagrangian, (1, 2))
        slope, p = slopes(t, q, v, params)
        if not self.dynamics.system.forces:
            return p, slope
        return p, slope + self.dynamics.terms.force(t, q, v, params, values)

    def regular(
        self, tau: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"]
    ) -> Bool[Array, ""]:
        """Whether d2L/dv2 is positive definite, with constraints on their tangent space."""
        tau, q, v, form = stop_gradient((tau, q, v, self))
        t, params = form._at(tau)
        M = form.dynamics.terms.mass(t, q, v, params)
        if form.rows:
            A, _ = form.dynamics.terms.rows(t, q, v, params)
            M, _ = augmented(M, masked(A, form.args.active_rows))
        return jnp.all(factor_mass(M).healthy)

    def position(
        self, tau: Float[Array, ""], q: Float[Array, " n"], lam: Float[Array, " m"]
    ) -> Float[Array, " m"]:
        """phi; lam for a row that is left out."""
        t, params = self._at(tau)
        return self._of_rows(self.dynamics.terms.position(t, q, params), lam)

    def velocity(
        self,
        tau: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        lam: Float[Array, " m"],
    ) -> Float[Array, " m"]:
        """A v + b; lam for a row that is left out."""
        t, params = self._at(tau)
        return self._of_rows(self.dynamics.terms.velocity(t, q, v, params), lam)

    def reaction(
        self, tau: Float[Array, ""], q: Float[Array, " n"], lam: Float[Array, " m"]
    ) -> Float[Array, " n"]:
        """A^T lam."""
        if not self.rows:
            return jnp.zeros_like(q)
        t, params = self._at(tau)
        lam = self._of_rows(lam, jnp.zeros_like(lam))
        return jax.vjp(lambda q: self.dynamics.terms.position(t, q, params), q)[1](lam)[0]

    def power(
        self, tau: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"]
    ) -> Float[Array, " k"]:
        """The terms of dH/dt."""
        assert self.dynamics.power is not None
        t, params, values = self._given(tau, q, v)
        return jnp.stack(list(self.dynamics.power(t, q, v, params, values).values()))

    def _at(self, tau: Array) -> tuple[Array, Any]:
        return self.dynamics.clock(tau, self.args), self.dynamics.given(self.args)[0]

    def _given(self, tau: Array, q: Array, v: Array) -> tuple[Array, Any, Any]:
        return *self._at(tau), self.dynamics.inputs_at(tau, q, v, q[:0], self.args)

    def _of_rows(self, x: Array, other: Array) -> Array:
        return x if self.args.active_rows is None else jnp.where(self.args.active_rows, x, other)
