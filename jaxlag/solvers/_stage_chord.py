"""The chord method for the stages of implicit methods, converged relative to dy/dt."""

from collections.abc import Callable
from typing import Any, NamedTuple, final

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Array, Bool, Float, Int

ROUNDINGS = 10.0
"""Rounding of a component of dy/dt, in eps times the root mean square of all."""

AHEAD = 3
"""A Jacobian is kept if it is expected to end the iterations within so many."""

Factor = tuple[Float[Array, "m m"], Int[Array, " m"]]


class ChordState(NamedTuple):
    """State of the iterations.

    Attributes:
        factor: LU factors of the Jacobian.
        used: number of iterations with it.
        count: number of iterations.
        f: residual before the last one.
        change: increment of the last one.
        size: norm of the increment relative to the bounds.
        before: the same of the iteration before.
    """

    factor: Factor
    used: Int[Array, ""]
    count: Int[Array, ""]
    f: Float[Array, " m"]
    change: Float[Array, " m"]
    size: Float[Array, ""]
    before: Float[Array, ""]


@final
class StageChord(optimistix.AbstractRootFinder):
    """Newton's method whose Jacobian is kept for all stages of a step, unless it converges slowly.

    The unknown of a stage is f = dy/dt (or h f), and its equation f - f(t, y + a h f) = 0 is in the
    same units. Iterations end when rms(increment / s) < 1 and rms(residual / s) < 1 with the scale
    s_i = atol_i + rtol |f_i|. If increments no longer decrease, they are rounding: then
    s_i = max(atol_i, 10 eps rms(f)) + rtol |f_i| suffices. `optimistix.Chord` compares the residual
    with atol alone, which is below its rounding if accelerations are large: 1e-6 of 10 m/s^2 in
    float32.

    The Jacobian is recomputed if increments, at the rate of the last two, would not fall below
    their bound within `AHEAD` further iterations. diffrax's chord method gives up instead, and the
    step is rejected.

    Attributes:
        rtol: relative bound.
        atol: absolute bound; a number, or one for each component.
        norm: of a vector.
    """

    rtol: Any
    atol: Any
    norm: Callable = optimistix.rms_norm

    def init(
        self, fn: Any, y: Array, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> ChordState:
        """The state before the first iteration.

        It is `options["init_state"]` if that is given, as diffrax does for the stages of a step. A
        guess of 0 gets the Jacobian 1: diffrax starts its loop over stages with one for a step of
        0, and never uses it.
        """
        del f_struct, aux_struct, tags
        if "init_state" in options:
            return options["init_state"]
        moves, one = jnp.any(y != 0.0), jnp.eye(y.size, dtype=y.dtype)
        needed = eqxi.unvmap_any(moves)
        J = jax.lax.cond(needed, lambda: _jacobian(fn, y, args), lambda: one)
        none, infinite = jnp.zeros((), jnp.int32), jnp.full_like(y, jnp.inf)
        factor = jax.lax.stop_gradient(lu_factor(jnp.where(moves, J, one)))
        size = jnp.full((), jnp.inf, y.dtype)
        return ChordState(factor, none, none, infinite, infinite, size, size)

    def step(
        self, fn: Any, y: Array, args: Any, options: Any, state: ChordState, tags: Any
    ) -> tuple[Array, ChordState, Any]:
        """One iteration, and a new Jacobian if the one in use is too old."""
        del options, tags
        f, aux = fn(y, args)
        change = lu_solve(state.factor, f)
        y = y - change
        size, used = self.norm(change / (self.atol + self.rtol * jnp.abs(y))), state.used + 1
        slow = (used >= 2) & (size * (size / state.size) ** AHEAD > 1.0)
        recomputed = jax.lax.cond(
            eqxi.unvmap_any(slow),
            lambda: lu_factor(_jacobian(fn, y, args)),
            lambda: state.factor,
        )
        new = jax.lax.stop_gradient(recomputed)
        factor = jax.tree.map(lambda a, b: jnp.where(slow, a, b), new, state.factor)
        used = jnp.where(slow, 0, used)
        return y, ChordState(factor, used, state.count + 1, f, change, size, state.size), aux

    def terminate(
        self, fn: Any, y: Array, args: Any, options: Any, state: ChordState, tags: Any
    ) -> tuple[Bool[Array, ""], optimistix.RESULTS]:
        """(whether it has converged or failed, optimistix's result)."""
        del fn, args, options, tags
        rounding = ROUNDINGS * jnp.finfo(y.dtype).eps * optimistix.rms_norm(y)
        relative = self.rtol * jnp.abs(y)

        def small(scale: Array) -> Bool[Array, ""]:
            return (self.norm(state.change / scale) < 1) & (self.norm(state.f / scale) < 1)

        stalled = (state.count >= 2) & ~(state.size < state.before)
        rounded = stalled & small(jnp.maximum(self.atol, rounding) + relative)
        failed = (state.count >= 1) & ~jnp.isfinite(state.size)
        results = optimistix.RESULTS
        result = results.where(failed, results.nonlinear_divergence, results.successful)
        return small(self.atol + relative) | rounded | failed, result

    def postprocess(
        self,
        fn: Any,
        y: Array,
        aux: Any,
        args: Any,
        options: Any,
        state: Any,
        tags: Any,
        result: Any,
    ) -> tuple[Array, Any, dict[str, Any]]:
        """Nothing."""
        del fn, args, options, state, tags, result
        return y, aux, {}


def _jacobian(fn: Callable, y: Array, args: Any) -> Float[Array, "m m"]:
    return jax.jacfwd(lambda y: fn(y, args)[0])(y)
