"""Detection of singular quasi-velocities within a step: dU/dv or dv/du loses rank."""

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._integration._step_arguments import Arguments, midway
from jaxlag._integration._vector_field import VectorField
from jaxlag._lowering import State

PART = 0.5  # lower bound of the parabola, over the least of three samples
SPREAD = 8.0  # largest ratio of samples within one step
BESIDE = 0.125  # margin before and after an adaptive step, over its length
BESIDE_FIXED = 0.5  # the same for fixed steps, which no error control shortens
LOST = 200.0  # error of v by rounding of u, in tolerances, at which a motion ends; up to a factor
NEAR = 0.01  # rad, or another unit of the coordinates


class Passage(NamedTuple):
    """Result of the check of quasi-velocities along a step.

    Attributes:
        regular: v and u determine each other along the whole step, to the digits required.
        share: fraction of the tolerance that bounds errors of u; at most 1.
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
    slope_drop: Float[Array, " m"] | None,
    first: Float[Array, " b"],
) -> Passage:
    """Check whether quasi-velocities become singular along a step.

    Near a place where dU/dv loses rank, errors of u are larger in v, by the usual determinant over
    the present one. The error of a step is therefore bounded by a `share` of the tolerance. The
    bound includes the rounding of rates, eps over that share. If rounding makes an error of v of
    more than `LOST` tolerances, the motion ends:

        det / (det at the start) < sqrt(eps / (200 tol)) = 1e-3, 3e-5, 1e-6, 3e-8

    for tolerances of 1e-12, 1e-9, 1e-6, 1e-3. Measured along a weight cos(y), errors of v are up
    to there within 800 tolerances, and 12 at a tenth of a radian.

    Args:
        dynamics: the vector field.
        tolerance: bound on local errors; None with fixed steps.
        t0: start of the step.
        t1: its end.
        y0: state at its start.
        y1: state at its end.
        args: arguments of the step.
        slope_drop: h dy/dt at the start minus that at the end; None if it is unknown.
        first: determinants at its start.
    """
    assert args.usual is not None
    states = (midway(t0, t1, y0, y1, slope_drop), (t1, y1))
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
    """Determinants that are 0 or infinite where quasi-velocities are singular.

    They are those of the blocks of dU/dv, or of dv/du if that is given. A scalar program leaves out
    constant ones.
    """
    t, (params, _) = dynamics.clock(tau, args), dynamics.given(args)
    values = dynamics.shapes_of_inputs(q, args)
    state = State(t, q, q, params, values)  # no speed is read
    return dynamics.program.determinants(state, args.constants)


def opening(dynamics: VectorField, found: Float[Array, " b"]) -> Float[Array, " b"]:
    """The magnitude of dU/dv, from its determinants or from those of its inverse if given."""
    quasi = dynamics.quasi
    assert quasi is not None
    size = jnp.abs(found)
    if quasi.U is not None:
        return size
    return 1.0 / (size if quasi.size == dynamics.system.size else jnp.sqrt(size))


def usual(
    dynamics: VectorField, tau: Array, q: Float[Array, " n"], args: Arguments
) -> Array | None:
    """The magnitude of dU/dv at the start of a motion, or near it if it is almost zero there.

    None if its determinants are constant.
    """
    assert dynamics.quasi is not None
    here = determinants(dynamics, tau, q, args)
    if not here.size:
        return None
    at = np.arange(q.shape[0])
    ways = float(jnp.finfo(q.dtype).eps) ** 0.25 * np.array([(-1.0) ** at, (-1.0) ** (at // 2)])
    size = at_q = opening(dynamics, here)
    for way in ways:
        beside = determinants(dynamics, tau, q + jnp.asarray(way, q.dtype), args)
        grown = jnp.abs(opening(dynamics, beside) - at_q) / float(np.abs(way[0]))
        size = jnp.maximum(size, jnp.where(jnp.isfinite(grown), NEAR * grown, 0.0))
    return size


def resolved(
    first: Float[Array, " b"],
    middle: Float[Array, " b"],
    last: Float[Array, " b"],
    beside: float = BESIDE,
) -> Bool[Array, ""]:
    """Whether determinants stay away from 0 and from infinity within a step and close beside it.

    The parabola through three samples of one sign, and that through their reciprocals, must not
    fall below half the least of them. The interval is the step with a margin at both ends, a part
    `beside` of the step. So no determinant has a zero there, whether it is crossed once, crossed
    twice or touched: (tau - s)^2 is such a parabola. A zero of first order is two such parts of the
    step away. Exponential growth may reach a factor of 8 in a step.

    Args:
        first: determinants at the start of a step; the blocks of dU/dv, or of dv/du.
        middle: in its middle.
        last: at its end.
        beside: margin at both ends, over the step.
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
    """Whether the parabola through (0, a), (1/2, b), (1, c) stays above PART of the least."""
    bend = 2.0 * (a - 2.0 * b + c)
    slope = c - a - bend
    low = PART * jnp.minimum(jnp.minimum(a, b), c)

    def at(tau: float) -> Array:
        return a + tau * (slope + tau * bend)

    # Its vertex, at -slope / (2 bend), has the value a - slope^2 / (4 bend).
    within = (2.0 * beside * bend >= slope) & (-slope <= 2.0 * (1.0 + beside) * bend)
    deep = within & (slope * slope > 4.0 * bend * (a - low))
    return (at(-beside) >= low) & (at(1.0 + beside) >= low) & ~deep
