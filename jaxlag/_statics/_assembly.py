"""Assembly: a consistent state, its residuals and its independent rows."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlag._core._errors import shortened
from jaxlag._core._result import AbstractResult
from jaxlag._core._status import Status
from jaxlag._model._constraints import ConstraintRows
from jaxlag._system._system import System


class Assembly(AbstractResult):
    """A state (q, v) near a guess, and its constraint residuals.

    Attributes:
        system: the mechanical system.
        q: coordinates (n,), m or rad.
        v: velocities (n,), m/s or rad/s.
        position_residual: phi(t, q) of the holonomic rows, (k,).
        velocity_residual: A v + b of all rows, (m,).
        independent: (m,), a largest set of independent rows; the others follow from these.
        status: int32, see `Status`: ok, contradictory_rows or nonfinite.
        where: index of the row with the largest residual, -1 if the status is ok.
    """

    system: System
    q: Float[Array, "*batch n"]
    v: Float[Array, "*batch n"]
    position_residual: Float[Array, "*batch k"]
    velocity_residual: Float[Array, "*batch m"]
    independent: Bool[Array, "*batch m"]
    status: Int[Array, "*batch"]
    where: Int[Array, "*batch"]
    _rows: ConstraintRows = eqx.field(static=True)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for a single assembly."""
        return self.q.shape[:-1]

    def __getitem__(self, index: Any) -> "Assembly":
        """Assemblies of a batch."""
        return self._select(index)

    @property
    def rank(self) -> Int[Array, "*batch"]:
        """Number of independent rows."""
        return jnp.sum(self.independent, axis=-1, dtype=jnp.int32)

    @property
    def dependent(self) -> tuple[str, ...]:
        """Names of the rows that depend on the others, for a single assembly."""
        self.require_single("dependent")
        return tuple(
            name
            for name, independent in zip(self._rows.labels, self.independent, strict=True)
            if not independent
        )

    def message(self) -> str:
        """How a single assembly ended, as text."""
        self.require_single("message")
        status = Status(int(self.status))
        if status is Status.ok:
            more = f"; dependent rows: {', '.join(self.dependent)}" if self.dependent else ""
            return shortened(f"ok at q = {self.q}, v = {self.v}, rank {int(self.rank)}{more}")
        row, more = self._rows.labels[int(self.where)], ""
        if status is Status.contradictory_rows:
            more = self._rows.contradiction(self.system.size)
        return shortened(
            f"{status.name} ({row!r}): the nearest state was q = {self.q}, v = {self.v}, with "
            f"residuals {self.position_residual} of position and {self.velocity_residual} of "
            f"velocity.{more}"
        )
