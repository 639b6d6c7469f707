"""Places on the way where constraint rows that are independent elsewhere depend on one another.

As where a parallelogram linkage lies flat: ways of moving meet there, and rows do not tell one from
another. The motion that comes along one of them goes on along its tangent, and is as smooth as
elsewhere. Beside the ways it is not: with x across them and T the time to the place

    x'' = -2 x' / T,

so that stages of a Runge-Kutta method, which are across the ways by errors of lower order, disturb
those that follow (what is across at the start of a step leaves it 2 times as large in "tsit5", 400
times in "dopri8"). So near the place

- every stage is moved onto the constraints, so that methods keep their order;
- the error of a step is that of the state after the projection, by what is left of it along the
  constraints;
- steps pass it with the stages on either side, as far from it as they can be, and do not end
  beside it: rounding is eps / T^2 in accelerations, and more in their derivatives (Hessians along
  1,000 motions of a parallelogram at a tolerance of 1e-12: off by 5e-11 at most, and by up to 2e-2
  with stages as they come);
- what rounding makes of a projected state is accepted: shorter steps do not improve it;
- an equal step of which a stage meets the place is not taken, as no estimate tells what it is off;
- what is saved in a step across is interpolated where a step to it would have a stage at the place:
  by the polynomial of degree 5 through the ends of that step, which is a short one. A motion that
  ends at the place does so by that through the ends of a step half the way there.

Where the place lies is told by s = 1 / sqrt(effective mass), the length of what a row has apart
from all others in the metric of M^-1: it goes through 0 there, as a straight line. Where ways
touch, or one ends in a cusp, it does so as a higher power of the way to the place, so that rows
depend for LONGER than that line says: there the motion stops.

A state that lies at the place but for LOST is not moved along the row, as rounding of positions
would become 1 / s times as much of velocities, and once more as positions turn these. Its error
across is moved back with the next state. Where even accelerations are nothing but rounding, where
the sine of the angle between rows is less than eps^(1/3), the row that depends on those before it
is left out. That leaves out the force that holds the motion on its way, for a time tau, and is off
by tau^2 / 2 times what the force would have accelerated.

Sources: Khatib, IEEE J. Robotics Autom. 3 (1987) 43 (effective mass); Wampler, Sommese, Acta
Numerica 20 (2011) 469 (where ways of moving meet); Eich, SIAM J. Numer. Anal. 30 (1993) 1467
(errors of projected states).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._integration._step_arguments import Arguments, midway
from jaxlag._integration._vector_field import VectorField
from jaxlag._linalg._kkt import solve_general, units_of
from jaxlag._model._forces import reads_lam

CHANGE_POINTS = ("pass", "stop")

GAP = 0.35
"""Of a step: stages before it are of low order, and are the more disturbed the nearer they are."""

AT_HAND = 0.02
"""Of a step: a place that is nearer to its start has no stages on either side."""

ROOM = 0.9
"""Of the length of steps: what that of the step across is to be."""

BESIDE = 0.05
"""Of the length of a row at the start of a step: not to end with less, if it can be helped."""

AHEAD = 0.5
"""Of the same: below it a place is looked out for."""

UNLIKE = 10.0
"""Tolerances that a step to what is saved is off by where one of its stages meets a place."""

AGAIN = 4.0
"""Times what is allowed, that a step is taken to be off by which is taken again, shorter."""

SHORT = 0.1
"""Of the length of a row at the start of a motion: below it a place is near."""

LOST = 1e-3
"""Of the same: below it states are not moved along the row."""

ROUNDINGS = 8
"""Of a position that a length of 1 leaves."""

LONGER = 2.5
"""Times the way that rows depend for where ways cross. It is 7 at cusps x^2 = y^3, 20 where ways
touch."""


class Crossing(NamedTuple):
    """What is known of change points where a step starts.

    Attributes:
        apart: the least length of a row over its length at the start of the motion.
        within: the way that was covered where rows depend; as `span`, in kg^1/2 m.
        span: the change of coordinates in which the row would lose all of its length, as the step
            tells it that came nearer; infinite where none did.
        time: when the next place is to be expected; infinite where none is.
    """

    apart: Float[Array, ""]
    within: Float[Array, ""]
    span: Float[Array, " n"]
    time: Float[Array, ""]

    def onwards(
        self,
        t0: Float[Array, ""],
        t1: Float[Array, ""],
        apart: Float[Array, ""],
        moved: Float[Array, " n"],
    ) -> "Crossing":
        """What is known at the end of a step, in which coordinates moved so far.

        Args:
            t0: start of the step.
            t1: its end.
            apart: see `Crossing`, at its end.
            moved: change of coordinates, in units in which their inertias are 1.
        """
        lost = self.apart - apart
        falls = lost > 0
        nearer = (apart > 0) & (apart < AHEAD) & falls
        left = jnp.where(nearer, apart / jnp.where(nearer, lost, 1.0), jnp.inf).astype(t1.dtype)
        fresh = jnp.where(falls, jnp.abs(moved) / jnp.where(falls, lost, 1.0), jnp.inf)
        # Rows that vanish as a power of the way do so the slower the nearer they are.
        stays = self.depends | (self.is_near & (jnp.sum(self.span) < jnp.sum(fresh)))
        span = jnp.where(stays, self.span, fresh)
        part = jnp.where(apart > 2 * LOST, 2 * LOST / jnp.where(apart > 0, apart, 1.0), 1.0)
        within = jnp.where(self.depends, self.within + part * jnp.linalg.norm(moved), 0.0)
        return Crossing(apart, within, span, t1 + (t1 - t0) * left)

    @property
    def depends(self) -> Bool[Array, ""]:
        """Whether rows depend on one another but for LOST."""
        return self.apart <= LOST

    @property
    def stands(self) -> Bool[Array, ""]:
        """Whether it is at the place, as accelerations and velocities tell it."""
        return self.apart <= unknown_below(self.apart.dtype)

    @property
    def passes(self) -> Bool[Array, ""]:
        """Whether they did so for as short a way as where ways cross."""
        return self.within <= LONGER * 2 * LOST * jnp.linalg.norm(self.span)

    @property
    def is_near(self) -> Bool[Array, ""]:
        """Whether a row has little apart from all others."""
        return self.apart < SHORT

    def is_beside(self, before: "Crossing") -> Bool[Array, ""]:
        """Whether it is all but at the place, and the step before started away from it."""
        return (self.apart < BESIDE * before.apart) & ~before.depends

    def rounding(
        self,
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        columns: Float[Array, "m n"],
        args: Arguments,
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """What rounding makes of coordinates and velocities that are projected here; else 0.

        A row is wrong by roundings of what it reads, and the projection moves coordinates by as
        much over what it has apart from others; velocities by that over the time to the place.

        Args:
            q: coordinates.
            v: velocities.
            columns: of the matrix of the projection.
            args: arguments of the step.
        """
        assert args.units is not None
        assert args.slopes is not None
        least = ROUNDINGS * float(jnp.finfo(self.apart.dtype).eps)
        span = jnp.where(jnp.isfinite(self.span), self.span, 0.0)
        length = jnp.linalg.norm(span)
        rate = jnp.linalg.norm(v / args.units) / jnp.where(length > 0, length, 1.0)
        slopes = args.slopes

        def spread(size: Array) -> Array:  # by sums: a step has no matrix products
            rows = jnp.sum(slopes * size, axis=1)
            return jnp.sum(jnp.abs(columns) * rows[:, None], axis=0)

        positions = jnp.abs(q) + spread(jnp.abs(q) + args.units * span)
        soon = rate / jnp.maximum(self.apart, float(jnp.finfo(self.apart.dtype).eps) ** (1 / 3))
        velocities = jnp.abs(v) + spread(jnp.abs(v)) + soon * positions
        near = jnp.where(self.is_near, least, 0.0)
        return near * positions, near * velocities

    def noise(
        self, v: Float[Array, " n"], args: Arguments
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """What single stages may differ by in changes of coordinates and of velocities; else 0.

        Those across the ways are not of the motion, and the projection removes what they do.

        Args:
            v: velocities.
            args: arguments of the step.
        """
        assert args.units is not None
        part = jnp.where(self.is_near, float(jnp.finfo(self.apart.dtype).eps) ** (1 / 3), 0.0)
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
        """A step no longer than h that has the place ahead between its stages, or leads up to it.

        What is saved within a step across is interpolated: that step is a short one. So is the
        last one of a motion that ends at the place. One that ends beyond it has its start where
        the place is between its stages.

        Args:
            t: where it starts.
            h: its length as proposed.
            gap: see `widest_gap`.
            stop: where the motion ends.
            due: the next save time.
        """
        left = jnp.asarray(self.time - t, h.dtype)
        ahead = (left > 0) & (left < h / AT_HAND)
        left = jnp.where(ahead, left, h)
        across, approach = left / gap, left - ROOM * gap * h
        near = ahead & self.is_near & (left > AT_HAND * h)
        found = jnp.where(near & (across > h), approach, jnp.where(near, across, h))
        # To a last step that has the place at `gap`, and to a short one.
        lead = left - gap / (1 - gap) * jnp.asarray(stop - self.time, h.dtype)
        cut = near & (stop > self.time) & (stop < t + across) & (lead > AT_HAND * left)
        found = jnp.where(cut, lead, found)
        least, ends = narrow(self.apart.dtype), self.is_at(t, stop)
        # In float32 steps are as short as need be: shorter ones add rounding.
        saved = ahead & (due < t + jnp.maximum(across, h)) & (least < SHORT)
        found = jnp.where(ends, h, jnp.where(saved & ~cut, across, found))
        part = 1.0 - jnp.maximum(least / jnp.where(ahead, self.apart.astype(h.dtype), 1.0), 0.1)
        found = jnp.where((saved | ends) & (part > AT_HAND), part * left, found)
        return jnp.minimum(found, h)

    def is_at(self, t: Float[Array, ""], time: Float[Array, ""] | float) -> Bool[Array, ""]:
        """Whether a time is that of the place ahead, but for a third of a narrow step.

        Args:
            t: now.
            time: the other one.
        """
        pace = (self.time - t) / self.apart.astype(self.time.dtype)
        close = narrow(self.apart.dtype) / 3
        return jnp.isfinite(self.time) & (pace > 0) & (jnp.abs(self.time - time) <= close * pace)


def unknown_below(dtype: Any) -> float:
    """Where so little of a row is left, over what there is at the start, rounding is the rest."""
    return min(2 * float(jnp.finfo(dtype).eps) ** (1 / 3), LOST)


def narrow(dtype: Any) -> float:
    """Of the same: where a step across begins in which states are saved, or the motion ends.

    A polynomial through its ends is off by its length to the power of 6, and rounding by eps over
    its square: 0.015 in float64, where both are 1e-12, and 0.1 in float32.
    """
    return min(1.35 * float(jnp.finfo(dtype).eps) ** (1 / 8), SHORT)


def no_crossing(time: Float[Array, ""], n: int, dtype: Any) -> Crossing:
    """What is known where a motion of n coordinates starts; times are of the dtype of `time`."""
    one, zero = jnp.ones((), dtype), jnp.zeros((), dtype)
    return Crossing(one, zero, jnp.full((n,), jnp.inf, dtype), jnp.full_like(time, jnp.inf))


def is_across(
    begin: Crossing, end: Crossing, saved: Crossing, sound: Bool[Array, ""]
) -> Bool[Array, ""]:
    """Whether what is saved within a step is to be interpolated.

    Where the step to it met a place, or where it lies at one, in a short step also near one.

    Args:
        begin: what is known at the start of the step.
        end: at its end.
        saved: at the end of a step to what is saved.
        sound: whether that went well.
    """
    at_it = saved.stands | (saved.depends & (begin.apart < 2 * narrow(begin.apart.dtype)))
    apart = jnp.minimum(jnp.minimum(begin.apart, end.apart), saved.apart)
    return at_it | (~sound & (apart < AHEAD))


def widest_gap(nodes: Sequence[float]) -> float:
    """The middle of the longest part of a step in which no stage lies."""
    places = np.unique(np.clip([0.0, *nodes, 1.0], 0.0, 1.0))
    middles, widths = 0.5 * (places[1:] + places[:-1]), np.diff(places)
    return float(middles[np.argmax(np.where(middles >= GAP, widths, 0.0))])


def lengths_of(masses: Float[Array, " m"], kept: Bool[Array, " m"] | None) -> Float[Array, " m"]:
    """1 / sqrt of effective masses: what rows have apart from all others, in the metric of M^-1.

    0 of rows that were left out as they depend on others, 1 of those that are not kept.
    """
    masses = jax.lax.stop_gradient(masses)
    lengths = jnp.where(masses > 0, jax.lax.rsqrt(jnp.where(masses > 0, masses, 1.0)), 0.0)
    lengths = jnp.where(jnp.isnan(masses), jnp.nan, lengths)
    return lengths if kept is None else jnp.where(kept, lengths, 1.0)


def scales_at(
    dynamics: VectorField, tau: Array, y: Array, args: Arguments
) -> tuple[Float[Array, " n"], Float[Array, "m n"]]:
    """Units of the coordinates in which their inertias at a state are 1, and |A| there."""
    t, q, v, params = dynamics.state(tau, y, args)
    A = dynamics.terms.rows(t, q, v, params)[0]
    return units_of(dynamics.mass(tau, y, args), A), jnp.abs(A)


def may_cross(dynamics: VectorField) -> bool:
    """Whether there are rows of which one may be left out for a moment.

    Beyond the place the state is moved back onto all of them. A force that reads multipliers is not
    known where these are not.
    """
    reads = any(map(reads_lam, dynamics.system.forces))
    return dynamics.projects and may_stop(dynamics) and not reads


def may_stop(dynamics: VectorField) -> bool:
    """Whether there are rows that accelerations are solved with."""
    return dynamics.quasi is None and dynamics.rows.size > 0


def same_sense(
    dynamics: VectorField,
    t0: Array,
    t1: Array,
    y0: Array,
    y1: Array,
    args: Arguments,
    turn: Array | None,
) -> Bool[Array, ""]:
    """Whether a step passes no change point: pivots of A(t) M^-1 A(t0)^T keep their signs.

    Looked at in the middle and at the end of the step, over what they are at its start, where that
    makes 1 of all of them. Ways that meet at one place change one sign each.

    Args:
        dynamics: what moves.
        t0: start of the step.
        t1: its end.
        y0: state at its start.
        y1: state at its end.
        args: arguments of the step.
        turn: h dy/dt at the start less that at the end; None where it is not known.
    """
    columns, m = dynamics.projector(t0, y0, args).columns, dynamics.rows.size
    assert columns is not None
    fine = jnp.array(True)
    for tau, y in (midway(t0, t1, y0, y1, turn), (t1, y1)):
        t, (q, v), (params, _) = dynamics.clock(tau, args), dynamics.parts(y), dynamics.given(args)
        A, _ = dynamics.terms.rows(t, q, v, params)
        turned = A @ columns.T
        if args.kept is not None:
            both = args.kept[:, None] & args.kept[None]
            turned = jnp.where(both, turned, jnp.eye(m, dtype=A.dtype))
        fine = fine & solve_general(turned, jnp.zeros((m,), A.dtype), 0.0)[1]
    return fine
