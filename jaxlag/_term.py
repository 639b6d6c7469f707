"""The vector field as diffrax takes it."""

from dataclasses import replace
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag._canonical import Canonical
from jaxlag._dynamics import Dynamics
from jaxlag._step import Arguments


class Term(diffrax.ODETerm):
    """A vector field whose increments keep the state's dtype where time has another.

    Attributes:
        dynamics: what it is the vector field of.
        scalar: the dynamics, where they have a scalar program.
        dtype: of the state.
        elementwise: the dynamics, where the state is the tuple of its elements.
    """

    dynamics: Dynamics
    scalar: Dynamics | None
    dtype: Any = eqx.field(static=True)
    elementwise: Dynamics | None = None

    @property
    def second_order(self) -> Dynamics | None:
        """The dynamics, where they are q'' = a element by element."""
        form = self.elementwise
        return None if form is None or form.quasi is not None else form

    def by_element(self, lanes: bool, in_loop: bool) -> "Term | None":
        """The same for states that are tuples of their elements, vmapped or not."""
        if self.scalar is None:
            return None
        dynamics = replace(self.scalar, lanes=lanes, in_loop=in_loop)
        field: Any = dynamics.rates
        return Term(field, dynamics, None, self.dtype, dynamics)

    @property
    def works(self) -> bool:
        """Whether the state has work besides q and v."""
        return self.dynamics.power is not None and bool(self.dynamics.power.names)

    def sections(self, y: Any) -> tuple[Any, Any, Any]:
        """(q, v, work) of a state or of its rates, an array or the tuple of its elements."""
        n, rest = self.dynamics.system.size, self.dynamics.system.size + self.dynamics.speeds
        return y[:n], y[n:rest], y[rest:]

    def canonical(self, args: Arguments) -> Canonical:
        """Momenta and forces within a step."""
        return Canonical(self.dynamics, args)

    def joined(self, q: Any, v: Any, work: Any) -> Any:
        """The inverse of `sections`."""
        return (*q, *v, *work) if isinstance(q, tuple) else jnp.concatenate([q, v, work])

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        return (t1 - t0).astype(self.dtype)


def term_of(
    dynamics: Dynamics, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
) -> Term:
    """The vector field of `dynamics`, for states and arguments like these."""
    field: Any = dynamics.__call__
    scalar = dynamics if dynamics.is_scalar(tau, y, args) else None
    return Term(field, dynamics, scalar, y.dtype)
