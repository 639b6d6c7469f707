"""The tangent space of the constraints: deviations for a unit of each independent state."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._analysis._consistent_state import rows_of_state
from jaxlag._analysis._independent_columns import completed
from jaxlag._analysis._minimal_states import MinimalStates
from jaxlag._linalg._mass_solve import dependence_floor
from jaxlag._linalg._row_residuals import row_sizes
from jaxlag._system._system import System
from jaxlag._tracing import _params


def tangent_basis(
    system: System,
    sample: _params.Sample,
    states: MinimalStates,
    checked: bool,
    params: Any,
    t: Float[Array, ""],
    q: Float[Array, " n"],
    v: Float[Array, " n"],
) -> Float[Array, "s k"]:
    """Deviations of (q, w, x) for a unit of each state; w = v, or the free quasi-velocities.

        delta q = P x_q,  delta w = S x_q + N x_w,  phi_q P = 0,  A N = 0,
        A S + d(A v + b)/dq P = 0

    It is NaN if `states` do not determine the others, and off the constraints.

    Args:
        system: the mechanical system.
        sample: params for checks of the code.
        states: the independent ones.
        checked: whether the state is known to satisfy the constraints.
        params: as the Lagrangian takes them.
        t: time.
        q: coordinates.
        v: velocities.
    """
    n, c, r = q.shape[0], len(states.coordinates), len(states.velocities)
    terms, rows = system._program.terms(q, params, sample), system._rows(params, q.dtype)
    P = jnp.eye(n, dtype=q.dtype)
    some = jnp.ones((rows.size,), q.dtype)
    if not all(rows.sure):  # rows that may be rounding
        of_q = terms.rows_of(t, v, params)
        some = row_sizes(of_q, *jax.lax.stop_gradient((q, of_q(q)))).nonzero.astype(q.dtype)
    if any(rows.holonomic):
        phi_q = terms.rows_of_position(t, params)(q) * some[np.array(rows.holonomic), None]
        none = jnp.zeros((phi_q.shape[0], c), q.dtype)
        P = completed(phi_q, jnp.eye(c, dtype=q.dtype), none, states.coordinates)
    N, S = jnp.eye(r, dtype=q.dtype), jnp.zeros((r, c), q.dtype)
    if rows.size and system.quasi is None:
        A = terms.rows_of(t, v, params)(q) * some[:, None]
        along = jax.linearize(lambda q: some * terms.velocity(t, q, v, params), q)[1]
        right = jnp.concatenate(
            [-jax.vmap(along, 1, 1)(P), jnp.zeros((rows.size, r), q.dtype)], axis=1
        )
        both = completed(A, jnp.eye(r, c + r, c, dtype=q.dtype), right, states.velocities)
        S, N = both[:, :c], both[:, c:]
    moving = jnp.block([[P, jnp.zeros((n, r), q.dtype)], [S, N]])
    size = 0 if system.states is None else len(system.states.layout.labels)
    basis = jax.scipy.linalg.block_diag(moving, jnp.eye(size, dtype=q.dtype))
    if rows.size and not checked:
        off = rows_of_state(terms, rows, t, q, v, params).off
        basis = jnp.where(jnp.all(off <= dependence_floor(q.dtype)), basis, jnp.nan)
    return basis
