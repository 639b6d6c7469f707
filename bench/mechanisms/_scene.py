"""A mechanism as a user declares it, with its motion and an independent end."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

import jaxlag as jl


class Scene(NamedTuple):
    """A mechanism and its motion from t = 0. Lengths in m, masses in kg, angles in rad, s.

    Attributes:
        lagrangian: L(t, q, v, params), J.
        names: of the coordinates.
        params: numbers and arrays.
        q0: coordinates at the start.
        v0: velocities at the start, consistent.
        t1: end of the motion.
        dt: step of the variational method.
        end: what `seen` shows at the end, from other equations than those of L.
        phi: holonomic rows, phi(t, q, params) = 0.
        rolling: Pfaffian rows, rolling(t, q, v, params) = 0.
        force: generalized force(t, q, v, params).
        quasi: the quasi-velocities; they contain the rolling rows.
        seen: the numbers to compare at the end, of q.
        independent: the rows with which equations without a choice of rows are solved.
    """

    lagrangian: Callable[..., Any]
    names: tuple[str, ...]
    params: Mapping[str, Any]
    q0: np.ndarray
    v0: np.ndarray
    t1: float
    dt: float
    end: Callable[[], np.ndarray]
    phi: Callable[..., Any] | None = None
    rolling: Callable[..., Any] | None = None
    force: Callable[..., Any] | None = None
    quasi: jl.QuasiVelocities | None = None
    seen: Callable[[Any], Any] = np.asarray
    independent: tuple[int, ...] | None = None

    def system(self) -> jl.System:
        """The declaration, with functions that jaxlag has not seen yet."""
        rows: list[Any] = []
        if self.phi is not None:
            rows.append(jl.Holonomic(self.phi, "phi"))
        if self.rolling is not None and self.quasi is None:
            rows.append(jl.Pfaffian(self.rolling, "rolling"))
        forces = () if self.force is None else (jl.GeneralizedForce(self.force, "force"),)
        return jl.System(
            self.lagrangian, self.names, constraints=tuple(rows), forces=forces, quasi=self.quasi
        )
