"""Arguments of a step besides time and state, and checks at its end."""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float

from jaxlag._integration._row_selection import RowSelection
from jaxlag._linalg._independent_rows import RowChoice


class KnotIntervals(NamedTuple):
    """The intervals between the knots of all tables.

    Attributes:
        knots: sorted, in tau; empty within a step.
        lower: in the user's time, the lower end of the interval before each knot and of that after
            the last; -inf if there is none.
    """

    knots: Float[Array, " k"]
    lower: Float[Array, " g"]


class StepChecks(NamedTuple):
    """Checks of the state at the end of a step.

    Attributes:
        projected: Newton's method of the projection converged.
        redundant_rows_hold: rows that were left out as dependent are satisfied.
        contacts_valid: multipliers of contacts are not negative, and sliding has not reversed.
        independence: see `_change_points.Crossing`; None if it is not needed.
    """

    projected: Bool[Array, ""]
    redundant_rows_hold: Bool[Array, ""]
    contacts_valid: Bool[Array, ""]
    independence: Float[Array, ""] | None = None

    @property
    def good(self) -> Bool[Array, ""]:
        """Whether all checks passed; a motion may continue where rows are dependent."""
        return self.projected & self.redundant_rows_hold & self.contacts_valid


class Arguments(NamedTuple):
    """Arguments of the vector field besides time and state; all leaves are arrays."""

    params: Any
    inputs: Any  # within a step two rows of each table, in time from the start
    time_direction: Float[Array, ""] | None  # direction of time if it is traced
    origin: Float[Array, ""]  # the start, in the user's time
    end: Float[Array, ""]  # no time beyond it is read
    gaps: KnotIntervals | None  # None without tables
    constants: Any  # values for accelerations that depend on params alone
    rows: RowSelection | None = None  # None if all rows are used
    senses: Float[Array, " k"] | None = None  # signs of sliding velocities at the start
    usual: Float[Array, " b"] | None = None  # see `_quasi_singularities.usual`
    lengths: Float[Array, " m"] | None = None  # of rows at the start, see `_change_points`
    units: Float[Array, " n"] | None = None  # of coordinates, with inertias of 1 at the start
    slopes: Float[Array, "m n"] | None = None  # |A| at the start, unless it is sparse

    @property
    def active_rows(self) -> Bool[Array, " m"] | None:
        """Rows for the projection; None for all."""
        return None if self.rows is None else self.rows.active_rows

    @property
    def multiplier_rows(self) -> RowChoice | None:
        """Rows for the accelerations; None for all."""
        return None if self.rows is None else self.rows.multiplier_rows


def midway(
    t0: Array, t1: Array, y0: Array, y1: Array, slope_drop: Array | None
) -> tuple[Array, Array]:
    """(time, state) in the middle of a step, by its parabola if that is known.

    Args:
        t0: start of the step.
        t1: its end.
        y0: state at its start.
        y1: state at its end.
        slope_drop: h dy/dt at the start minus that at the end; None if it is unknown.
    """
    middle = 0.5 * (y0 + y1)
    return t0 + 0.5 * (t1 - t0), middle if slope_drop is None else middle + 0.125 * slope_drop
