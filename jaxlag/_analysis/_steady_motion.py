"""A steady motion: the state, what is left of the equations, and whether they hold later."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlag._core._errors import shortened
from jaxlag._core._result import AbstractResult
from jaxlag._core._status import Status
from jaxlag._system._system import System


class SteadyMotion(AbstractResult):
    """A state (q, v) of a motion on which all independent velocities are constant.

    Shapes are those of one search; after `jax.vmap` every array has the batch axes in front.

    Attributes:
        system: the mechanical system.
        q: coordinates (n,), m or rad; the nearest point found if the status is not ok.
        v: velocities (n,), m/s or rad/s.
        inputs: values of the inputs and of the states of the system, by name; an argument for
            `jl.linearize`. Without those by `Feedback`.
        residual: (e,), rates of the independent velocities and of states, phi and A v + b: 0 in a
            steady motion.
        scale: (e,), sums of the sizes of their terms during the motion, plus what is rounding over
            the tolerance. The residual and the drift are small relative to it.
        drift: (e,), the largest residual during the motion that follows with constant independent
            velocities.
        status: int32, see `Status`: ok, implicit_solve_failed (also if `drift` is not small) or
            nonfinite.
        iterations: int32, steps of the search.
        equations: what the entries of `residual` are.
        independent: the independent coordinates, velocities and states.
    """

    system: System
    q: Float[Array, "*batch n"]
    v: Float[Array, "*batch n"]
    inputs: dict[str, Float[Array, "..."]]
    residual: Float[Array, "*batch e"]
    scale: Float[Array, "*batch e"]
    drift: Float[Array, "*batch e"]
    _causes: Int[Array, "*batch e"]  # coordinate of the largest part of the drift; -1 for time
    status: Int[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    equations: tuple[str, ...] = eqx.field(static=True)
    independent: tuple[str, ...] = eqx.field(static=True)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for a single motion."""
        return self.q.shape[:-1]

    def __getitem__(self, name: Any) -> Any:
        """A coordinate by its name, a velocity by its name with a prime; or those of a batch."""
        if not isinstance(name, str):
            return self._select(name)
        coordinates = self.system.coordinates
        if name.endswith("'"):
            return coordinates.part(self.v, name[:-1])
        return coordinates.part(self.q, name)

    def message(self) -> str:
        """How a single search ended, as text."""
        self.require_single("message")
        status = Status(int(self.status))
        state = f"q = {self.q}, v = {self.v}"
        if status is Status.ok:
            return shortened(f"ok at {state} after {int(self.iterations)} steps")
        if status is Status.nonfinite:
            return shortened(f"{status.name}: the equations are not finite at {state}.")
        worst, relative = _worst(self.residual, self.scale)
        if relative > STEADY[self.q.dtype.name]:
            return shortened(
                f"{status.name}: no steady motion was found. After {int(self.iterations)} steps "
                f"the nearest state was {state}; there the {self.equations[worst]} is "
                f"{float(self.residual[worst]):.6g}, {relative:.1e} of its terms. Choose a closer "
                "guess, make more names `free`, or name the velocities that are constant in "
                f"`independent`: they were {', '.join(self.independent)}."
            )
        worst, relative = _worst(self.drift, self.scale)
        if relative > STEADY[self.q.dtype.name]:
            cause, known = int(self._causes[worst]), f"At {state} all equations hold, but the"
            was = f"{self.equations[worst]} becomes {float(self.drift[worst]):.6g}"
            if cause < 0:
                how = f"{was} later. It depends on time."
            else:
                moves = self.system.coordinates.labels[cause]
                how = (
                    f"{was} as {moves!r} moves. Make the velocity of {moves!r} 0, or name "
                    f"other velocities in `independent`: they were {', '.join(self.independent)}."
                )
            return shortened(f"{status.name}: the motion is not steady. {known} {how}")
        return shortened(
            f"{status.name}: the search did not settle. After {int(self.iterations)} steps it was "
            f"at {state}. Choose a closer guess, or check whether the free names matter there."
        )


STEADY = {"float64": 1e-6, "float32": 2e-3}
"""Largest residual later in the motion, over the sum of the sizes of its terms."""


def _worst(residual: Array, scale: Array) -> tuple[int, float]:
    """Index of the largest residual over its scale, and this."""
    left, size = np.abs(residual), np.asarray(scale)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.divide(left, size, out=np.zeros_like(left), where=left != 0)
    worst = int(np.argmax(np.where(np.isfinite(relative), relative, np.inf)))
    return worst, float(relative[worst])
