"""The sparse program: accelerations on arrays where M has small blocks and A few entries a row."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxlag._linalg._block_diagonal import BlockDiagonal, factor_blocks, solve_blocks
from jaxlag._linalg._independent_rows import RowChoice
from jaxlag._linalg._mass_solve import LOOP_UP_TO, MassFactor, dependence_floor
from jaxlag._linalg._projection import ConstraintProjector
from jaxlag._linalg._sparse_kkt import SparseFactor, SparseKkt, factor_sparse, solve_sparse
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._row_layout import layout, layout_of
from jaxlag._lowering._sparsity import SparseRows, Sparsity, SparsityFound, search_sparsity
from jaxlag._model._forces import reads_lam
from jaxlag._tracing import _params
from jaxlag._tracing._index_check import OutOfRange


class SparseConstants(eqx.Module):
    """Values that do not change during a solve.

    Attributes:
        sparsity: of M and A.
        inertia: M if it depends on params alone, else None.
        factor: its factor, if M is positive definite without the constraints.
        bias_zero: whether h = 0 in every state.
        time_direction: -1 if time runs backwards.
    """

    sparsity: Sparsity = eqx.field(static=True)
    inertia: BlockDiagonal | None
    factor: MassFactor | None
    bias_zero: bool = eqx.field(static=True)
    time_direction: Array | float = 1.0


def sparse_constants(
    terms: ArrayTerms, q: Float[Array, " n"], params: Any, time_direction: Array | float
) -> SparseConstants | None:
    """Values for the sparse program; None if the matrices are not sparse.

    With constraints it needs blocks of M that are definite, alone or with the rows inside of them.
    Where that is unknown, as the params are traced, they are if they are so for random params.

    Args:
        terms: of the equations.
        q: coordinates; their number and dtype are used.
        params: as the Lagrangian takes them.
        time_direction: 1, or -1 backwards in time.
    """
    regular = terms.regular or not terms.constraints
    known = True if regular else terms.blocks_definite
    if known is False:
        return None
    found = find_sparsity(terms, params, q.shape[0], q.dtype)
    if found.sparsity is None or not (known or found.definite):
        return None
    sparsity = found.sparsity
    structure = terms.structure(params, q.shape[0], q.dtype)
    if not structure.mass_constant:
        return SparseConstants(sparsity, None, None, structure.bias_zero, time_direction)
    anywhere, t = jnp.ones(q.shape, q.dtype), jnp.zeros((), jnp.result_type(float))
    mass = sparsity.mass(lambda v: terms.momentum(t, anywhere, v, params), anywhere)
    factor = factor_blocks(mass) if regular else None
    return SparseConstants(sparsity, mass, factor, structure.bias_zero, time_direction)


def sparse_kkt(
    terms: ArrayTerms, sparsity: Sparsity, params: Any, t: Array, q: Array, v: Array
) -> SparseKkt:
    """M and A at a state."""
    constants = SparseConstants(sparsity, None, None, bias_zero=False)
    return SparseEquations(terms, constants).kkt(t, q, v, params)


class SparseEquations(NamedTuple):
    """M a + h = Q + A^T lam, A a + gamma = 0 by the entries of M and A.

    Attributes:
        terms: on arrays.
        constants: of the solve.
    """

    terms: ArrayTerms
    constants: SparseConstants

    def inertia(self, t: Array, q: Array, v: Array, params: Any) -> BlockDiagonal:
        """M at a state."""
        if self.constants.inertia is not None:
            return self.constants.inertia
        return self.constants.sparsity.mass(lambda v: self.terms.momentum(t, q, v, params), v)

    def kkt(self, t: Array, q: Array, v: Array, params: Any) -> SparseKkt:
        """M and A at a state."""

        def velocity(v: Array) -> Array:
            return self.terms.velocity(t, q, v, params)

        rows = self.constants.sparsity.constrained
        assert rows is not None
        return rows.kkt(self.inertia(t, q, v, params), velocity, jnp.zeros_like(v))

    def acceleration(
        self,
        t: Array,
        q: Array,
        v: Array,
        params: Any,
        inputs: Mapping[str, Any],
        multiplier_rows: RowChoice | None,
    ) -> Float[Array, " n"]:
        """a, with one factorization."""
        if not self.terms.constraints:
            right = self.terms.effort(t, q, v, params, inputs, self.constants.bias_zero)
            return solve_blocks(self.inertia(t, q, v, params), right, self.constants.factor)
        kkt, active_rows = self.kkt(t, q, v, params), None
        if multiplier_rows is not None:
            active_rows = multiplier_rows.active_rows
        factor = self._factor(kkt, active_rows)
        return self._solved(kkt, factor, t, q, v, params, inputs, active_rows)[0]

    def reactions(
        self, t: Array, q: Array, v: Array, params: Any, inputs: Mapping[str, Any]
    ) -> tuple[Bool[Array, ""], Callable]:
        """Whether all rows are clearly independent; () -> (a, lam, A^T lam) if they are.

        The solution is a function for the branch that needs it: derivatives of one by dependent
        rows are NaN, which would spread from a result that is not selected.
        """
        kkt = self.kkt(t, q, v, params)
        factor = self._factor(kkt, None)

        def solved() -> tuple[Array, Array, Array]:
            a, lam = self._solved(kkt, factor, t, q, v, params, inputs)
            return a, lam, kkt.mass.blocks.join(kkt.loads(lam))

        return _clear(factor), solved

    def _solved(
        self,
        kkt: SparseKkt,
        factor: SparseFactor,
        t: Array,
        q: Array,
        v: Array,
        params: Any,
        inputs: Mapping[str, Any],
        active_rows: Bool[Array, " m"] | None = None,
    ) -> tuple[Array, Array]:
        """(a, lam)."""
        terms, constants = self.terms, self.constants
        right = terms.effort(t, q, v, params, inputs, constants.bias_zero)
        gamma = terms.gamma(t, q, v, params, constants.time_direction)
        return solve_sparse(kkt, right, gamma, factor, active_rows)

    def clearly_independent(self, t: Array, q: Array, v: Array, params: Any) -> Bool[Array, ""]:
        """Whether the pivots of S are above eps^1/2, in all lanes."""
        return _clear(self._factor(self.kkt(t, q, v, params), None))

    def _factor(self, kkt: SparseKkt, active_rows: Bool[Array, " m"] | None) -> SparseFactor:
        terms = self.terms
        return factor_sparse(kkt, active_rows, terms.regular, terms.crossing, self.constants.factor)

    def projector(
        self, t: Array, q: Array, v: Array, params: Any, active_rows: Bool[Array, " m"] | None
    ) -> ConstraintProjector:
        """By solves with factors of M and S at the state."""
        terms, kkt = self.terms, self.kkt(t, q, v, params)
        rows, no_load = self.constants.sparsity.constrained, jnp.zeros_like(q)
        assert rows is not None

        def correction(kkt: SparseKkt, active_rows: Array | None) -> tuple[Callable, SparseFactor]:
            factor = self._factor(kkt, active_rows)
            return lambda c: -solve_sparse(kkt, no_load, c, factor, active_rows)[0], factor

        kick, factor = correction(kkt, active_rows)
        shift, holonomic = kick, layout(terms.constraints, params, q.shape[0], q.dtype).holonomic
        if rows.holonomic is not None:
            part, chosen = rows.holonomic
            of_part = replace(kkt, rows=part, A=kkt.A[chosen, : part.met.shape[1]])
            shift, _ = correction(of_part, None if active_rows is None else active_rows[chosen])

        def columns() -> Array:
            return jax.vmap(kick)(jnp.eye(kkt.rows.count, dtype=q.dtype))

        return ConstraintProjector(
            (lambda q: terms.position(t, q, params)) if any(holonomic) else None,
            lambda q, v: terms.velocity(t, q, v, params),
            shift,
            kick,
            columns,
            factor.masses(),
            lambda t, q, v: factor.keeps_sense(self.kkt(t, q, v, params), active_rows),
            replace(kkt, A=jnp.abs(kkt.A)).times,
            kkt.units,
            sparse=True,
        )


def _clear(factor: SparseFactor) -> Bool[Array, ""]:
    """Whether the pivots of S are above eps^1/2, in all lanes."""
    pivots = factor.schur.pivots
    clear = jnp.all(pivots > dependence_floor(pivots.dtype)) & factor.healthy
    return eqxi.unvmap_all(clear & jnp.all(jnp.isfinite(pivots)))


def row_entries(
    terms: ArrayTerms, rows: SparseRows, t: Array, params: Any, q: Float[Array, " n"]
) -> Float[Array, "m e"]:
    """The entries of every row of A that may differ from zero."""
    found = rows.of_rows.entries(lambda v: terms.velocity(t, q, v, params), jnp.zeros_like(q))
    return found.reshape(found.shape[0], -1)


def find_sparsity(terms: ArrayTerms, params: Any, size: int, dtype: Any) -> SparsityFound:
    """The sparsity of M and A, if solves with it are shorter.

    Args:
        terms: of the equations.
        params: as the Lagrangian takes them.
        size: number n of coordinates.
        dtype: of the state.
    """
    if size <= LOOP_UP_TO:
        return SparsityFound(None, f"n <= {LOOP_UP_TO}")
    if terms.quasi is not None or terms.formulation != "multipliers":
        return SparsityFound(None, "only for multipliers")
    if any(map(reads_lam, terms.forces)):
        return SparsityFound(None, "a force reads multipliers")
    traced, static = _params.split(params)
    keys = _params.Static(_params.shapes(traced)), _params.Static(static)
    return _sparsity(terms.lagrangian, terms.constraints, *keys, size, jnp.dtype(dtype))


@lru_cache(maxsize=256)
def _sparsity(*declared: Any) -> SparsityFound:
    try:
        return _found(*declared)
    except OutOfRange:
        raise
    except Exception as error:  # of a primitive, or in a declared function, which reports it later
        return SparsityFound(
            None, f"{type(error).__name__}: {(str(error) or 'no message').splitlines()[0]}"
        )


def _found(
    lagrangian: Callable,
    constraints: tuple,
    avals: _params.Static,
    static: _params.Static,
    size: int,
    dtype: Any,
) -> SparsityFound:
    terms = ArrayTerms(lagrangian, (), constraints)
    t, q = jax.ShapeDtypeStruct((), jnp.result_type(float)), jax.ShapeDtypeStruct((size,), dtype)

    def momentum(v: Array, t: Array, q: Array, traced: Any) -> Array:
        return terms.momentum(t, q, v, _params.join(traced, static.tree))

    def velocity(v: Array, t: Array, q: Array, traced: Any) -> Array:
        return terms.velocity(t, q, v, _params.join(traced, static.tree))

    given = q, t, q, avals.tree
    if not constraints:
        return search_sparsity(momentum, None, (), given)
    holonomic = layout_of(constraints, avals, static, size, dtype).holonomic
    return search_sparsity(momentum, velocity, holonomic, given)
