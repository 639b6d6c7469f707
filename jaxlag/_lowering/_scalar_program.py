"""The scalar program: every element of every array is a separate scalar."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxlag._linalg._independent_rows import RowChoice
from jaxlag._linalg._projection import ConstraintProjector
from jaxlag._lowering._acceleration_program import (
    AS_USUAL,
    AccelerationProgram,
    ArrayProgram,
    Choices,
    State,
)
from jaxlag._lowering._array_terms import ArrayTerms, SolveConstants
from jaxlag._lowering._emit import _emit
from jaxlag._lowering._graph._straight_line import Program
from jaxlag._lowering._interpreted_terms import interpreted_terms
from jaxlag._lowering._lower import Lowered, lower, usually_definite
from jaxlag._lowering._sparse_program import find_sparsity
from jaxlag._lowering._symbolic._program_key import key_of
from jaxlag._lowering._symbolic._symbolic_system import Equations
from jaxlag._lowering._terms import AbstractTerms
from jaxlag._model._constraints import ConstraintRows
from jaxlag._tracing import _params


class ScalarSolveConstants(NamedTuple):
    """Values of each program that do not change during a solve.

    If it is unknown while tracing whether M is positive definite without the constraints, and it
    usually is, there are programs for both cases. The one for the unusual case is interpreted.

    Attributes:
        definite: whether it is, in all lanes.
        alone: values of the shorter programs for such a mass matrix; None if it is known.
    """

    acceleration: Array
    position: Array | None = None
    velocity: Array | None = None
    correction: Array | None = None
    lam: Array | None = None
    rates: Array | None = None
    determinants: Array | None = None
    definite: Bool[Array, ""] | None = None
    alone: "ScalarSolveConstants | None" = None


_WITH_INPUTS = ("acceleration", "lam")
_BY_MASS = ("acceleration", "lam")  # programs that divide by M


@final
class ScalarProgram(AccelerationProgram):
    """Accelerations as straight-line code on scalars, derived on a graph.

    A system without a scalar program, or with one of more operations than `limit`, uses the
    array program.

    Attributes:
        array: the terms of the same system on arrays.
        limit: largest number of operations of a scalar program; None for no limit.
        lanes: whether terms are vmapped, so that every scalar is a row of numbers.
        in_loop: whether they are evaluated in a loop over one trajectory or a few lanes.
        seldom: whether they are evaluated a few times in a solve, or not expected to be.
        jacobians: whether their derivatives are Jacobians of implicit methods.
    """

    array: ArrayTerms
    limit: int | None = eqx.field(static=True)
    lanes: bool = eqx.field(static=True, default=False)
    in_loop: bool = eqx.field(static=True, default=False)
    seldom: bool = eqx.field(static=True, default=False)
    jacobians: bool = eqx.field(static=True, default=False)

    def lowered(
        self,
        q: Any,
        params: Any,
        inputs: Mapping[str, Any],
        sample: _params.Sample = _params.UNKNOWN,
    ) -> Lowered:
        """The scalar program for these shapes, or the reason why there is none.

        It is compared with the array program when it is made: with `params` if their values
        are known, else with the sample.
        """
        key = key_of(self.array, q, params, inputs, self.limit)
        return lower(key, _params.sample(_params.split(params)[0], sample))

    def precompute(
        self, q: Array, params: Any, inputs: Mapping[str, Any], choices: Choices = AS_USUAL
    ) -> ScalarSolveConstants | SolveConstants:
        """Values for accelerations and projections that depend on params alone."""
        given = q, params, inputs, choices
        constants = self._precomputed(*given)
        if constants is None:
            return self._on_arrays.precompute(*given)
        if choices.definite is not None and self._usually_definite(*given):
            alone = self.regular()._precomputed(*given)
            if alone is not None:
                constants = constants._replace(definite=choices.definite(), alone=alone)
        return constants

    def _usually_definite(
        self, q: Array, params: Any, inputs: Mapping[str, Any], choices: Choices
    ) -> bool:
        key = key_of(self.array, q, params, inputs, self.limit)
        sample = _params.sample(_params.split(params)[0], choices.sample)
        return usually_definite(key, sample)

    def _precomputed(
        self, q: Array, params: Any, inputs: Mapping[str, Any], choices: Choices
    ) -> ScalarSolveConstants | None:
        """The same of this program; None if it does not exist."""
        equations = self.lowered(q, params, inputs, choices.sample).equations
        if equations is None:
            return None

        def before(
            code: Program | None, active_rows: Array | None, nonzero: Array | None = None
        ) -> Array | None:
            if code is None:
                return None
            return _emit.prelude(
                code, params, q.dtype, active_rows, nonzero, choices.time_direction
            )

        active_rows, solving = choices.active_rows, choices.multiplier_rows or (None, None)
        first = before(equations.program, *solving)
        assert first is not None
        rates = before(equations.velocity, active_rows)
        determinants = before(equations.determinants, None)
        if equations.surface is None:
            return ScalarSolveConstants(first, rates=rates, determinants=determinants)
        surface = equations.surface
        moving = surface.position, surface.velocity, surface.correction
        others = [before(code, active_rows) for code in moving]
        of_lam = before(surface.lam, *solving)
        return ScalarSolveConstants(
            first, *others, lam=of_lam, rates=rates, determinants=determinants
        )

    def terms(self, q: Any, params: Any, sample: _params.Sample = _params.UNKNOWN) -> AbstractTerms:
        """Interpreted, if that is quicker to compile; on arrays if M and A are sparse."""
        if find_sparsity(self.array, params, q.shape[0], q.dtype).sparsity is not None:
            return self.array
        key = key_of(self.array, q, params, {}, self.limit)
        sample = _params.sample(_params.split(params)[0], sample)
        found = interpreted_terms(self.array, key, sample, alone=not self.in_loop)
        return found or self.array

    @property
    def _on_arrays(self) -> ArrayProgram:
        return ArrayProgram(self.array)

    def acceleration(
        self, state: State, constants: Any = None, multiplier_rows: RowChoice | None = None
    ) -> Float[Array, " n"]:
        """Acceleration a; all NaN if M is not positive definite.

        In a solve, where `constants` are known, only the singular block of M gives NaN, and the
        others keep their values: the step fails by the NaN.
        """
        given = state.q, state.params, state.inputs
        if self.lowered(*given).equations is None:
            return self._on_arrays.acceleration(state, constants, multiplier_rows)
        if constants is not None:
            return self._run("acceleration", state, constants)
        computed: Any = self.precompute(*given, Choices(multiplier_rows=multiplier_rows))
        a = self._run("acceleration", state, computed)
        return jnp.where(jnp.any(jnp.isnan(a)), jnp.nan, a)

    def quasi_rates(self, state: State, constants: Any) -> Float[Array, " m"]:
        """(v, w') by one program."""
        if not isinstance(constants, ScalarSolveConstants):
            return self._on_arrays.quasi_rates(state, constants)
        return self._run("acceleration", state, constants)

    def velocities(self, state: State, constants: Any) -> Float[Array, " n"]:
        """v by a separate program."""
        if self.array.quasi is None or not isinstance(constants, ScalarSolveConstants):
            return self._on_arrays.velocities(state, constants)
        return self._run("rates", state, constants)

    def determinants(self, state: State, constants: Any) -> Float[Array, " b"]:
        """Determinants of the blocks of dU/dv, or of dv/du, without constant ones."""
        if not isinstance(constants, ScalarSolveConstants) or constants.determinants is None:
            return self._on_arrays.determinants(state, constants)
        code = self._equations(state).determinants
        assert code is not None
        if not code.results:
            return jnp.zeros((0,), state.q.dtype)
        return self._run("determinants", state, constants)

    def _run(self, name: str, state: State, constants: ScalarSolveConstants) -> Array:
        """The results of the program whose prelude has this name."""
        # Equations in quasi-velocities are projected: only their projection divides by M.
        projected = self.array.quasi is not None and name == "acceleration"
        if name not in _BY_MASS or projected:
            return self._results(name, state, constants)
        return self._by_mass(lambda program, c: program._results(name, state, c), constants)

    def _by_mass(
        self,
        of: Callable[["ScalarProgram", ScalarSolveConstants], Any],
        constants: ScalarSolveConstants,
    ) -> Any:
        """`of` the shorter program if M is positive definite without the constraints."""
        if constants.alone is None:
            return of(self, constants)
        alone = partial(of, self.regular(), constants.alone)
        general = self if self.array.quasi is not None else replace(self, seldom=True)
        return lax.cond(constants.definite, alone, partial(of, general, constants))

    def _results(self, name: str, state: State, constants: ScalarSolveConstants) -> Array:
        """The same of this program, whatever M is."""
        code, carried = self._equations(state).code(name), getattr(constants, name)
        assert code is not None
        assert carried is not None
        read = state.inputs if name in _WITH_INPUTS else {}
        where = self.lanes, self.in_loop, self.seldom, self.jacobians
        return _emit.body(code, carried, *state[:3], read, *where)

    def regular(self) -> "ScalarProgram":
        """The same for an M that is positive definite without the constraints."""
        return replace(self, array=replace(self.array, regular=True))

    def _equations(self, state: State) -> Equations:
        equations = self.lowered(state.q, state.params, state.inputs).equations
        assert equations is not None
        return equations

    def projector(
        self,
        state: State,
        constants: Any,
        rows: ConstraintRows,
        active_rows: Bool[Array, " m"] | None,
    ) -> ConstraintProjector:
        """By the matrices that the program computes at the state."""
        if not isinstance(constants, ScalarSolveConstants):
            return self._on_arrays.projector(state, constants, rows, active_rows)
        code, v = self._equations(state).surface, state.w
        assert code is not None

        def run(name: str, q: Array, v: Array) -> Array:
            return self._run(name, state._replace(q=q, w=v), constants)

        def times(K: Array) -> Callable:
            return lambda c: jnp.sum(c[:, None] * K, axis=0)

        def position(q: Array) -> Array:
            return run("position", q, v)

        corrections = self._by_mass(lambda program, c: program._corrections(state, c), constants)
        shift, kick, masses = corrections
        if self.array.quasi is not None:
            return ConstraintProjector(position, None, times(kick), None)
        held = position if code.position.results else None
        return ConstraintProjector(
            held, partial(run, "velocity"), times(shift), times(kick), lambda: kick, masses
        )

    def _corrections(
        self, state: State, constants: ScalarSolveConstants
    ) -> tuple[Float[Array, "h n"], Float[Array, "m n"], Float[Array, " d"]]:
        """(columns from phi, columns from A v + b, diagonal of (A M^-1 A^T)^-1 if requested)."""
        code, n = self._equations(state).surface, state.q.shape[0]
        assert code is not None
        found = self._results("correction", state, constants)
        holonomic, every = (len(c.results) for c in (code.position, code.velocity))
        mixed = 0 < holonomic < every
        if code.solves is None:
            shift = found[: holonomic * n].reshape(-1, n)
            of_velocity = found[holonomic * n :] if mixed else found
            kick, masses = of_velocity[: every * n].reshape(-1, n), of_velocity[every * n :]
            return shift, kick, masses

        def solved(program: Program, count: int) -> Array:
            return _emit.solved(program, found, jnp.eye(count, dtype=found.dtype), self.in_loop)

        *of_position, of_velocity = code.solves
        rows = solved(of_velocity, every)
        kick, mu = rows[:, :n], rows[:, n:]
        shift = solved(of_position[0], holonomic)[:, :n] if mixed else kick[:holonomic]
        # Not `jnp.diagonal`: a gather is not compiled into the loop of a solve.
        of_own = jnp.eye(*mu.shape, dtype=bool)
        return shift, kick, jnp.sum(jnp.where(of_own, mu, 0.0), axis=0)

    def multipliers(
        self, state: State, constants: Any, multiplier_rows: RowChoice | None = None
    ) -> Float[Array, " m"]:
        """The multipliers as forces read them."""
        if not isinstance(constants, ScalarSolveConstants):
            return self._on_arrays.multipliers(state, constants, multiplier_rows)
        return self._run("lam", state, constants)

    def row_entries(
        self, terms: AbstractTerms, state: State, constants: Any = None
    ) -> Callable[[Array], Array]:
        """On arrays, if there is no scalar program."""
        scalar = isinstance(constants, ScalarSolveConstants)
        if constants is None:
            scalar = self.lowered(state.q, state.params, state.inputs).equations is not None
        if not scalar:
            return self._on_arrays.row_entries(terms, state)
        return terms.rows_of(state.t, state.w, state.params)

    def first_rows(self, state: State, sample: _params.Sample) -> np.ndarray | None:
        """On arrays, if there is no scalar program."""
        if self.lowered(state.q, state.params, state.inputs, sample).equations is not None:
            return None
        return self._on_arrays.first_rows(state, sample)

    def reactions(
        self, state: State, sample: _params.Sample = _params.UNKNOWN
    ) -> tuple[Float[Array, " n"], Float[Array, " m"], Float[Array, " n"]]:
        """On arrays, if M and A are sparse and there is no scalar program."""
        found = find_sparsity(self.array, state.params, state.q.shape[0], state.q.dtype)
        given = state.q, state.params, state.inputs, sample
        if found.sparsity is not None and self.lowered(*given).equations is None:
            return self._on_arrays.reactions(state, sample)
        return super().reactions(state, sample)

    def clearly_independent(self, state: State, sample: _params.Sample) -> Bool[Array, ""] | None:
        """On arrays."""
        if self.lowered(state.q, state.params, state.inputs, sample).equations is not None:
            return None
        return self._on_arrays.clearly_independent(state, sample)

    def keyed_by_inputs(self, constants: Any) -> bool:
        """The scalar programs are."""
        return isinstance(constants, ScalarSolveConstants)

    def lines(self, q: Any, params: Any, inputs: Mapping[str, Any]) -> int | None:
        """Number of lines of the body, which is evaluated at every state."""
        equations = self.lowered(q, params, inputs).equations
        return None if equations is None else len(equations.program.body)

    def variables(
        self, q: Any, params: Any, inputs: Mapping[str, Any], sample: _params.Sample
    ) -> frozenset[str] | None:
        """By the program; None also with inputs, which may depend on all of them."""
        equations = None if inputs else self.lowered(q, params, inputs, sample).equations
        if equations is None:
            return None
        return frozenset(name for name, _ in equations.program.inputs) & {"t", "q", "v"}

    def is_analytic(
        self, q: Any, params: Any, inputs: Mapping[str, Any], sample: _params.Sample
    ) -> bool:
        """By the body of the program."""
        equations = self.lowered(q, params, inputs, sample).equations
        return equations is not None and equations.program.is_analytic

    def why_on_arrays(
        self, q: Any, params: Any, inputs: Mapping[str, Any], sample: _params.Sample
    ) -> str | None:
        """The reason of the lowering."""
        lowered = self.lowered(q, params, inputs, sample)
        return lowered.reason if lowered.equations is None else None
