"""The chord method for the stages of implicit methods, converged relative to dy/dt."""

from collections.abc import Callable
from typing import Any, final

import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool

ROUNDINGS = 10.0
"""Rounding of a component of dy/dt, in eps times the root mean square of all."""


@final
class StageChord(optimistix.AbstractRootFinder):
    """optimistix's chord method with another end: both the increment and the residual are small.

    The unknown of a stage is f = dy/dt (or h f), and its equation f - f(t, y + a h f) = 0 is in the
    same units. Iterations end when rms(increment / s) < 1 and rms(residual / s) < 1 with the scale
    s_i = atol_i + rtol |f_i|. If increments no longer decrease, they are rounding: then
    s_i = max(atol_i, 10 eps rms(f)) + rtol |f_i| suffices. `optimistix.Chord` compares the residual
    with atol alone, which is below its rounding if accelerations are large: 1e-6 of 10 m/s^2 in
    float32.

    Attributes:
        rtol: relative bound.
        atol: absolute bound; a number, or one for each component.
        norm: of a vector.
    """

    rtol: Any
    atol: Any
    norm: Callable = optimistix.rms_norm

    @property
    def _chord(self) -> optimistix.Chord:
        return optimistix.Chord(self.rtol, self.atol, self.norm)

    def init(self, *args: Any, **kwargs: Any) -> Any:
        """As optimistix's: the Jacobian at the first guess."""
        return self._chord.init(*args, **kwargs)

    def step(self, *args: Any, **kwargs: Any) -> Any:
        """As optimistix's: one iteration with that Jacobian."""
        return self._chord.step(*args, **kwargs)

    def terminate(
        self, fn: Any, y: Array, args: Any, options: Any, state: Any, tags: Any
    ) -> tuple[Bool[Array, ""], optimistix.RESULTS]:
        """(whether it has converged or failed, optimistix's result)."""
        del fn, args, options, tags
        rounding = ROUNDINGS * jnp.finfo(y.dtype).eps * optimistix.rms_norm(y)
        relative = self.rtol * jnp.abs(y)

        def small(scale: Array) -> Bool[Array, ""]:
            return (self.norm(state.diff / scale) < 1) & (self.norm(state.f / scale) < 1)

        stalled = (state.step >= 2) & ~(state.diffsize < state.diffsize_prev)
        rounded = stalled & small(jnp.maximum(self.atol, rounding) + relative)
        ended = small(self.atol + relative) | rounded
        return ended | (state.result != optimistix.RESULTS.successful), state.result

    def postprocess(self, *args: Any, **kwargs: Any) -> Any:
        """As optimistix's: nothing."""
        return self._chord.postprocess(*args, **kwargs)
