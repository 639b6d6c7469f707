"""The vector field as a diffrax term."""

from dataclasses import replace
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag._integration._canonical import Canonical
from jaxlag._integration._step_arguments import Arguments
from jaxlag._integration._vector_field import VectorField


class Term(diffrax.ODETerm):
    """A vector field whose increments keep the dtype of the state if that of time differs.

    Attributes:
        dynamics: the system's vector field.
        lines: number of lines of the scalar program for the accelerations; None if there is none.
        dtype: dtype of the state.
    """

    dynamics: VectorField
    lines: int | None = eqx.field(static=True)
    dtype: Any = eqx.field(static=True)

    def compiled_for(self, lanes: bool, in_loop: bool) -> "Term":
        """The same, compiled for the place where it is evaluated, see `VectorField`."""
        return self._of(replace(self.dynamics, lanes=lanes, in_loop=in_loop))

    @property
    def seldom(self) -> "Term":
        """The same, to be evaluated a few times in a solve."""
        return self._of(replace(self.dynamics, seldom=True))

    @property
    def with_jacobians(self) -> "Term":
        """The same, for methods that compute Jacobians of it."""
        return self._of(replace(self.dynamics, jacobians=True))

    def _of(self, dynamics: VectorField) -> "Term":
        field: Any = dynamics.__call__
        return Term(field, dynamics, self.lines, self.dtype)

    @property
    def works(self) -> bool:
        """Whether the state has work besides q and v."""
        return self.dynamics.power is not None and bool(self.dynamics.power.names)

    @property
    def in_lanes(self) -> bool:
        """Whether it is written to be vmapped over a few trajectories."""
        return self.dynamics.lanes

    @property
    def second_order(self) -> bool:
        """Whether the state is (q, v): dq/dtau = sigma v, dv/dtau = sigma a."""
        return self.dynamics.quasi is None and not self.works and not self.dynamics.state_count

    def signed(self, x: Any, args: Arguments) -> Any:
        """Sigma x, of a tree."""
        return jax.tree.map(lambda x: self.dynamics.signed(x, args), x)

    def sections(self, y: Any) -> tuple[Any, Any, Any]:
        """(q, v, the rest) of a state or of its rates."""
        n, rest = self.dynamics.system.size, self.dynamics.system.size + self.dynamics.speeds
        return y[:n], y[n:rest], y[rest:]

    def canonical(self, args: Arguments) -> Canonical:
        """Momenta and forces within a step."""
        return Canonical(self.dynamics, args)

    def joined(self, q: Any, v: Any, work: Any) -> Any:
        """The inverse of `sections`."""
        return jnp.concatenate([q, v, work])

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        return (t1 - t0).astype(self.dtype)


def term_of(
    dynamics: VectorField, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
) -> Term:
    """The vector field of `dynamics`, for states and arguments like these."""
    field: Any = dynamics.__call__
    return Term(field, dynamics, dynamics.lines(tau, y, args), y.dtype)
