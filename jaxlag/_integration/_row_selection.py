"""The constraint rows that a solve uses: a largest independent set at the start."""

from functools import partial
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._core._arrays import stop_gradient
from jaxlag._core._errors import invalid
from jaxlag._linalg._independent_rows import RowChoice, independent_rows
from jaxlag._linalg._row_residuals import row_sizes
from jaxlag._lowering import AccelerationProgram, ArrayTerms, State
from jaxlag._model._constraints import Baumgarte, ConstraintRows
from jaxlag._tracing import _params


class RowSelection(NamedTuple):
    """The constraint rows used in solves: a largest independent set at the start.

    Attributes:
        active_rows: these rows, holonomic ones first; the others follow from them as long as the
            rank does not change.
        size: size of every row at the start and nearby.
        void: rows that are 0 = 0 up to rounding.
        multiplier_rows: an independent set with as many as possible of the rows whose multipliers
            are read by forces.
    """

    active_rows: Bool[Array, " m"]
    size: Float[Array, " m"]
    void: Bool[Array, " m"]
    multiplier_rows: RowChoice


def selected_rows(
    program: AccelerationProgram,
    terms: ArrayTerms,
    rows: ConstraintRows,
    stabilization: Any,
    sample: _params.Sample,
    state: State,
) -> RowSelection:
    """The rows to solve with, by elimination with pivoting at a state.

    Args:
        program: of the accelerations.
        terms: on arrays.
        rows: all rows.
        stabilization: of the constraints.
        sample: values of the params if these are traced.
        state: the start.
    """
    t, q, v, params, values = state = State(*stop_gradient(tuple(state)))
    few = program.terms(q, params, sample)
    entries = program.row_entries(few, state)
    nonzero, void, size = row_sizes(entries, q, entries(q), all(rows.sure))
    if rows.size == 1:  # left out only if it is void
        return RowSelection(~void, size, void, RowChoice(~void, ~void))
    velocity = np.array(rows.velocity)
    unread = np.logical_not(terms.rows_read(t, q, v, params, values))
    # If multipliers are read, the active rows determine which others are left out.
    reads = not np.all(unread)

    def search(priority: np.ndarray, mobile_first: bool) -> Array:
        M, A = few.mass(t, q, v, params), few.rows_of(t, v, params)(q)
        return independent_rows(M, A, priority, nonzero=nonzero, mobile_first=mobile_first)

    priority, first = 2 * velocity + unread, program.first_rows(state, sample)
    searched = partial(search, priority if first is None else 2 * priority + ~first, reads)
    clear = program.clearly_independent(state, sample)
    if clear is None:
        active_rows = searched()
    else:
        clear = clear & eqxi.unvmap_all(jnp.all(nonzero))
        active_rows = jax.lax.cond(clear, lambda: nonzero, searched)
    if not np.any(velocity & ~unread):  # then the rows that are read already come first
        return RowSelection(active_rows, size, void, RowChoice(active_rows, nonzero))
    if isinstance(stabilization, Baumgarte) and not np.all(velocity):
        label = rows.labels[int(np.argmax(velocity & ~unread))]
        raise invalid(
            "stabilization",
            "be 'projection' if forces read multipliers of Pfaffian rows and there are also "
            "holonomic rows (phi of a dependent holonomic row would not be damped)",
            f"it was {stabilization!r}, and a force reads {label!r}",
        )
    for_multipliers = search(unread, True)
    return RowSelection(active_rows, size, void, RowChoice(for_multipliers, nonzero))
