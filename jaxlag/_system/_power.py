"""Power: the terms of dH/dt along a motion."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag._lowering import ArrayTerms
from jaxlag._model._constraints import AbstractConstraint, ConstraintRows
from jaxlag._model._forces import EXPLICIT_TIME, AbstractForce, components, reads_lam
from jaxlag._tracing._signature import gradient


class Power(eqx.Module):
    """dH/dt = sum_k v . Q_k - b . lam - dL/dt at fixed (q, v), term by term, H = v . dL/dv - L.

    Every force has its term under its own name. EXPLICIT_TIME exists if L depends on t. Every
    constraint with rows A v + b = 0 and a nonzero b has the term v . A^T lam = -b . lam.

    Source: Goldstein, Classical Mechanics, sec. 2.7 (the energy function h) with applied forces;
    Pila, eq. 3.194 holds without them.
    """

    lagrangian: Callable = eqx.field(static=True)
    forces: tuple[AbstractForce, ...]
    explicit_time: bool = eqx.field(static=True)
    terms: ArrayTerms
    rows: ConstraintRows = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms: forces and constraints as declared, explicit time last."""
        names = (*(force.name for force in self.forces), *self.rows.driven_names)
        return (*names, EXPLICIT_TIME) if self.explicit_time else names

    def __call__(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        values: Mapping[str, Any],
    ) -> dict[str, Float[Array, ""]]:
        """The terms in W; `values` are those of the inputs at (t, q, v)."""
        lam = named = None
        if self.rows.driven_names or any(map(reads_lam, self.forces)):
            _, lam = self.terms.reactions(t, q, v, params, values)
            named = self.rows.unflatten(lam)
        terms = {
            force.name: v @ components(force, t, q, v, params, values, named)
            for force in self.forces
        }
        if self.rows.driven_names:
            _, b = self.terms.rows(t, q, v, params)
            assert lam is not None
            done = self.rows.unflatten(-b * lam)
            terms |= {name: jnp.sum(done[name]) for name in self.rows.driven_names}
        if self.explicit_time:
            dL_dt = gradient("lagrangian", self.lagrangian, 0)(t, q, v, params)
            terms[EXPLICIT_TIME] = -dL_dt.astype(q.dtype)
        return terms


def in_order(
    terms: Mapping[str, Any],
    forces: Sequence[AbstractForce],
    constraints: Sequence[AbstractConstraint],
) -> dict[str, Any]:
    """Terms of dH/dt in the order of declaration, explicit time last: jit sorts dicts by name."""
    rows = [name for constraint in constraints for name in constraint.all_names]
    names = (*(force.name for force in forces), *rows, EXPLICIT_TIME)
    return {name: terms[name] for name in names if name in terms}
