"""Growth of perturbations along a motion: exponent, condition number, horizon."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlag._core._result import AbstractResult
from jaxlag._core._status import Status

SURE = 3.0  # standard errors by which an exponent must exceed zero


class PerturbationGrowth(AbstractResult):
    """Growth of perturbations of a motion y = (q, v), Phi' = df/dy Phi along y' = f(t, y).

    Shapes are those of one motion of n coordinates at s times; after `jax.vmap` every array has
    the batch axes in front. All values are NaN if the status is not ok.

    Attributes:
        ts: (s,), s.
        transition: (s - 1, 2n, 2n), Phi(ts[i + 1], ts[i]) P(ts[i]) in (q, v), with P the orthogonal
            projector onto perturbations that the constraints allow; the identity without
            constraints.
        log_kappa: (s,), logarithm of `kappa`.
        log_norm: (s,), logarithm of |W(t)^-1 Phi(t, ts[0]) W(ts[0])|.
        exponent: largest Lyapunov exponent, 1/s.
        exponent_error: its standard error, 1/s.
        horizon: time after ts[0], s, beyond which a single gradient is meaningless; inf for never.
        rtol: of the weights W.
        atol: of the weights W.
        status: int32, see `Status`: ok, or that of the motion or of the segment that failed.
    """

    ts: Float[Array, "*batch s"]
    transition: Float[Array, "*batch s-1 m m"]
    log_kappa: Float[Array, "*batch s"]
    log_norm: Float[Array, "*batch s"]
    exponent: Float[Array, "*batch"]
    exponent_error: Float[Array, "*batch"]
    horizon: Float[Array, "*batch"]
    rtol: Float[Array, "*batch"]
    atol: Float[Array, "*batch"]
    status: Int[Array, "*batch"]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for a single motion."""
        return self.ts.shape[:-1]

    def __getitem__(self, index: Any) -> "PerturbationGrowth":
        """Results of a batch."""
        return self._select(index)

    @property
    def kappa(self) -> Float[Array, "*batch s"]:
        """Condition number (s,): the largest |W(t)^-1 Phi(t, s) W(s)| over save times s up to t.

        Infinite on overflow; see `log_kappa`.
        """
        return jnp.exp(self.log_kappa)

    @property
    def exponential(self) -> Bool[Array, "*batch"]:
        """Whether the exponent is positive by more than three standard errors."""
        return self.exponent > SURE * self.exponent_error

    def message(self) -> str:
        """The kind of growth along a single motion, and a remedy, as text."""
        self.require_single("message")
        status = Status(int(self.status))
        if status is not Status.ok:
            return f"{status.name}: the motion, or a segment of it, could not be computed."
        rate, error = float(self.exponent), float(self.exponent_error)
        exponent = f"largest Lyapunov exponent {rate:.4g} +- {error:.2g} 1/s"
        if self.exponential:
            kind = f"The growth is exponential: {exponent}"
        elif rate < -SURE * error:
            kind = f"The error decays: {exponent}"
        elif abs(rate) <= error:
            kind = (
                f"The error grows at most like a power of time: {exponent}, not significantly "
                "different from 0"
            )
        else:
            kind = f"The motion is too short to determine the growth: {exponent}"
        span, decades = abs(float(self.ts[-1] - self.ts[0])), float(self.log_kappa[-1]) / np.log(10)
        grown = f"{10**decades:.3g}" if decades < 300 else f"10^{decades:.0f}"
        text = (
            f"In {span:.6g} s an error of the state becomes at most {grown} times as large, "
            f"measured by atol + rtol |y|. {kind}."
        )
        horizon, tolerance = float(self.horizon), float(effective_rtol(self.rtol))
        if horizon == np.inf:
            return f"{text} A gradient along the whole motion is meaningful."
        beyond = ", beyond its end (extrapolated)," if horizon > span else ""
        return (
            f"{text} From {horizon:.4g} s after its start{beyond} an error of {tolerance:.1g} is "
            "as large as the state: there the motion and gradients along it are meaningless. Use "
            "segments well shorter than that (multiple shooting), or a loss that ends earlier."
        )

    def __str__(self) -> str:
        return self.message() if self.ts.ndim == 1 else repr(self)

    def __repr__(self) -> str:
        return f"PerturbationGrowth(exponent {self.exponent} 1/s, horizon {self.horizon} s)"


def effective_rtol(rtol: Array) -> Array:
    """At least the rounding of the dtype."""
    return jnp.maximum(rtol, jnp.finfo(rtol.dtype).eps)
