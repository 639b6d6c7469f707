"""Whether a step passes a place where v does not follow from u, or u not from v."""

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._integration._step_arguments import Arguments, midway
from jaxlag._integration._vector_field import VectorField
from jaxlag._lowering import State

PART = 0.5  # of the least of three samples
SPREAD = 8.0  # of samples within one step
BESIDE = 0.125  # of an adaptive step, before its start and beyond its end
BESIDE_FIXED = 0.5  # where no error control shortens steps near such a place
LOST = 200.0  # tolerances: what rounding of u may make of v, but for a small factor
NEAR = 0.01  # of a radian, or another unit of the coordinates


class Passage(NamedTuple):
    """What is to be said about a step of quasi-velocities.

    Attributes:
        regular: v and u follow from one another all along it, to the digits that are asked for.
        share: of errors of u what those of v are at least, beside the start of the motion; at
            most 1.
        last: determinants at its end.
    """

    regular: Bool[Array, ""]
    share: Float[Array, ""]
    last: Float[Array, " b"]


def passage(
    dynamics: VectorField,
    tolerance: Array | None,
    t0: Array,
    t1: Array,
    y0: Float[Array, " m"],
    y1: Float[Array, " m"],
    args: Arguments,
    turn: Float[Array, " m"] | None,
    first: Float[Array, " b"],
) -> Passage:
    """What becomes of v and u along a step.

    Near a place where dU/dv loses rank an error of u is one of v by as much larger as the
    determinant is smaller than elsewhere: the error of a step is bounded by that `share` of the
    tolerance, as far as rounding lets it: what rates are rough by, eps over that share, is left to
    it. Where that makes more of v than `LOST` tolerances, the motion ends:

        det / (det at the start) < sqrt(eps / (200 tol)) = 1e-3, 3e-5, 1e-6, 3e-8

    for tolerances of 1e-12, 1e-9, 1e-6, 1e-3. Measured along a weight cos(y), errors of v are up
    to there within 800 tolerances, and 12 at a tenth of a radian.

    Args:
        dynamics: what moves.
        tolerance: bound on local errors; None with fixed steps.
        t0: start of the step.
        t1: its end.
        y0: state at its start.
        y1: state at its end.
        args: arguments of the step.
        turn: h dy/dt at the start less that at the end; None where it is not known.
        first: determinants at its start.
    """
    assert args.usual is not None
    states = (midway(t0, t1, y0, y1, turn), (t1, y1))
    between, last = (determinants(dynamics, tau, dynamics.parts(y)[0], args) for tau, y in states)
    left = jnp.min(opening(dynamics, last) / args.usual)
    eps = float(jnp.finfo(y1.dtype).eps)
    least, share, beside = 64 * eps, jnp.ones_like(left), BESIDE_FIXED
    if tolerance is not None:
        rounding = eps / jnp.where(tolerance > 0, tolerance, eps)
        least, beside = jnp.maximum(least, jnp.sqrt(rounding / LOST)), BESIDE
        share = jnp.minimum(jnp.maximum(left, rounding / jnp.maximum(left, least)), 1.0)
    return Passage(resolved(first, between, last, beside) & (left > least), share, last)


def determinants(
    dynamics: VectorField, tau: Array, q: Float[Array, " n"], args: Arguments
) -> Float[Array, " b"]:
    """What is 0 or infinite where quasi-velocities are singular.

    Determinants of the blocks of dU/dv, or of dv/du where that is given, without those that do not
    change, where there is a scalar program of them.
    """
    t, (params, _) = dynamics.clock(tau, args), dynamics.given(args)
    values = dynamics.inputs_at(tau, q, jnp.zeros_like(q), args)
    state = State(t, q, q, params, values)  # no speed is read
    return dynamics.program.determinants(state, args.constants)


def opening(dynamics: VectorField, found: Float[Array, " b"]) -> Float[Array, " b"]:
    """How large dU/dv is, by its determinants, or by those of its inverse where that is given."""
    quasi = dynamics.quasi
    assert quasi is not None
    size = jnp.abs(found)
    if quasi.U is not None:
        return size
    return 1.0 / (size if quasi.size == dynamics.system.size else jnp.sqrt(size))


def usual(
    dynamics: VectorField, tau: Array, q: Float[Array, " n"], args: Arguments
) -> Array | None:
    """How large dU/dv is at the start of a motion, or near it where that lies close to a zero.

    None where its determinants never change.
    """
    assert dynamics.quasi is not None
    here = determinants(dynamics, tau, q, args)
    if not here.size:
        return None
    at = np.arange(q.shape[0])
    ways = float(jnp.finfo(q.dtype).eps) ** 0.25 * np.array([(-1.0) ** at, (-1.0) ** (at // 2)])
    size = own = opening(dynamics, here)
    for way in ways:
        beside = determinants(dynamics, tau, q + jnp.asarray(way, q.dtype), args)
        grown = jnp.abs(opening(dynamics, beside) - own) / float(np.abs(way[0]))
        size = jnp.maximum(size, jnp.where(jnp.isfinite(grown), NEAR * grown, 0.0))
    return size


def resolved(
    first: Float[Array, " b"],
    middle: Float[Array, " b"],
    last: Float[Array, " b"],
    beside: float = BESIDE,
) -> Bool[Array, ""]:
    """Whether determinants stay away from 0, and from infinity, within a step and close beside it.

    The parabola through three samples of one sign, and that through their reciprocals, may not
    fall below half the least of them, from a part `beside` of the step before its start to one
    beyond its end. So none has a zero there, be it crossed once or twice or touched: a parabola
    through samples of (tau - s)^2 is that. A zero of first order is two such parts of the step
    away; what grows exponentially may do so by a factor of 8 in a step.

    Args:
        first: determinants at the start of a step; the blocks of dU/dv, or of dv/du.
        middle: in its middle.
        last: at its end.
        beside: parts of the step.
    """
    scale = 1.0 / middle
    a, c = first * scale, last * scale
    one_sign = jnp.all((a > 0) & (c > 0))
    least, most = (
        reduce(extreme, (a, c), jnp.ones_like(a)) for extreme in (jnp.minimum, jnp.maximum)
    )
    fine = _above(a, 1.0, c, beside) & _above(c, a * c, a, beside) & (most <= SPREAD * least)
    return one_sign & jnp.all(fine)


def _above(a: Array, b: Array | float, c: Array, beside: float) -> Array:
    """Whether the parabola through (0, a), (1/2, b), (1, c) stays above a part of the least."""
    bend = 2.0 * (a - 2.0 * b + c)
    slope = c - a - bend
    low = PART * jnp.minimum(jnp.minimum(a, b), c)

    def at(tau: float) -> Array:
        return a + tau * (slope + tau * bend)

    # Its vertex, at -slope / (2 bend), has the value a - slope^2 / (4 bend).
    within = (2.0 * beside * bend >= slope) & (-slope <= 2.0 * (1.0 + beside) * bend)
    deep = within & (slope * slope > 4.0 * bend * (a - low))
    return (at(-beside) >= low) & (at(1.0 + beside) >= low) & ~deep
