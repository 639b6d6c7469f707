"""The chord method for the stages of implicit methods, converged relative to dy/dt."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, final

import equinox as eqx
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

LONG = 200
"""Lines of dy/dt from which its Jacobian is computed once in a step.

Chains of pendulums to 1e-7, once in a step | in every stage: 85 lines 3.5 | 2.9 ms, 157 lines 4.2 |
4.5 ms, 350 lines 9.0 | 13.8 ms.
"""

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
    """The chord method, with the Jacobian at the first guess of a stage or at that of a step.

    The unknown of a stage is f = dy/dt (or h f), and its equation f - f(t, y + a h f) = 0 is in the
    same units. Iterations end when rms(increment / s) < 1 and rms(residual / s) < 1 with the scale
    s_i = atol_i + rtol |f_i|. If increments no longer decrease, they are rounding: then
    s_i = max(atol_i, 10 eps rms(f)) + rtol |f_i| suffices. `optimistix.Chord` compares the residual
    with atol alone, which is below its rounding if accelerations are large: 1e-6 of 10 m/s^2 in
    float32.

    Jacobians that take long are computed once in a step. One is recomputed, for the rest of that
    stage, if increments at the rate of the last two would not fall below their bound within `AHEAD`
    further iterations. diffrax's chord method gives up instead, and the step is rejected.

    Attributes:
        rtol: relative bound.
        atol: absolute bound; a number, or one for each component.
        norm: of a vector.
        per_step: whether all stages of a step share a Jacobian.
    """

    rtol: Any
    atol: Any
    norm: Callable = optimistix.rms_norm
    per_step: bool = eqx.field(static=True, default=False)

    def init(
        self, fn: Any, y: Array, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> ChordState:
        """The state before the first iteration.

        diffrax asks for a state before the stages of a step, and passes it to each of them as
        `options["init_state"]`.
        """
        del f_struct, aux_struct, tags
        shared, a = options.get("init_state"), _diagonal(args)
        if self.per_step and shared is not None:
            return shared
        one = jnp.eye(y.size, dtype=y.dtype), jnp.arange(y.size, dtype=jnp.int32)
        if shared is not None or a is None:
            factor = _factor(fn, y, args)
        elif self.per_step:
            needed = eqxi.unvmap_any(a != 0.0)
            factor = jax.lax.cond(needed, lambda: _factor(fn, y, args), lambda: one)
        else:
            factor = one  # of no stage
        none, infinite = jnp.zeros((), jnp.int32), jnp.full_like(y, jnp.inf)
        size = jnp.full((), jnp.inf, y.dtype)
        return ChordState(jax.lax.stop_gradient(factor), none, none, infinite, infinite, size, size)

    def step(
        self, fn: Any, y: Array, args: Any, options: Any, state: ChordState, tags: Any
    ) -> tuple[Array, ChordState, Any]:
        """One iteration, and a new Jacobian if that of the step is too old."""
        del options
        f, aux = fn(y, args)
        change = lu_solve(state.factor, f)
        y = y - change
        size, used = self.norm(change / (self.atol + self.rtol * jnp.abs(y))), state.used + 1
        new = ChordState(state.factor, used, state.count + 1, f, change, size, state.size)
        if not self.per_step:
            return y, new, aux
        ended, _ = self.terminate(fn, y, args, {}, new, tags)
        slow = ~ended & (used >= 2) & (size * (size / state.size) ** AHEAD > 1.0)
        recomputed = jax.lax.cond(
            eqxi.unvmap_any(slow), lambda: _factor(fn, y, args), lambda: state.factor
        )
        recomputed = jax.lax.stop_gradient(recomputed)
        factor = jax.tree.map(lambda a, b: jnp.where(slow, a, b), recomputed, state.factor)
        return y, new._replace(factor=factor, used=jnp.where(slow, 0, used)), aux

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
        failed = (state.count >= 1) & ~jnp.all(jnp.isfinite(state.change))
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


def for_long_code(solver: Any, lines: int | None) -> Any:
    """The solver with one Jacobian in a step, if `StageChord` solves its equations.

    Args:
        solver: of diffrax.
        lines: number of lines of code for dy/dt; None if it is not such code.
    """
    short = lines is None or lines <= LONG
    if short or not isinstance(getattr(solver, "root_finder", None), StageChord):
        return solver
    return eqx.tree_at(lambda s: s.root_finder, solver, replace(solver.root_finder, per_step=True))


def _factor(fn: Callable, y: Array, args: Any) -> Factor:
    """LU factors of the Jacobian."""
    return lu_factor(jax.jacfwd(lambda y: fn(y, args)[0])(y))


def _diagonal(args: Any) -> Any:
    """The coefficient a of a stage f = f(t, y + a h f); None if it is not known.

    diffrax passes (stage, a, ...) to the equations of its Runge-Kutta methods. Before the first
    stage it asks for the Jacobian with a = 0, which is 1.
    """
    of_stage = isinstance(args, tuple) and len(args) in (7, 8) and not callable(args[0])
    return args[1] if of_stage else None
