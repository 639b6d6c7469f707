"""The sparse program: accelerations on arrays where M has small blocks and A few entries a row."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.sparse import csr_array

from jaxlag._linalg._block_diagonal import (
    BlockDiagonal,
    blocks_of,
    factor_blocks,
    solve_blocks,
)
from jaxlag._linalg._independent_rows import RowChoice
from jaxlag._linalg._mass_solve import (
    LOOP_UP_TO,
    MassFactor,
    clearly_definite,
    dependence_floor,
)
from jaxlag._linalg._projection import ConstraintProjector
from jaxlag._linalg._sparse_kkt import (
    SparseFactor,
    SparseKkt,
    factor_sparse,
    half_bandwidth,
    solve_sparse,
)
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._row_layout import layout, layout_of
from jaxlag._lowering._sparsity import SparseRows, Sparsity, jacobian_pattern, sparsity_of
from jaxlag._model._forces import reads_lam
from jaxlag._tracing import _params
from jaxlag._tracing._index_check import OutOfRange
from jaxlag._tracing._interpret import interpret

# Times as large as its blocks M must be, and A as the half bandwidth w of S. Microseconds of an
# evaluation, sparse | whole matrices: net of 5 x 5 masses in space (40 rows, w = 10) 23 | 3,100;
# of 12 x 12 (264 rows, w = 24) 177 | 9,600; 6 bodies with quaternions (24 rows, w = 6) 11 | 38.
SMALLER = 4
ROWS_MORE = 2
# Coordinates above which both programs are compiled if it is unknown which one holds. Gradient of
# 20 rods (60 coordinates) with traced params: first result 79 s, run 0.12 s; by whole matrices
# alone 31 s, 0.9 s. A rope of 300 masses takes 4.5 s for 11 steps by whole matrices.
LARGE = 256
STATES = 2  # random states for the comparison of products


class SparseConstants(eqx.Module):
    """Values that do not change during a solve.

    Attributes:
        sparsity: of M and A.
        inertia: M if it depends on params alone, else None.
        factor: its factor, if M is positive definite without the constraints.
        bias_zero: whether h = 0 in every state.
        time_direction: -1 if time runs backwards.
        definite: whether the blocks are definite, in all lanes; None if M is known to be so.
        dense: values of the array program, for an M that is not.
    """

    sparsity: Sparsity = eqx.field(static=True)
    inertia: BlockDiagonal | None
    factor: MassFactor | None
    bias_zero: bool = eqx.field(static=True)
    time_direction: Array | float = 1.0
    definite: Bool[Array, ""] | None = None
    dense: Any = None


def sparse_constants(
    terms: ArrayTerms,
    q: Float[Array, " n"],
    params: Any,
    time_direction: Array | float,
    at: tuple[Array, Array, Array] | None,
) -> SparseConstants | None:
    """Values for the sparse program; None if the matrices are not sparse.

    With constraints it needs blocks of M that are definite, alone or with the rows inside of them.

    Args:
        terms: of the equations.
        q: coordinates; their number and dtype are used.
        params: as the Lagrangian takes them.
        time_direction: 1, or -1 backwards in time.
        at: (t, q, v) of the start, where the blocks are tested if they are not known to be
            definite; None if it is unknown.
    """
    regular = terms.regular or not terms.constraints
    known = True if regular else terms.blocks_definite
    tests = known is None and at is not None and q.shape[0] > LARGE
    if not (known or tests):
        return None
    sparsity = find_sparsity(terms, params, q.shape[0], q.dtype).sparsity
    if sparsity is None:
        return None
    structure = terms.structure(params, q.shape[0], q.dtype)
    found = SparseConstants(sparsity, None, None, structure.bias_zero, time_direction)
    if structure.mass_constant:
        anywhere, t = jnp.ones(q.shape, q.dtype), jnp.zeros((), jnp.result_type(float))
        mass = sparsity.mass(lambda v: terms.momentum(t, anywhere, v, params), anywhere)
        factor = factor_blocks(mass) if regular else None
        found = replace(found, inertia=mass, factor=factor)
    if known:
        return found
    assert at is not None
    t, *state = jax.lax.stop_gradient(at)
    params = jax.lax.stop_gradient(params)
    elsewhere = np.random.default_rng(0).uniform(-1.5, 1.5, (2, q.shape[0]))
    fine = []
    for here, rates in (state, jnp.asarray(elsewhere, q.dtype)):
        blocks = sparse_kkt(terms, sparsity, params, t, here, rates).augmented()[0].entries
        fine.append(jnp.all(jax.vmap(clearly_definite)(blocks)) | ~jnp.all(jnp.isfinite(blocks)))
    definite = eqxi.unvmap_all(jnp.stack(fine))
    return replace(found, definite=definite, dense=terms.precompute(q, params, time_direction))


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
        terms, constants = self.terms, self.constants
        right = terms.effort(t, q, v, params, inputs, constants.bias_zero)
        if not terms.constraints:
            return solve_blocks(self.inertia(t, q, v, params), right, constants.factor)
        kkt, active_rows = self.kkt(t, q, v, params), None
        if multiplier_rows is not None:
            active_rows = multiplier_rows.active_rows
        gamma = terms.gamma(t, q, v, params, constants.time_direction)
        return solve_sparse(kkt, right, gamma, self._factor(kkt, active_rows), active_rows)[0]

    def clearly_independent(self, t: Array, q: Array, v: Array, params: Any) -> Bool[Array, ""]:
        """Whether pivots of S are above eps^1/2, in all lanes; the blocks of M are definite."""
        factor = self._factor(self.kkt(t, q, v, params), None)
        clear = jnp.all(factor.schur.pivots > dependence_floor(q.dtype)) & factor.healthy
        clear = clear & jnp.all(jnp.isfinite(factor.schur.pivots))
        definite = self.constants.definite
        return eqxi.unvmap_all(clear if definite is None else clear & definite)

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


def row_entries(
    terms: ArrayTerms, rows: SparseRows, t: Array, params: Any, q: Float[Array, " n"]
) -> Float[Array, "m e"]:
    """The entries of every row of A that may differ from zero."""
    found = rows.of_rows.entries(lambda v: terms.velocity(t, q, v, params), jnp.zeros_like(q))
    return found.reshape(found.shape[0], -1)


class SparsityFound(NamedTuple):
    """The sparsity of a system.

    Attributes:
        sparsity: of M and A; None if solves use whole matrices.
        reason: why they do, as text.
    """

    sparsity: Sparsity | None
    reason: str = ""


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
    mass = jacobian_pattern(momentum, *given)
    mass = csr_array(mass + mass.T)
    blocks = blocks_of(mass)
    if SMALLER * blocks.size > size:
        return SparsityFound(None, f"a block of M has {blocks.size} of {size} coordinates")
    rows, holonomic = None, ()
    if constraints:
        rows = jacobian_pattern(velocity, *given)
        holonomic = layout_of(constraints, avals, static, size, dtype).holonomic
        if not rows.nnz:
            return SparsityFound(None, "no row depends on v")
        width, count = half_bandwidth(blocks, rows)[0], len(holonomic)
        if ROWS_MORE * width > count:
            reason = f"A M^-1 A^T of {count} rows has a half bandwidth of {width} or more"
            return SparsityFound(None, reason)
    found = sparsity_of(blocks, mass, rows, holonomic)
    if not _sound(found, (momentum, velocity) if constraints else (momentum,), given):
        return SparsityFound(None, "products with the entries differ from directional derivatives")
    return SparsityFound(found)


def _sound(found: Sparsity, functions: Sequence[Callable], given: tuple) -> bool:
    """Whether products with the entries are directional derivatives, in random states.

    A derivative rule may let results depend on arguments that their values do not depend on.
    """

    def products(x: Array, v: Array, *others: Any) -> list[tuple[Array, Array]]:
        def along(function: Callable) -> Array:
            return jax.jvp(lambda v: function(v, *others), (v,), (x,))[1]

        momentum, *velocity = (lambda v, f=f: f(v, *others) for f in functions)
        mass = found.mass(momentum, v)
        times = [mass.times]
        if found.constrained is not None:
            times.append(found.constrained.kkt(mass, velocity[0], v).times)
        return [(f(x), along(function)) for f, function in zip(times, functions, strict=True)]

    program = jax.make_jaxpr(products)(given[0], *given)
    allowed = float(jnp.finfo(given[0].dtype).eps) ** 0.5
    draw = np.random.default_rng(0)

    def drawn(like: Any) -> np.ndarray:
        if jnp.issubdtype(like.dtype, jnp.floating):
            return draw.uniform(0.5, 1.5, like.shape)
        return draw.integers(1, 4, like.shape).astype(like.dtype)

    for _ in range(STATES):
        results = interpret(program, *map(drawn, jax.tree.leaves((given[0], *given))))
        for ours, theirs in zip(results[0::2], results[1::2], strict=True):
            both = np.isfinite(ours) & np.isfinite(theirs)
            off, size = np.abs(ours - theirs)[both], np.max(np.abs(theirs[both]), initial=0.0)
            if not np.any(both) or np.any(off > allowed * (1.0 + size)):
                return False
    return True
