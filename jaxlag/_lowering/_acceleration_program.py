"""Programs of the equations of motion that a solver evaluates, and the one on arrays."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._linalg._independent_rows import RowChoice
from jaxlag._linalg._projection import ConstraintProjector
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._quasi_equations import QuasiState
from jaxlag._model._constraints import ConstraintRows
from jaxlag._tracing import _params


class AccelerationProgram(eqx.Module):
    """What a solver evaluates in its loop: accelerations, and projections onto the constraints.

    M(t,q,v) a + h(t,q,v) = Q(t,q,v,inputs) + A(t,q)^T lam,   A v + b = 0,   A a + gamma = 0.

    One state at a time: t scalar (s), q and v (or w, the quasi-velocities of the state) of shapes
    (n,) and (k,), `inputs` the dict of input VALUES there. All programs agree to round-off.

    Attributes:
        array: the terms of these equations, on arrays.
    """

    array: eqx.AbstractVar[ArrayTerms]

    @abstractmethod
    def precompute(
        self,
        q: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        sample: _params.Sample = _params.UNKNOWN,
        kept: Bool[Array, " m"] | None = None,
        reacting: RowChoice | None = None,
        time_direction: Array | float = 1.0,
        definite: Callable[[], Array] | None = None,
    ) -> Any:
        """What the other methods need of what depends on params alone, once per solve.

        Of q and the inputs' values only shapes and dtypes matter.

        Args:
            q: coordinates.
            params: as the Lagrangian takes them.
            inputs: values by name.
            sample: values of the params where these are traced.
            kept: rows that states are going to be projected by; None for all.
            reacting: rows that accelerations are going to be solved with; None for all.
            time_direction: 1, or -1 backwards in time.
            definite: whether M is positive definite without the constraints, in all lanes; None
                where that is known while tracing.
        """

    @abstractmethod
    def acceleration(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any = None,
        reacting: RowChoice | None = None,
    ) -> Float[Array, " n"]:
        """a, with one factorisation; NaN where M is not positive definite where A a = 0.

        `constants`: what `precompute` returned for these params; computed here if left out.
        `reacting`: independent rows that imply the others; all if left out.
        """

    @abstractmethod
    def quasi_rates(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        w: Float[Array, " k"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
    ) -> Float[Array, " m"]:
        """(v, w') of a state of quasi-velocities."""

    @abstractmethod
    def velocities(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        w: Float[Array, " k"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
    ) -> Float[Array, " n"]:
        """v of a state of quasi-velocities."""

    @abstractmethod
    def determinants(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
    ) -> Float[Array, " b"]:
        """What is 0 or infinite where quasi-velocities are singular; none where nothing changes."""

    @abstractmethod
    def multipliers(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
        reacting: RowChoice | None = None,
    ) -> Float[Array, " m"]:
        """The multipliers as forces see them."""

    @abstractmethod
    def projector(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        w: Float[Array, " k"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
        rows: ConstraintRows,
        kept: Bool[Array, " m"] | None,
    ) -> ConstraintProjector:
        """The projection onto the constraints near a state; of quasi-velocities onto positions."""

    def lines(self, q: Any, params: Any, inputs: Mapping[str, Any]) -> int | None:
        """Lines of the scalar program of accelerations; None where there is none."""
        return None


@final
class ArrayProgram(AccelerationProgram):
    """Accelerations by the terms on arrays themselves."""

    array: ArrayTerms

    def precompute(
        self,
        q: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        sample: _params.Sample = _params.UNKNOWN,
        kept: Bool[Array, " m"] | None = None,
        reacting: RowChoice | None = None,
        time_direction: Array | float = 1.0,
        definite: Callable[[], Array] | None = None,
    ) -> Any:
        """M and its factor where M depends on params alone."""
        return self.array.precompute(q, params, time_direction)

    def acceleration(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any = None,
        reacting: RowChoice | None = None,
    ) -> Float[Array, " n"]:
        """Solve M a = Q - h, under constraints with their rows."""
        return self.array.acceleration(t, q, v, params, inputs, constants, reacting)

    def quasi_rates(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        w: Float[Array, " k"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
    ) -> Float[Array, " m"]:
        """The equations in quasi-velocities on arrays."""
        state = QuasiState(self.array, t, q, w, params, inputs)
        return jnp.concatenate([state.v, state.accelerations()])

    def velocities(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        w: Float[Array, " k"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
    ) -> Float[Array, " n"]:
        """v = B u + c."""
        quasi = self.array.quasi
        return w if quasi is None else quasi.velocities(t, q, quasi.full(w), params)

    def determinants(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
    ) -> Float[Array, " b"]:
        """That of dU/dv, or of dv/du where that is given."""
        quasi = self.array.quasi
        assert quasi is not None
        if not quasi.moves(q, params):
            return jnp.zeros((0,), q.dtype)
        return quasi.determinant(t, q, params)[None]

    def multipliers(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
        reacting: RowChoice | None = None,
    ) -> Float[Array, " m"]:
        """Solved with the rows that react."""
        return self.array.multipliers(t, q, v, params, inputs, constants, reacting)

    def projector(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        w: Float[Array, " k"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
        rows: ConstraintRows,
        kept: Bool[Array, " m"] | None,
    ) -> ConstraintProjector:
        """By M^-1 A^T (A M^-1 A^T)^-1 at the state; of holonomic rows alone for q."""
        v = self.velocities(t, q, w, params, inputs, constants)
        holonomic = np.flatnonzero(rows.holonomic).tolist()

        def corrections(chosen: list[int] | None) -> tuple[Array, Array]:
            return self.array.corrections(t, q, v, params, constants, kept, chosen)

        def position(q: Array) -> Array:
            return self.array.position(t, q, params)

        if self.array.quasi is not None:
            near, _ = corrections(holonomic)
            return ConstraintProjector(position, None, lambda c: near @ c, None)
        K, masses = corrections(None)
        K_of_position = K
        if 0 < len(holonomic) < rows.size:
            K_of_position, _ = corrections(holonomic)
        return ConstraintProjector(
            position if holonomic else None,
            lambda q, v: self.array.velocity(t, q, v, params),
            lambda c: K_of_position @ c,
            lambda c: K @ c,
            K.T,
            masses,
        )
