"""Whether a state satisfies the constraints, and whether their rank stays beside it."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._analysis._independent_columns import rank_of, unit_rows
from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._core._status import Status
from jaxlag._linalg._kkt import units_of
from jaxlag._linalg._mass_solve import dependence_floor
from jaxlag._linalg._row_residuals import relative_residual, row_sizes
from jaxlag._lowering import AbstractTerms
from jaxlag._model._constraints import ConstraintRows
from jaxlag._statics._assemble import assemble
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._compiled import Compiled

NEARBY = 1e-3
"""Distance of the state whose rank is compared, over 1 + |q|."""


class Rows(NamedTuple):
    """Constraint rows at a state.

    Attributes:
        A: with 0 in rows that are rounding.
        off: |phi| and |A v + b| over the sizes of the rows and of q and v.
    """

    A: Float[Array, "m n"]
    off: Float[Array, "2 m"]


def rows_of_state(
    terms: AbstractTerms,
    rows: ConstraintRows,
    t: Float[Array, ""],
    q: Float[Array, " n"],
    v: Float[Array, " n"],
    params: Any,
) -> Rows:
    """The rows without rounding, and the residuals."""
    of_q = terms.rows_of(t, v, params)
    A = of_q(q)
    nonzero, _, size = row_sizes(of_q, q, A, all(rows.sure))
    phi = rows.of_all(terms.position(t, q, params))
    both = (phi, q), (terms.velocity(t, q, v, params), v)
    off = jnp.stack([relative_residual(c, size, x) for c, x in both])
    return Rows(jnp.where(nonzero[:, None], A, 0.0), off)


def rows_at(
    system: System,
    sample: _params.Sample,
    params: Any,
    t: Float[Array, ""],
    q: Float[Array, " n"],
    v: Float[Array, " n"],
) -> np.ndarray:
    """A at a state that satisfies the constraints, in units of equal inertia.

    Of traced v only q is checked.

    Raises:
        ValueError: a state off the constraints; one beside which more rows are independent.
    """
    rows = system._rows(params, q.dtype)
    moving = concrete(v)
    with jax.ensure_compile_time_eval():
        v_known = v if moving else jnp.zeros_like(q)
    off, A = rows_near(system, sample, params, t, q, v_known)
    for kind, size in zip(("phi", "A v + b") if moving else ("phi",), off, strict=False):
        worst = int(np.argmax(size))
        if not size[worst] <= dependence_floor(off.dtype):
            raise invalid(
                "linearize: q and v",
                "satisfy the constraints",
                f"{kind} of {rows.labels[worst]!r} was {size[worst]:.3g} of the state",
                "Take them from jl.assemble.",
            )
    rank = rank_of(unit_rows(A), dependence_floor(A.dtype))
    if moving and rank < rows.size and _rank_beside(system, sample, params, t, q, v) > rank:
        must = "be a state near which the rows have one rank"
        was = "more rows are independent beside it: a dead point or a change point"
        raise invalid("linearize: q and v", must, was, "Choose a state beside it.")
    return A


def rows_near(
    system: System,
    sample: _params.Sample,
    params: Any,
    t: Float[Array, ""],
    q: Float[Array, " n"],
    v: Float[Array, " n"],
) -> tuple[np.ndarray, np.ndarray]:
    """(residuals, A in units of equal inertia) at any state."""
    with jax.ensure_compile_time_eval():
        found = _rows_and_residuals((system, sample), params, None, t, q, v)
        return np.asarray(found[0]), np.asarray(found[1])


def _rank_beside(
    system: System, sample: _params.Sample, params: Any, t: Array, q: Array, v: Array
) -> int:
    """Rank of A at a consistent state nearby; 0 if none is found."""
    shift = np.random.default_rng(0).uniform(-1.0, 1.0, q.shape[0])
    near = jnp.asarray(q + NEARBY * shift * (1.0 + np.abs(q)), q.dtype)
    found = assemble(system, near, v, params, t=t, throw=False)
    if int(found.status) != int(Status.ok):
        return 0
    A = rows_near(system, sample, params, t, found.q, found.v)[1]
    return rank_of(unit_rows(A), dependence_floor(A.dtype))


@Compiled
def _rows_and_residuals(
    system: System, sample: _params.Sample, params: Any, _: None, t: Array, q: Array, v: Array
) -> tuple[Array, Array]:
    """(residuals, A in units of equal inertia)."""
    rows, terms = system._rows(params, q.dtype), system._program.terms(q, params, sample)
    A, off = rows_of_state(terms, rows, t, q, v, params)
    return off, A * units_of(terms.mass(t, q, v, params), A)
