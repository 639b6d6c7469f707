"""Acceleration programs: the interface that solvers evaluate, and its form on arrays."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, final

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._linalg._independent_rows import RowChoice
from jaxlag._linalg._kkt import units_of
from jaxlag._linalg._projection import ConstraintProjector, keeps_sense
from jaxlag._linalg._row_residuals import row_sizes
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._quasi_equations import QuasiState
from jaxlag._lowering._sparse_program import (
    SparseConstants,
    SparseEquations,
    find_sparsity,
    row_entries,
    sparse_constants,
)
from jaxlag._lowering._terms import AbstractTerms
from jaxlag._model._constraints import ConstraintRows
from jaxlag._tracing import _params


class State(NamedTuple):
    """One state and the values that the equations read there.

    Attributes:
        t: time, s.
        q: coordinates, m or rad.
        w: velocities, or the quasi-velocities of the state; m/s or rad/s.
        params: as the Lagrangian takes them.
        inputs: VALUES of the inputs there, by name.
    """

    t: Float[Array, ""]
    q: Float[Array, " n"]
    w: Float[Array, " k"]
    params: Any
    inputs: Mapping[str, Any]


class Choices(NamedTuple):
    """Choices made once per solve.

    Attributes:
        sample: values of the params if these are traced.
        active_rows: rows for the projection of states; None for all.
        multiplier_rows: independent rows that imply the others, for accelerations; None for all.
        time_direction: 1, or -1 backwards in time.
        definite: function that returns whether M is positive definite without the constraints, in
            all lanes; None if that is known while tracing.
    """

    sample: _params.Sample = _params.UNKNOWN
    active_rows: Bool[Array, " m"] | None = None
    multiplier_rows: RowChoice | None = None
    time_direction: Array | float = 1.0
    definite: Callable[[], Array] | None = None


AS_USUAL = Choices()
"""All rows, forwards in time, and what is known while tracing."""


class AccelerationProgram(eqx.Module):
    """The functions that a solver evaluates in its loop: accelerations and projections.

    M(t,q,v) a + h(t,q,v) = Q(t,q,v,inputs) + A(t,q)^T lam,   A v + b = 0,   A a + gamma = 0.

    All programs agree to rounding. `constants` are the result of `precompute` for the same params.

    Attributes:
        array: the terms of these equations, on arrays.
    """

    array: eqx.AbstractVar[ArrayTerms]

    @abstractmethod
    def precompute(
        self, q: Array, params: Any, inputs: Mapping[str, Any], choices: Choices = AS_USUAL
    ) -> Any:
        """Values that depend on params alone, for the other methods, once per solve.

        Only shapes and dtypes of q and of the inputs' values are used.
        """

    @abstractmethod
    def acceleration(
        self, state: State, constants: Any = None, multiplier_rows: RowChoice | None = None
    ) -> Float[Array, " n"]:
        """a, with one factorization; NaN if M is not positive definite on A a = 0."""

    def terms(self, q: Any, params: Any, sample: _params.Sample = _params.UNKNOWN) -> AbstractTerms:
        """The terms, without forces, for use a few times in a solve.

        Args:
            q: coordinates; their number and dtype are used.
            params: as the Lagrangian takes them.
            sample: values of the params if these are traced.
        """
        return self.array

    @abstractmethod
    def quasi_rates(self, state: State, constants: Any) -> Float[Array, " m"]:
        """(v, w') of a state of quasi-velocities."""

    @abstractmethod
    def velocities(self, state: State, constants: Any) -> Float[Array, " n"]:
        """v of a state; from quasi-velocities v = B u + c."""

    @abstractmethod
    def determinants(self, state: State, constants: Any) -> Float[Array, " b"]:
        """Determinants that are 0 or infinite at singular quasi-velocities, if not constant."""

    @abstractmethod
    def multipliers(
        self, state: State, constants: Any, multiplier_rows: RowChoice | None = None
    ) -> Float[Array, " m"]:
        """The multipliers as forces read them."""

    def reactions(
        self, state: State, sample: _params.Sample = _params.UNKNOWN
    ) -> tuple[Float[Array, " n"], Float[Array, " m"], Float[Array, " n"]]:
        """(a, lam, A^T lam), lam of least norm for dependent rows; NaN for contradictory rows.

        Args:
            state: any state; its rows are examined.
            sample: values of the params if these are traced.
        """
        t, q, v, params, inputs = state
        terms = self.terms(q, params, sample)
        a, lam = self.array.reactions(t, q, v, params, inputs, terms)
        return a, lam, lam @ terms.rows_of(t, v, params)(q)

    @abstractmethod
    def projector(
        self,
        state: State,
        constants: Any,
        rows: ConstraintRows,
        active_rows: Bool[Array, " m"] | None,
    ) -> ConstraintProjector:
        """The projection onto the constraints near a state; of positions with quasi-velocities."""

    def row_entries(
        self, terms: AbstractTerms, state: State, constants: Any = None
    ) -> Callable[[Array], Array]:
        """A as a function of q, without columns that are 0 where it is sparse.

        Args:
            terms: the result of `terms`.
            state: at which it is needed.
            constants: the result of `precompute`, if it exists already.
        """
        return terms.rows_of(state.t, state.w, state.params)

    def clearly_independent(self, state: State, sample: _params.Sample) -> Bool[Array, ""] | None:
        """Whether all rows are clearly independent, in all lanes; None if that takes long."""
        return None

    def first_rows(self, state: State, sample: _params.Sample) -> np.ndarray | None:
        """Rows that are to be kept where others depend on them, shape (m,); None for no preference.

        Args:
            state: shapes and dtypes are used.
            sample: values of the params if these are traced.
        """
        return None

    def is_sparse(self, constants: Any) -> bool:
        """Whether solves use the sparsity of M and A."""
        return isinstance(constants, SparseConstants)

    def keyed_by_inputs(self, constants: Any) -> bool:
        """Whether velocities, determinants and projections need the inputs' shapes."""
        return False

    def lines(self, q: Any, params: Any, inputs: Mapping[str, Any]) -> int | None:
        """Number of lines of the scalar program of accelerations; None if there is none."""
        return None

    def variables(
        self, q: Any, params: Any, inputs: Mapping[str, Any], sample: _params.Sample
    ) -> frozenset[str] | None:
        """Those of (t, q, v) that the scalar program reads; None if there is none."""
        return None

    def is_analytic(
        self, q: Any, params: Any, inputs: Mapping[str, Any], sample: _params.Sample
    ) -> bool:
        """Whether there is a scalar program without comparisons and unusual functions."""
        return False

    def why_on_arrays(
        self, q: Any, params: Any, inputs: Mapping[str, Any], sample: _params.Sample
    ) -> str | None:
        """Why there is no scalar program; None if there is one, or none is wanted."""
        return None


@final
class ArrayProgram(AccelerationProgram):
    """Accelerations directly from the terms on arrays."""

    array: ArrayTerms

    def precompute(
        self, q: Array, params: Any, inputs: Mapping[str, Any], choices: Choices = AS_USUAL
    ) -> Any:
        """M and its factor if M depends on params alone."""
        direction = choices.time_direction
        sparse = sparse_constants(self.array, q, params, direction)
        return self.array.precompute(q, params, direction) if sparse is None else sparse

    def acceleration(
        self, state: State, constants: Any = None, multiplier_rows: RowChoice | None = None
    ) -> Float[Array, " n"]:
        """Solve M a = Q - h, with constraints together with their rows."""
        if constants is None:
            constants = self.precompute(state.q, state.params, state.inputs)
        if isinstance(constants, SparseConstants):
            return SparseEquations(self.array, constants).acceleration(*state, multiplier_rows)
        return self.array.acceleration(*state, constants, multiplier_rows)

    def quasi_rates(self, state: State, constants: Any) -> Float[Array, " m"]:
        """The equations in quasi-velocities on arrays."""
        moving = QuasiState(self.array, *state)
        return jnp.concatenate([moving.v, moving.accelerations()])

    def velocities(self, state: State, constants: Any) -> Float[Array, " n"]:
        """From U(t, q, v) = u, or from the given kinematics."""
        quasi, (t, q, w, params, _) = self.array.quasi, state
        return w if quasi is None else quasi.velocities(t, q, quasi.full(w), params)

    def determinants(self, state: State, constants: Any) -> Float[Array, " b"]:
        """The determinant of dU/dv, or of dv/du if that is given."""
        quasi, (t, q, _, params, _) = self.array.quasi, state
        assert quasi is not None
        if not quasi.moves(q, params):
            return jnp.zeros((0,), q.dtype)
        return quasi.determinant(t, q, params)[None]

    def row_entries(
        self, terms: AbstractTerms, state: State, constants: Any = None
    ) -> Callable[[Array], Array]:
        """The entries of a sparse A; else all of A."""
        t, q, v, params, _ = state
        sparsity = find_sparsity(self.array, params, q.shape[0], q.dtype).sparsity
        if sparsity is None or sparsity.constrained is None:
            return terms.rows_of(t, v, params)
        return partial(row_entries, self.array, sparsity.constrained, t, params)

    def clearly_independent(self, state: State, sample: _params.Sample) -> Bool[Array, ""] | None:
        """By the pivots of sparse solves, if there are any."""
        t, q, v, params, _ = state
        sparse = self._sparse(state)
        return None if sparse is None else sparse.clearly_independent(t, q, v, params)

    def reactions(
        self, state: State, sample: _params.Sample = _params.UNKNOWN
    ) -> tuple[Float[Array, " n"], Float[Array, " m"], Float[Array, " n"]]:
        """By the entries of sparse M and A where all rows are clearly independent."""
        sparse, of_all = self._sparse(state), super().reactions
        if sparse is None:
            return of_all(state, sample)
        entries = self.row_entries(self.array, state)
        nonzero = row_sizes(entries, state.q, entries(state.q)).nonzero
        clear, solved = sparse.reactions(*state)
        clear = clear & eqxi.unvmap_all(jnp.all(nonzero))
        return jax.lax.cond(clear, solved, lambda: of_all(state, sample))

    def _sparse(self, state: State) -> SparseEquations | None:
        """The sparse equations with constraints, if there are any."""
        constants = sparse_constants(self.array, state.q, state.params, 1.0)
        if constants is None or not self.array.constraints:
            return None
        return SparseEquations(self.array, constants)

    def first_rows(self, state: State, sample: _params.Sample) -> np.ndarray | None:
        """Rows inside of one block of a sparse M, which may make it definite."""
        size, dtype = state.q.shape[0], state.q.dtype
        sparsity = find_sparsity(self.array, state.params, size, dtype).sparsity
        constrained = None if sparsity is None else sparsity.constrained
        return None if constrained is None else constrained.rows.is_inside

    def multipliers(
        self, state: State, constants: Any, multiplier_rows: RowChoice | None = None
    ) -> Float[Array, " m"]:
        """Solved with the rows in `multiplier_rows`."""
        return self.array.multipliers(*state, constants, multiplier_rows)

    def projector(
        self,
        state: State,
        constants: Any,
        rows: ConstraintRows,
        active_rows: Bool[Array, " m"] | None,
    ) -> ConstraintProjector:
        """By M^-1 A^T (A M^-1 A^T)^-1 at the state; with holonomic rows alone for q."""
        t, q, _, params, _ = state
        v = self.velocities(state, constants)
        if isinstance(constants, SparseConstants):
            equations = SparseEquations(self.array, constants)
            return equations.projector(t, q, v, params, active_rows)
        holonomic = np.flatnonzero(rows.holonomic).tolist()

        def corrections(chosen: list[int] | None) -> tuple[Array, Array]:
            return self.array.corrections(t, q, v, params, constants, active_rows, chosen)

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
            lambda: K.T,
            masses,
            lambda t, q, v: keeps_sense(K.T, self.array.rows(t, q, v, params)[0], active_rows),
            lambda x: jnp.sum(jnp.abs(self.array.rows(t, q, v, params)[0]) * x[None], axis=1),
            lambda: units_of(self.array.mass(t, q, v, params), self.array.rows(t, q, v, params)[0]),
        )
