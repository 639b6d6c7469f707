"""Change points: states where constraint rows that are independent elsewhere become dependent.

An example is a parallelogram linkage that lies flat. Branches of motion meet there, and the rows do
not distinguish them. The motion continues along the tangent of its branch and is smooth. Across the
branch it is not smooth: with x the deviation across and T the time to the change point

    x'' = -2 x' / T.

Stages of a Runge-Kutta method deviate across the branch by errors of lower order and disturb the
later stages (a deviation at the start of a step is 2 times as large at its end in "tsit5", 400
times in "dopri8"). So near a change point

- every stage is projected onto the constraints, so that methods keep their order;
- the error of a step is that of the projected state: its component along the constraints;
- steps cross the change point with their stages as far from it as possible, and do not end
  close to it: rounding is eps / T^2 in accelerations, and more in their derivatives (Hessians along
  1,000 motions of a parallelogram at a tolerance of 1e-12: off by 5e-11 at most, and by up to 2e-2
  with unadjusted stages);
- rounding of a projected state is accepted: shorter steps do not reduce it;
- a step of fixed length with a stage at the change point fails, as no estimate gives its error;
- a state saved within a crossing step is interpolated if a step to it would have a stage at the
  change point: by the polynomial of degree 5 through the ends of that step, which is a short one.
  If the motion ends at the change point, the polynomial is that of a step half the way there.

The change point is located by s = 1 / sqrt(effective mass), the length of the part of a row that
is orthogonal to all others in the metric of M^-1: s goes through 0 linearly. If branches touch, or
one ends in a cusp, s goes to 0 as a higher power of the distance. Rows are then dependent LONGER
than the linear law predicts, and the motion stops.

If s is below LOST, the state is not moved along the row: rounding of positions would be multiplied
by 1 / s in velocities, and once more as the rows turn with positions. Its error across is removed
with the next state. If the sine of the angle between rows is less than eps^(1/3), accelerations are
only rounding: the row that depends on those before it is left out. The force of that row is then
missing for a time tau; the error is tau^2 / 2 times the acceleration by that force.

Sources: Khatib, IEEE J. Robotics Autom. 3 (1987) 43 (effective mass); Wampler, Sommese, Acta
Numerica 20 (2011) 469 (where branches of motion meet); Eich, SIAM J. Numer. Anal. 30 (1993) 1467
(errors of projected states).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._integration._step_arguments import Arguments, midway
from jaxlag._integration._vector_field import VectorField
from jaxlag._linalg._kkt import units_of
from jaxlag._linalg._projection import ConstraintProjector, keeps_sense
from jaxlag._model._forces import reads_lam

CHANGE_POINTS = ("pass", "stop")

GAP = 0.35
"""Least position of the gap between stages in a step: earlier stages are of low order and are
disturbed more the nearer they are."""

AT_HAND = 0.02
"""Fraction of a step: a change point nearer to its start has no stages on both sides."""

ROOM = 0.9
"""Length of the crossing step over the proposed length."""

BESIDE = 0.05
"""Row length at the end of a step over that at its start, below which steps should not end."""

AHEAD = 0.5
"""Row length over that at the start of the motion, below which a change point is predicted."""

UNLIKE = 10.0
"""Error of a step to a save time, in tolerances, above which a stage has met a change point."""

AGAIN = 4.0
"""Error in tolerances that is assigned to a step so that it is repeated with a shorter length."""

SHORT = 0.1
"""Row length over that at the start of the motion, below which a change point is near."""

LOST = 1e-3
"""The same ratio, below which states are not moved along the row."""

ROUNDINGS = 8
"""Rounding of a projected position, in eps, for a row of length 1."""

LONGER = 2.5
"""Bound on the distance over which rows are dependent, over that at a crossing of branches. The
ratio is 7 at cusps x^2 = y^3, 20 where branches touch."""


class Crossing(NamedTuple):
    """Detection of change points: its state at the start of a step.

    Attributes:
        independence: least row length over its length at the start of the motion.
        within: distance covered while rows are dependent; as `span`, in kg^1/2 m.
        span: change of coordinates over which the row length goes to 0, extrapolated from a step;
            infinite if it does not decrease.
        time: predicted time of the next change point; infinite if there is none.
    """

    independence: Float[Array, ""]
    within: Float[Array, ""]
    span: Float[Array, " n"]
    time: Float[Array, ""]

    def onwards(
        self,
        t0: Float[Array, ""],
        t1: Float[Array, ""],
        independence: Float[Array, ""],
        moved: Float[Array, " n"],
    ) -> "Crossing":
        """The state of the detection at the end of a step.

        Args:
            t0: start of the step.
            t1: its end.
            independence: as in `Crossing`, at the end of the step.
            moved: change of coordinates, in units in which their inertias are 1.
        """
        lost = self.independence - independence
        falls = lost > 0
        nearer = (independence > 0) & (independence < AHEAD) & falls
        left = jnp.where(nearer, independence / jnp.where(nearer, lost, 1.0), jnp.inf)
        left = left.astype(t1.dtype)
        fresh = jnp.where(falls, jnp.abs(moved) / jnp.where(falls, lost, 1.0), jnp.inf)
        # Row lengths that vanish as a higher power of the distance decrease ever more slowly.
        stays = self.depends | (self.is_near & (jnp.sum(self.span) < jnp.sum(fresh)))
        span = jnp.where(stays, self.span, fresh)
        part = jnp.where(
            independence > 2 * LOST, 2 * LOST / jnp.where(independence > 0, independence, 1.0), 1.0
        )
        within = jnp.where(self.depends, self.within + part * jnp.linalg.norm(moved), 0.0)
        return Crossing(independence, within, span, t1 + (t1 - t0) * left)

    @property
    def depends(self) -> Bool[Array, ""]:
        """Whether rows are dependent: the row length is below LOST."""
        return self.independence <= LOST

    @property
    def stands(self) -> Bool[Array, ""]:
        """Whether the state is at the change point, to the accuracy of accelerations."""
        return self.independence <= unknown_below(self.independence.dtype)

    @property
    def passes(self) -> Bool[Array, ""]:
        """Whether rows were dependent for a distance as short as at a crossing of branches."""
        return self.within <= LONGER * 2 * LOST * jnp.linalg.norm(self.span)

    @property
    def is_near(self) -> Bool[Array, ""]:
        """Whether a row is almost dependent on the others."""
        return self.independence < SHORT

    def is_beside(self, before: "Crossing") -> Bool[Array, ""]:
        """Whether a step from outside the change point ends very close to it."""
        return (self.independence < BESIDE * before.independence) & ~before.depends

    def rounding(
        self,
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        surface: ConstraintProjector,
        args: Arguments,
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Rounding of projected coordinates and velocities near a change point; 0 elsewhere.

        A row has the rounding errors of its inputs. The projection moves coordinates by these over
        the row length, and velocities by the same over the time to the change point.

        Args:
            q: coordinates.
            v: velocities.
            surface: the constraints at the end of the step.
            args: arguments of the step.
        """
        if not surface.sparse:
            return self._rounding(q, v, surface, args)
        some = eqxi.unvmap_any(self.is_near)
        none = jnp.zeros_like(q), jnp.zeros_like(v)
        return jax.lax.cond(some, lambda: self._rounding(q, v, surface, args), lambda: none)

    def _rounding(
        self, q: Array, v: Array, surface: ConstraintProjector, args: Arguments
    ) -> tuple[Array, Array]:
        assert args.units is not None
        assert surface.columns is not None
        least = ROUNDINGS * float(jnp.finfo(self.independence.dtype).eps)
        span = jnp.where(jnp.isfinite(self.span), self.span, 0.0)
        length = jnp.linalg.norm(span)
        rate = jnp.linalg.norm(v / args.units) / jnp.where(length > 0, length, 1.0)
        columns = surface.columns()

        def spread(size: Array) -> Array:  # by sums: a step has no matrix products
            if args.slopes is None:
                assert surface.reach is not None
                rows = surface.reach(size)
            else:
                rows = jnp.sum(args.slopes * size[None], axis=1)
            return jnp.sum(jnp.abs(columns) * rows[:, None], axis=0)

        positions = jnp.abs(q) + spread(jnp.abs(q) + args.units * span)
        soon = rate / jnp.maximum(
            self.independence, float(jnp.finfo(self.independence.dtype).eps) ** (1 / 3)
        )
        velocities = jnp.abs(v) + spread(jnp.abs(v)) + soon * positions
        near = jnp.where(self.is_near, least, 0.0)
        return near * positions, near * velocities

    def noise(
        self, v: Float[Array, " n"], args: Arguments
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Allowed differences of stages in coordinates and velocities near a change point; else 0.

        They are deviations across the branch, and the projection removes their effect.

        Args:
            v: velocities.
            args: arguments of the step.
        """
        assert args.units is not None
        part = jnp.where(
            self.is_near, float(jnp.finfo(self.independence.dtype).eps) ** (1 / 3), 0.0
        )
        span = jnp.where(jnp.isfinite(self.span), self.span, 0.0)
        speed = jnp.linalg.norm(v / args.units)
        return part * args.units * jnp.linalg.norm(span), part * args.units * speed

    def step(
        self,
        t: Float[Array, ""],
        h: Float[Array, ""],
        gap: float,
        stop: Float[Array, ""] | float = np.inf,
        due: Float[Array, ""] | float = np.inf,
    ) -> Float[Array, ""]:
        """A step of at most h with the change point between its stages, or one that ends before it.

        A state saved within a crossing step is interpolated: that step is made short. So is the
        last step of a motion that ends at the change point. If the motion ends beyond it, the last
        step starts so that the change point is between its stages.

        Args:
            t: start of the step.
            h: its proposed length.
            gap: see `widest_gap`.
            stop: end of the motion.
            due: the next save time.
        """
        left = jnp.asarray(self.time - t, h.dtype)
        ahead = (left > 0) & (left < h / AT_HAND)
        left = jnp.where(ahead, left, h)
        across, approach = left / gap, left - ROOM * gap * h
        near = ahead & self.is_near & (left > AT_HAND * h)
        found = jnp.where(near & (across > h), approach, jnp.where(near, across, h))
        # Step up to a last one that has the change point at `gap`; below, up to a short one.
        lead = left - gap / (1 - gap) * jnp.asarray(stop - self.time, h.dtype)
        cut = near & (stop > self.time) & (stop < t + across) & (lead > AT_HAND * left)
        found = jnp.where(cut, lead, found)
        least, ends = narrow(self.independence.dtype), self.is_at(t, stop)
        # Not in float32, where shorter steps would add rounding.
        saved = ahead & (due < t + jnp.maximum(across, h)) & (least < SHORT)
        found = jnp.where(ends, h, jnp.where(saved & ~cut, across, found))
        part = 1.0 - jnp.maximum(
            least / jnp.where(ahead, self.independence.astype(h.dtype), 1.0), 0.1
        )
        found = jnp.where((saved | ends) & (part > AT_HAND), part * left, found)
        return jnp.minimum(found, h)

    def is_at(self, t: Float[Array, ""], time: Float[Array, ""] | float) -> Bool[Array, ""]:
        """Whether a time is that of the change point ahead, within a third of a narrow step.

        Args:
            t: the current time.
            time: the time to compare.
        """
        pace = (self.time - t) / self.independence.astype(self.time.dtype)
        close = narrow(self.independence.dtype) / 3
        return jnp.isfinite(self.time) & (pace > 0) & (jnp.abs(self.time - time) <= close * pace)


def unknown_below(dtype: Any) -> float:
    """Row length over that at the start of the motion, below which it is only rounding."""
    return min(2 * float(jnp.finfo(dtype).eps) ** (1 / 3), LOST)


def narrow(dtype: Any) -> float:
    """The same ratio at the start of a crossing step with saved states, or of the last step.

    The error of the polynomial is the step length to the power of 6, and that of rounding is eps
    over its square: 0.015 in float64, where both are 1e-12, and 0.1 in float32.
    """
    return min(1.35 * float(jnp.finfo(dtype).eps) ** (1 / 8), SHORT)


def no_crossing(time: Float[Array, ""], n: int, dtype: Any) -> Crossing:
    """The detection at the start of a motion of n coordinates; times have the dtype of `time`."""
    one, zero = jnp.ones((), dtype), jnp.zeros((), dtype)
    return Crossing(one, zero, jnp.full((n,), jnp.inf, dtype), jnp.full_like(time, jnp.inf))


def is_across(
    begin: Crossing, end: Crossing, saved: Crossing, sound: Bool[Array, ""]
) -> Bool[Array, ""]:
    """Whether a state saved within a step is to be interpolated.

    It is if the step to it met a change point, or if it lies at one; in a short step also near one.

    Args:
        begin: detection at the start of the step.
        end: at its end.
        saved: at the saved state.
        sound: whether the step to the saved state succeeded.
    """
    at_it = saved.stands | (
        saved.depends & (begin.independence < 2 * narrow(begin.independence.dtype))
    )
    independence = jnp.minimum(
        jnp.minimum(begin.independence, end.independence), saved.independence
    )
    return at_it | (~sound & (independence < AHEAD))


def widest_gap(nodes: Sequence[float]) -> float:
    """The middle of the longest interval without stages, as a fraction of the step."""
    places = np.unique(np.clip([0.0, *nodes, 1.0], 0.0, 1.0))
    middles, widths = 0.5 * (places[1:] + places[:-1]), np.diff(places)
    return float(middles[np.argmax(np.where(middles >= GAP, widths, 0.0))])


def lengths_of(
    masses: Float[Array, " m"], active_rows: Bool[Array, " m"] | None
) -> Float[Array, " m"]:
    """1 / sqrt of effective masses: row lengths orthogonal to all others, in the metric of M^-1.

    0 for rows that are dependent here, 1 for rows that are not active.
    """
    masses = jax.lax.stop_gradient(masses)
    lengths = jnp.where(masses > 0, jax.lax.rsqrt(jnp.where(masses > 0, masses, 1.0)), 0.0)
    lengths = jnp.where(jnp.isnan(masses), jnp.nan, lengths)
    return lengths if active_rows is None else jnp.where(active_rows, lengths, 1.0)


def scales_at(
    dynamics: VectorField, tau: Array, y: Array, args: Arguments
) -> tuple[Float[Array, " n"], Float[Array, "m n"]]:
    """Units of the coordinates in which their inertias are 1 at this state, and |A| there."""
    t, q, v, params = dynamics.state(tau, y, args)
    terms = dynamics.terms_at(q, args)
    A = terms.rows_of(t, v, params)(q)
    return units_of(terms.mass(t, q, v, params), A), jnp.abs(A)


def may_cross(dynamics: VectorField) -> bool:
    """Whether a constraint row may be left out near a change point.

    Beyond the change point the state is projected onto all rows again. A force that reads
    multipliers is undefined where these are unknown.
    """
    reads = any(map(reads_lam, dynamics.system.forces))
    return dynamics.projects and may_stop(dynamics) and not reads


def may_stop(dynamics: VectorField) -> bool:
    """Whether accelerations are solved for with constraint rows."""
    return dynamics.quasi is None and dynamics.rows.size > 0


def same_sense(
    dynamics: VectorField,
    t0: Array,
    t1: Array,
    y0: Array,
    y1: Array,
    args: Arguments,
    slope_drop: Array | None,
) -> Bool[Array, ""]:
    """Whether a step passes no change point: pivots of A(t) M^-1 A(t0)^T keep their signs.

    They are tested in the middle and at the end of the step, relative to their values at its start.
    Every branch that meets at a change point changes one sign.

    Args:
        dynamics: the vector field.
        t0: start of the step.
        t1: its end.
        y0: state at its start.
        y1: state at its end.
        args: arguments of the step.
        slope_drop: h dy/dt at the start minus that at the end; None if it is unknown.
    """
    surface, fine = dynamics.projector(t0, y0, args), jnp.array(True)
    assert surface.columns is not None
    columns, of_surface = surface.columns, surface.keeps_sense
    for tau, y in (midway(t0, t1, y0, y1, slope_drop), (t1, y1)):
        t, (q, v), (params, _) = dynamics.clock(tau, args), dynamics.parts(y), dynamics.given(args)
        if of_surface is None:
            A = dynamics.terms_at(q, args).rows_of(t, v, params)(q)
            found = keeps_sense(columns(), A, args.active_rows)
        else:
            found = of_surface(t, q, v)
        fine = fine & found
    return fine
