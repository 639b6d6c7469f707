"""Multiple shooting: all segments are integrated as one batch; their residuals and derivatives.

Unknowns are the params, by z, and the state at the start of each segment, by x. Residuals are the
predicted minus the measured values, over sigma, and the end of each segment minus the start of the
next, over a sigma of its own. The latter sigma goes to zero from stage to stage. In early stages
segments follow the measurements even with wrong params. In the last stage they form one motion
(Bock, Recent advances in parameter identification techniques for ODE, 1983).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from jaxlag._core._batching import in_batches
from jaxlag._core._status import Status
from jaxlag._fit._bounded_least_squares import box_least_squares
from jaxlag._fit._free_parameters import SATURATED, Unknowns
from jaxlag._fit._linear_least_squares import LinearRows, condense, eliminate, sizes_of, states_of
from jaxlag._fit._residuals import Reader, read
from jaxlag._fit._segments import Segments
from jaxlag._simulation._simulate import simulate
from jaxlag._system._system import System

MOVED_AT_ONCE = 64
"""Segments times directions of derivatives in one batch: vectorized, and within a core's cache."""
AT_ONCE = 16
"""Motions without derivatives in one batch."""
FAR = 10.0
"""Residual of a segment without a solution, in multiples of the range of its channels."""
LARGEST_GAP = 1e4
"""Gap of such a segment to the next, over `join` times the range of the states: its square must
leave digits for the other terms of the sum."""


class FitVariables(NamedTuple):
    """The unknowns: z (p,) for the params, x (k, d) for the states, all of order one."""

    z: Float[Array, " p"]
    x: Float[Array, "k d"]


class Residuals(NamedTuple):
    """The residuals of the least squares.

    Attributes:
        measured: (k, s m + d): of the channels, and of approximately known starts.
        joined: (k, d), of ends and the following starts; None if none follow.
        prior: (c,), of params with a prior.
    """

    measured: Float[Array, "k m"]
    joined: Float[Array, "k d"] | None
    prior: Float[Array, " c"]


class SegmentOutputs(NamedTuple):
    """Results of the segments.

    Attributes:
        residuals: (k, s, m), over sigma, before the loss.
        ends: (k, d), states at their ends, m, rad, m/s, rad/s.
        status: (k,).
    """

    residuals: Float[Array, "k s m"]
    ends: Float[Array, "k d"]
    status: Array


class MultipleShooting(eqx.Module):
    """The multiple-shooting problem.

    Attributes:
        system: the mechanical system.
        options: options of `simulate`.
        channels: measured channels.
        widths: number of columns of each.
        loss: one of `LOSSES`, applied to the residuals.
        chained: whether any segment follows another.
        free: map from z to params.
        segments: the measurements.
        states: (d,), factor of x.
        ranges: (m,), ranges of the channels.
        prior: (which numbers, means, sigmas).
    """

    system: System = eqx.field(static=True)
    options: tuple[tuple[str, Any], ...] = eqx.field(static=True)
    channels: tuple[tuple[str, Reader], ...] = eqx.field(static=True)
    widths: tuple[int, ...] = eqx.field(static=True)
    loss: Callable[[Array], Array] = eqx.field(static=True)
    chained: bool = eqx.field(static=True)
    free: Unknowns
    segments: Segments
    states: Float[Array, " d"]
    ranges: Float[Array, " m"]
    prior: tuple[np.ndarray, np.ndarray, np.ndarray]

    def start(self, x: Float[Array, " d"], segment: Segments) -> Float[Array, " d"]:
        """The state (q, v) or (q, u) at the start of a segment."""
        return segment.guess + jnp.where(segment.held == 0, 0.0, self.states * x)

    def motion(self, params: Any, start: Float[Array, " d"], ts: Array, inputs: Any) -> Any:
        """The motion from a state."""
        n = self.system.size
        quasi = self.system.quasi
        if quasi is None:
            rates = {"v0": start[n:]}
        else:
            full = jnp.zeros(len(quasi.names), start.dtype).at[jnp.array(quasi.free)].set(start[n:])
            rates = {"v0": None, "u0": full}
        return simulate(
            self.system,
            start[:n],
            ts=ts,
            params=params,
            inputs=inputs,
            throw=False,
            **rates,
            **dict(self.options),
        )

    def one(
        self, z: Float[Array, " p"], x: Float[Array, " d"], segment: Segments
    ) -> tuple[Array, Array, Array]:
        """(residuals (s, m) before the loss, end state, status) of one segment."""
        start = self.start(x, segment)
        params = self.free.params(z)
        inputs = segment.inputs.at(params, segment.ts)
        motion = self.motion(params, start, segment.ts, inputs)
        shown = read(dict(self.channels), self.widths, motion)
        measured = segment.weights > 0
        known = jnp.all(jnp.isfinite(shown) | ~measured)
        ended = motion.raw_status
        status = jnp.where((ended == Status.ok) & ~known, Status.nonfinite, ended)
        ok = status == Status.ok
        residuals = segment.weights * (shown - segment.values)
        far = FAR * segment.weights * self.ranges[None]
        quasi = self.system.quasi
        rates = motion.v[-1] if quasi is None else motion.u[-1, jnp.array(quasi.free)]
        end = jnp.concatenate([motion.q[-1], rates])
        residuals = jnp.where(ok, residuals, far)
        end = jnp.where(ok, end, start)
        # Residuals of samples without measurements are set to 0, even if they are NaN.
        return jnp.where(measured, residuals, 0.0), end, status

    def linearized(self, guess: FitVariables) -> tuple[Any, Any]:
        """((residuals, ends, status), their derivatives by z and by the segment's own x)."""

        def both(z: Array, x: Array, segment: Segments) -> tuple[Any, Any]:
            residuals, end, status = self.one(z, x, segment)
            return (residuals, end), (residuals, end, status)

        derivatives = jax.jacfwd(both, argnums=(0, 1), has_aux=True)

        def one(segment: tuple[Array, Segments]) -> tuple[Any, Any]:
            return derivatives(guess.z, *segment)

        count, d = guess.x.shape
        at_once = max(1, MOVED_AT_ONCE // (guess.z.shape[0] + d))
        by, values = in_batches(one, (guess.x, self.segments), count, at_once)
        return values, by

    def __call__(self, guess: FitVariables, join: Float[Array, ""]) -> tuple[Residuals, Any]:
        """(residuals, segment outputs), written as their own linear expansion about `guess`.

        A segment is then differentiated by its own start only: in p + d directions, not p + k d.
        """
        here = jax.lax.stop_gradient(guess)
        (residuals, ends, status), by = self.linearized(here)
        (r_z, r_x), (e_z, e_x) = by
        dz, dx = guess.z - here.z, guess.x - here.x
        seen = SegmentOutputs(residuals, ends, status)
        residuals += r_z @ dz + jnp.einsum("ksmd,kd->ksm", r_x, dx)
        ends += e_z @ dz + jnp.einsum("ked,kd->ke", e_x, dx)
        return self.compared(guess, SegmentOutputs(residuals, ends, status), join), seen

    def compared(
        self, guess: FitVariables, seen: SegmentOutputs, join: Float[Array, ""]
    ) -> Residuals:
        """All residuals, from the segment outputs."""
        joined = None
        if self.chained:
            begins = jax.vmap(self.start)(guess.x, self.segments)
            joined = self.gaps(self.segments, seen, jnp.roll(begins, -1, axis=0), join)
        rows = self.weighed(guess.x, self.segments, seen.residuals)
        return Residuals(rows, joined, self.known(guess.z))

    def weighed(
        self, x: Float[Array, "k d"], segments: Segments, residuals: Float[Array, "k s m"]
    ) -> Float[Array, "k r"]:
        """Rows of the measurements after the loss, and of approximately known starts."""
        known = jnp.isfinite(segments.held) & (segments.held > 0)
        sigma = jnp.where(known, segments.held, 1.0)
        starts = jnp.where(known, x * self.states[None] / sigma, 0.0)
        return jnp.concatenate([self.loss(residuals).reshape(len(starts), -1), starts], axis=1)

    def gaps(
        self,
        segments: Segments,
        seen: SegmentOutputs,
        begins: Float[Array, "k d"],
        join: Float[Array, ""],
    ) -> Float[Array, "k d"]:
        """Ends minus the following starts, over `join` times the range of the states.

        A segment without a solution has no end: its gap is a large constant.
        """
        ok = (seen.status == Status.ok)[:, None]
        missing = jnp.minimum(FAR / join, LARGEST_GAP)
        gaps = jnp.where(ok, (seen.ends - begins) / (join * self.states), missing)
        return jnp.where(segments.follows[:, None], gaps, 0.0)

    def known(self, z: Float[Array, " p"]) -> Float[Array, " c"]:
        """Params minus their prior means, over the standard deviations."""
        which, mean, deviation = self.prior
        return (self.free.numbers(z)[jnp.asarray(which)] - mean) / deviation


# The optimizer: optimistix' Levenberg-Marquardt, its linear steps by elimination.


def rows_of(operator: lx.AbstractLinearOperator, residuals: Residuals) -> LinearRows:
    """The linear problem: the operator's columns by z, and by the states of all segments at once.

    A segment's measured rows contain its own state only. The rows that join it to the next also
    contain the next state, with a diagonal matrix. Segments of even and odd number are perturbed
    separately to distinguish the two.
    """
    guess = operator.in_structure()
    p, (k, d) = guess.z.shape[0], guess.x.shape
    dtype = guess.x.dtype
    nothing = FitVariables(jnp.zeros(p, dtype), jnp.zeros((k, d), dtype))
    by_z = jax.vmap(lambda z: operator.mv(nothing._replace(z=z)))(jnp.eye(p, dtype=dtype))

    def by_x(which: Array) -> Residuals:
        moves = jnp.where(which[:, None], jnp.eye(d, dtype=dtype)[:, None], 0.0)
        return jax.vmap(lambda x: operator.mv(nothing._replace(x=x)))(moves)

    def columns(x: Array, z: Array, right: Array) -> Array:
        x, z = jnp.moveaxis(x, 0, -1), jnp.moveaxis(z, 0, -1)
        return jnp.concatenate([x, z, right[..., None]], axis=-1)

    prior = jnp.concatenate([by_z.prior.T, residuals.prior[:, None]], axis=1)
    if residuals.joined is None:
        measured = by_x(jnp.ones(k, bool)).measured
        return LinearRows(columns(measured, by_z.measured, residuals.measured), None, None, prior)
    even = jnp.arange(k) % 2 == 0
    evens, odds = by_x(even), by_x(~even)
    assert evens.joined is not None
    assert odds.joined is not None
    own = jnp.where(even[:, None], evens.joined, odds.joined)
    after = jnp.where(even[:, None], odds.joined, evens.joined)
    return LinearRows(
        columns(evens.measured + odds.measured, by_z.measured, residuals.measured),
        columns(own, by_z.joined, residuals.joined),
        -jnp.diagonal(after, axis1=0, axis2=2),
        prior,
    )


class _Condensed(eqx.Module):
    """A linear problem, with weights and bounds of its params.

    Attributes:
        rows: condensed.
        weights: (p,), of the damping; None if all are 1.
        box: largest decrease and increase of each, (p,) each; None without bounds.
    """

    rows: LinearRows
    weights: Float[Array, " p"] | None
    box: tuple[Float[Array, " p"], Float[Array, " p"]] | None


class Eliminating(optx.AbstractDescent):
    """Steps -(J^T J + D / step_size)^-1 J^T r by elimination of states, linear in segments.

    D is 1, and less for unknowns whose effect on their numbers has decreased. It damps changes of
    numbers: otherwise a number on its way to a bound would take ever smaller steps.
    """

    shooting: MultipleShooting

    def init(self, y: FitVariables, f_info_struct: Any) -> _Condensed:
        """A state of the right shapes."""
        shapes = eqx.filter_eval_shape(self._condense, f_info_struct)
        rows = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        if self.shooting.free.plain:
            return _Condensed(rows, None, None)
        return _Condensed(rows, y.z, (y.z, y.z))

    def _condense(self, f_info: Any) -> LinearRows:
        return condense(rows_of(f_info.jac, f_info.residual))

    def query(self, y: FitVariables, f_info: Any, state: _Condensed) -> _Condensed:
        """The condensed problem of new derivatives."""
        free, rows = self.shooting.free, self._condense(f_info)
        if free.plain:
            return _Condensed(rows, None, None)
        speeds, p = free.speeds(y.z), y.z.shape[0]
        idle = (speeds <= SATURATED) & (sizes_of(rows)[-p - 1 : -1] <= SATURATED)
        reach = jnp.where(idle, 0.0, free.reach)
        down, up = jnp.maximum(-reach, free.low - y.z), jnp.minimum(reach, free.high - y.z)
        return _Condensed(rows, jnp.minimum(speeds, 1.0), (down, up))

    def step(self, step_size: Array, state: _Condensed) -> tuple[FitVariables, optx.RESULTS]:
        """The step for a step size: the optimum within the bounds of the params."""
        left = eliminate(state.rows, 1.0 / step_size, state.weights)
        factor, right = left.params[:-1, :-1], left.params[:-1, -1]
        if state.box is None:
            z = solve_triangular(factor, -right)
        else:
            z = box_least_squares(factor, -right, *state.box)
        return FitVariables(z, -states_of(left, -z)), optx.RESULTS.successful


class Shooter(optx.AbstractGaussNewton):
    """Levenberg-Marquardt by `Eliminating`."""

    rtol: Array
    atol: Array
    norm: Callable[[Any], Array]
    descent: Eliminating
    search: optx.ClassicalTrustRegion
    verbose: Callable[..., None]

    def __init__(self, shooting: MultipleShooting, rtol: Array, atol: Array) -> None:
        self.rtol, self.atol, self.norm = rtol, atol, optx.max_norm
        self.descent = Eliminating(shooting)
        self.search = optx.ClassicalTrustRegion()
        self.verbose = _quiet


def _quiet(**_: Any) -> None:
    """Do not print."""


class SearchResult(NamedTuple):
    """The end of a search.

    Attributes:
        guess: the unknowns.
        converged: whether it met its tolerance.
        steps: number of steps; in least squares each is a solve of all segments with derivatives.
        cost: half the sum of squares.
        rows: condensed, of the linear problem there; None if not requested.
        seen: segment outputs there.
        starts: (k, d), states at the starts, m, rad, m/s, rad/s.
    """

    guess: FitVariables
    converged: Bool[Array, ""]
    steps: Array
    cost: Float[Array, ""]
    rows: LinearRows | None
    seen: SegmentOutputs
    starts: Float[Array, "k d"]


@eqx.filter_jit
def search(
    shooting: MultipleShooting, guess: FitVariables, join: Array, tolerances: Array, max_steps: int
) -> SearchResult:
    """Least squares from a guess, with gaps of `join` times the range of the states.

    Converged to (rtol, atol).
    """

    def function(
        guess: FitVariables, args: tuple[MultipleShooting, Array]
    ) -> tuple[Residuals, Any]:
        shooting, join = args
        return shooting(guess, join)

    solution = optx.least_squares(
        function,
        Shooter(shooting, tolerances[0], tolerances[1]),
        guess,
        args=(shooting, join),
        has_aux=True,
        max_steps=max_steps,
        throw=False,
    )
    # The optimizer's values at the last accepted point; no further solve.
    state = solution.state
    return SearchResult(
        solution.value,
        solution.result == optx.RESULTS.successful,
        solution.stats["num_steps"],
        0.5 * optx.two_norm(state.f_info.residual) ** 2,
        state.descent_state.rows,
        state.aux,
        jax.vmap(shooting.start)(solution.value.x, shooting.segments),
    )


@eqx.filter_jit
def moved(shooting: MultipleShooting, guess: FitVariables) -> SegmentOutputs:
    """Segment outputs without derivatives."""

    def one(segment: tuple[Array, Segments]) -> tuple[Array, Array, Array]:
        return shooting.one(guess.z, *segment)

    count = guess.x.shape[0]
    return SegmentOutputs(*in_batches(one, (guess.x, shooting.segments), count, AT_ONCE))


@eqx.filter_jit
def judged(
    shooting: MultipleShooting, guess: FitVariables, join: Array, linear: bool
) -> tuple[Float[Array, ""], LinearRows | None, SegmentOutputs, Float[Array, "k d"]]:
    """(cost, the condensed linear problem, segment outputs, starts) at a guess.

    Args:
        shooting: the problem.
        guess: the unknowns.
        join: of the gaps.
        linear: whether to take derivatives; without them there is no linear problem.
    """
    starts = jax.vmap(shooting.start)(guess.x, shooting.segments)
    if linear:
        residuals, by, seen = jax.linearize(lambda x: shooting(x, join), guess, has_aux=True)
        operator = lx.FunctionLinearOperator(by, jax.eval_shape(lambda: guess))
        rows = condense(rows_of(operator, residuals))
    else:
        rows, seen = None, moved(shooting, guess)
    residuals = shooting.compared(guess, seen, join)
    return 0.5 * optx.two_norm(residuals) ** 2, rows, seen, starts
