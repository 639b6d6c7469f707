"""The array program: terms by automatic differentiation of L on whole arrays."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag import _params
from jaxlag._errors import real_scalar
from jaxlag._forces import AbstractForce, components
from jaxlag._linalg import solve_mass
from jaxlag._terms import Terms


class ArrayTerms(Terms):
    """Terms of a system from its Lagrangian: works for any L that JAX differentiates twice.

    M takes n forward-over-reverse columns in one batch, h a single forward derivative of the
    reverse pass, so the number of evaluations of L in h does not grow with n.
    """

    lagrangian: Callable = eqx.field(static=True)
    forces: tuple[AbstractForce, ...]

    def momentum(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """Momentum p = dL/dv by one reverse pass."""
        return jax.grad(real_scalar("lagrangian", self.lagrangian), argnums=2)(t, q, v, params)

    def mass(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, "n n"]:
        """M = dp/dv: one derivative of p along each unit velocity, batched."""

        def column(e: Float[Array, " n"]) -> Float[Array, " n"]:
            return jax.jvp(lambda v: self.momentum(t, q, v, params), (v,), (e,))[1]

        return jax.vmap(column)(jnp.eye(v.shape[0], dtype=v.dtype))

    def bias(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """Bias h = dp/dt - dL/dq at a = 0: one derivative of (dL/dq, p) along (t', q') = (1, v)."""
        lagrangian = real_scalar("lagrangian", self.lagrangian)

        def gradients(t: Array, q: Array) -> tuple[Array, Array]:
            return jax.grad(lagrangian, argnums=(1, 2))(t, q, v, params)

        (dL_dq, _), (_, p_dot) = jax.jvp(gradients, (t, q), (jnp.ones_like(t), v))
        return p_dot - dL_dq

    def euler_lagrange(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        a: Float[Array, " n"],
        params: Any,
    ) -> Float[Array, " n"]:
        """The same derivative as in h, along (t', q', v') = (1, v, a)."""
        lagrangian = real_scalar("lagrangian", self.lagrangian)

        def gradients(t: Array, q: Array, v: Array) -> tuple[Array, Array]:
            return jax.grad(lagrangian, argnums=(1, 2))(t, q, v, params)

        (dL_dq, _), (_, p_dot) = jax.jvp(gradients, (t, q, v), (jnp.ones_like(t), v, a))
        return p_dot - dL_dq

    def force(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """Q, summed over the declared forces."""
        total = jnp.zeros_like(q)
        for force in self.forces:
            total = total + components(force, t, q, v, params, inputs)
        return total

    def rows(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """No rows: (0, n) and (0,)."""
        return jnp.zeros((0, q.shape[0]), q.dtype), jnp.zeros((0,), q.dtype)

    def gamma(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " m"]:
        """No rows: shape (0,)."""
        return jnp.zeros((0,), q.dtype)

    def prepare(
        self,
        q: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        sample: _params.Sample = _params.UNKNOWN,
    ) -> None:
        """Nothing: M is formed at every state."""

    def acceleration(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        prepared: Any = None,
    ) -> Float[Array, " n"]:
        """Solve M a = Q - h; force code only where forces are declared."""
        M = self.mass(t, q, v, params)
        h = self.bias(t, q, v, params)
        if not self.forces:
            return solve_mass(M, -h)
        return solve_mass(M, self.force(t, q, v, params, inputs) - h)
