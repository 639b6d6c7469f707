"""What a step is given besides time and state, and what is said about its end."""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float

from jaxlag._linalg._independent_rows import RowChoice


class RowSelection(NamedTuple):
    """Which constraint rows are solved with: a largest independent set at the start.

    Attributes:
        kept: these rows, holonomic ones first; the others follow from them as long as the rank does
            not change.
        size: of every row at the start and beside.
        void: those that are 0 = 0 but for rounding.
        reacting: such a set with as many as possible of the rows whose multipliers forces read.
    """

    kept: Bool[Array, " m"]
    size: Float[Array, " m"]
    void: Bool[Array, " m"]
    reacting: RowChoice


class KnotIntervals(NamedTuple):
    """The intervals between the knots of all tables.

    Attributes:
        knots: sorted, in tau; empty within a step.
        lower: in the user's time, the lower end of the gap before each knot and of that after the
            last; -inf where there is none.
    """

    knots: Float[Array, " k"]
    lower: Float[Array, " g"]


class StepChecks(NamedTuple):
    """Checks of the state at the end of a step.

    Attributes:
        projected: Newton's method of the projection converged.
        redundant_rows_hold: rows that were left out as dependent are satisfied.
        contacts_valid: multipliers of contacts are not negative, and sliding has not reversed.
        apart: see `_change_points.Crossing`; None where nobody asks.
        columns: of the matrix of the projection; None likewise.
    """

    projected: Bool[Array, ""]
    redundant_rows_hold: Bool[Array, ""]
    contacts_valid: Bool[Array, ""]
    apart: Float[Array, ""] | None = None
    columns: Float[Array, "m n"] | None = None

    @property
    def good(self) -> Bool[Array, ""]:
        """Whether all is well; where rows depend on one another a motion may still go on."""
        return self.projected & self.redundant_rows_hold & self.contacts_valid


class Arguments(NamedTuple):
    """What the vector field depends on besides time and state; all leaves are arrays."""

    params: Any
    inputs: Any  # within a step two rows of each table, in time from the start
    time_direction: Float[Array, ""] | None  # direction of time where it is traced
    origin: Float[Array, ""]  # the start, in the user's time
    end: Float[Array, ""]  # beyond which no time is read
    gaps: KnotIntervals | None  # None without tables
    constants: Any  # what accelerations need of what depends on params alone
    rows: RowSelection | None = None  # None where there is no choice
    senses: Float[Array, " k"] | None = None  # signs of sliding velocities at the start
    usual: Float[Array, " b"] | None = None  # see `_quasi_singularities.usual`
    lengths: Float[Array, " m"] | None = None  # of rows at the start, see `_change_points`
    units: Float[Array, " n"] | None = None  # of coordinates, with inertias of 1 at the start
    slopes: Float[Array, "m n"] | None = None  # |A| at the start

    @property
    def kept(self) -> Bool[Array, " m"] | None:
        """Rows to project by; None for all."""
        return None if self.rows is None else self.rows.kept

    @property
    def reacting(self) -> RowChoice | None:
        """Rows to solve accelerations with; None for all."""
        return None if self.rows is None else self.rows.reacting


def midway(t0: Array, t1: Array, y0: Array, y1: Array, turn: Array | None) -> tuple[Array, Array]:
    """(time, state) in the middle of a step, by the parabola through it where that is known.

    Args:
        t0: start of the step.
        t1: its end.
        y0: state at its start.
        y1: state at its end.
        turn: h dy/dt at the start less that at the end; None where it is not known.
    """
    middle = 0.5 * (y0 + y1)
    return t0 + 0.5 * (t1 - t0), middle if turn is None else middle + 0.125 * turn
