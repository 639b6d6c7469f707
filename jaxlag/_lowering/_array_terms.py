"""The array program: terms by automatic differentiation of L on whole arrays."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._linalg._independent_rows import RowChoice, independent_rows, shared
from jaxlag._linalg._kkt import solve_kkt, solve_reactions, units_of
from jaxlag._linalg._mass_solve import MassFactor, factor_mass, solve_mass
from jaxlag._linalg._row_residuals import redundant_rows_hold, row_sizes
from jaxlag._lowering._row_layout import layout
from jaxlag._lowering._structure import Structure, find_structure
from jaxlag._lowering._terms import AbstractTerms, Solved
from jaxlag._model._constraints import (
    AbstractConstraint,
    Baumgarte,
    position_or_zero,
    position_rows,
    velocity_rows,
)
from jaxlag._model._forces import AbstractForce, components, reads_lam
from jaxlag._model._quasi_velocities import QuasiVelocities
from jaxlag._tracing import _params
from jaxlag._tracing._dependence import outputs_depend_on
from jaxlag._tracing._signature import gradient


class SolveConstants(eqx.Module):
    """Values that the array program computes once per solve, and terms that it omits.

    Attributes:
        mass: M if it depends on params alone, else None.
        factor: its factor.
        bias_zero: whether h = 0 in every state.
        time_direction: -1 if time runs backwards.
    """

    mass: Float[Array, "n n"] | None
    factor: MassFactor | None
    bias_zero: bool = eqx.field(static=True)
    time_direction: Array | float = 1.0


@final
class ArrayTerms(AbstractTerms):
    """M(t,q,v) a + h(t,q,v) = Q(t,q,v,inputs) + A(t,q)^T lam,   A v + b = 0,   A a + gamma = 0.

    The terms of a system from its Lagrangian, for any L that JAX differentiates twice. Methods take
    one state: t scalar (s), q and v of shape (n,), `inputs` the dict of input VALUES there. Results
    are in the units of the coordinates: M_ij a_j and h_i in N if q_i is in m, in N m
    if it is in rad.

    M takes n forward-over-reverse columns in one batch, h a single forward derivative of the
    reverse pass, so the number of evaluations of L in h does not grow with n.

    Attributes:
        lagrangian: L.
        forces: applied forces.
        constraints: constraints.
        formulation: how accelerations are solved for with constraints.
        baumgarte: stabilization added to gamma.
        regular: whether M is known to be positive definite by itself; used by the scalar
            program.
        blocks_definite: whether the blocks of a sparse M are known to be positive definite with the
            rows inside of them; None if that is unknown.
        contact_rows_independent: whether rows whose multipliers forces read are known to be
            independent.
        quasi: quasi-velocities, if the state is (q, u) with the free ones.
        in_u: L as a function of (t, q, u, params), if it was written so.
        crossing: whether rows that become dependent are left out; otherwise results are NaN.
    """

    lagrangian: Callable = eqx.field(static=True)
    forces: tuple[AbstractForce, ...]
    constraints: tuple[AbstractConstraint, ...] = ()
    formulation: str = eqx.field(static=True, default="multipliers")
    baumgarte: Baumgarte | None = eqx.field(static=True, default=None)
    regular: bool = eqx.field(static=True, default=False)
    blocks_definite: bool | None = eqx.field(static=True, default=None)
    contact_rows_independent: bool = eqx.field(static=True, default=False)
    quasi: QuasiVelocities | None = None
    in_u: Callable | None = eqx.field(static=True, default=None)
    crossing: bool = eqx.field(static=True, default=False)

    @property
    def solved(self) -> Solved:
        """How they are solved."""
        return Solved(self.formulation, self.regular, self.crossing)

    def momentum(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """Momentum p = dL/dv by one reverse pass."""
        return gradient("lagrangian", self.lagrangian, 2)(t, q, v, params)

    def mass(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, "n n"]:
        """M = dp/dv: one derivative of p along each unit velocity, batched."""

        def column(e: Float[Array, " n"]) -> Float[Array, " n"]:
            return jax.jvp(lambda v: self.momentum(t, q, v, params), (v,), (e,))[1]

        return jax.vmap(column)(jnp.eye(v.shape[0], dtype=v.dtype))

    def bias(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """Bias h = dp/dt - dL/dq at a = 0: one derivative of (dL/dq, p) along (t', q') = (1, v)."""
        gradients_of = gradient("lagrangian", self.lagrangian, (1, 2))

        def gradients(t: Array, q: Array) -> tuple[Array, Array]:
            return gradients_of(t, q, v, params)

        (dL_dq, _), (_, p_dot) = jax.jvp(gradients, (t, q), (jnp.ones_like(t), v))
        return p_dot - dL_dq

    def euler_lagrange(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        a: Float[Array, " n"],
        params: Any,
    ) -> Float[Array, " n"]:
        """The same derivative as in h, along (t', q', v') = (1, v, a)."""
        gradients_of = gradient("lagrangian", self.lagrangian, (1, 2))

        def gradients(t: Array, q: Array, v: Array) -> tuple[Array, Array]:
            return gradients_of(t, q, v, params)

        (dL_dq, _), (_, p_dot) = jax.jvp(gradients, (t, q, v), (jnp.ones_like(t), v, a))
        return p_dot - dL_dq

    def force(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        lam: Float[Array, " m"] | None = None,
    ) -> Float[Array, " n"]:
        """Q, summed over the declared forces; those that read lam only if it is given."""
        total = jnp.zeros_like(q)
        for force in self.forces:
            if not reads_lam(force):
                total = total + components(force, t, q, v, params, inputs)
        return total if lam is None else total + self.reactive(t, q, v, params, inputs, lam)

    def reactive(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        lam: Float[Array, " m"],
    ) -> Float[Array, " n"]:
        """The sum of the forces that depend on multipliers."""
        named = layout(self.constraints, params, q.shape[0], q.dtype).unflatten(lam)
        return self._reactive(t, q, v, params, inputs, named)

    def _reactive(
        self, t: Array, q: Array, v: Array, params: Any, inputs: Any, named: Mapping[str, Array]
    ) -> Array:
        total = jnp.zeros_like(q)
        for force in filter(reads_lam, self.forces):
            total = total + components(force, t, q, v, params, inputs, named)
        return total

    def rows_read(
        self, t: Array, q: Array, v: Array, params: Any, inputs: Mapping[str, Any]
    ) -> tuple[bool, ...]:
        """For every row, whether a force depends on the multipliers of its name."""
        if not any(map(reads_lam, self.forces)):
            return (False,) * layout(self.constraints, params, q.shape[0], q.dtype).size
        rows = layout(self.constraints, params, q.shape[0], q.dtype)
        named = rows.unflatten(jnp.zeros((rows.size,), q.dtype))

        def reaction(parts: list[Array]) -> Array:
            return self._reactive(t, q, v, params, inputs, dict(zip(named, parts, strict=True)))

        program = jax.make_jaxpr(reaction)(list(named.values())).jaxpr
        (reached,) = outputs_depend_on(program, [frozenset({name}) for name in named])
        reached |= {force.contact for force in self.forces if reads_lam(force) and force.contact}
        return tuple(name in reached for name in rows.names)

    def position(
        self, t: Float[Array, ""], q: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """phi(t, q) of the holonomic rows."""
        return position_rows(self.constraints, t, q, params)

    def velocity(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " m"]:
        """A v + b."""
        return velocity_rows(self.constraints, t, q, v, params)

    def rows(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """A by one reverse derivative per row, b as the residual at rest."""

        def along(v: Array) -> Array:
            return self.velocity(t, q, v, params)

        rest = jnp.zeros_like(v)
        b, vjp_fn = jax.vjp(along, rest)
        return jax.vmap(lambda e: vjp_fn(e)[0])(jnp.eye(b.shape[0], dtype=q.dtype)), b

    def rows_of(self, t: Float[Array, ""], v: Float[Array, " n"], params: Any) -> Callable:
        """A as a function of q."""
        return lambda q: self.rows(t, q, v, params)[0]

    def rows_of_position(self, t: Float[Array, ""], params: Any) -> Callable:
        """d phi/dq as a function of q, by one reverse derivative per row."""
        return jax.jacrev(lambda q: self.position(t, q, params))

    def gamma_of(self, params: Any) -> Callable:
        """Gamma as a function of (t, q, v), with Baumgarte's terms forwards in time."""
        return lambda t, q, v: self.gamma(t, q, v, params)

    def gamma(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        time_direction: Array | float = 1.0,
    ) -> Float[Array, " m"]:
        """One derivative of A v + b along (t', q') = (1, v), with Baumgarte's terms if requested.

        Residuals must also decay backwards in time: alpha has the sign of time.
        """

        def along(t: Array, q: Array) -> Array:
            return self.velocity(t, q, v, params)

        residual, gamma = jax.jvp(along, (t, q), (jnp.ones_like(t), v))
        if self.baumgarte is None:
            return gamma
        time_direction = jnp.asarray(time_direction, residual.dtype)
        gamma = gamma + 2.0 * self.baumgarte.alpha * time_direction * residual
        phi = position_or_zero(self.constraints, t, q, params)
        return gamma + self.baumgarte.beta**2 * phi

    def structure(self, params: Any, size: int, dtype: Any) -> Structure:
        """Dependencies of M, h and L, traced once per (Lagrangian, shapes, dtypes).

        Args:
            params: as the Lagrangian takes them.
            size: number n of coordinates.
            dtype: of the state.
        """
        traced, static = _params.split(params)
        avals = _params.shapes(traced)
        keys = _params.Static(avals), _params.Static(static)
        return _structure(self.lagrangian, *keys, size, jnp.dtype(dtype))

    def precompute(
        self, q: Float[Array, " n"], params: Any, time_direction: Array | float = 1.0
    ) -> SolveConstants:
        """M and its factor if M depends on params alone."""
        structure = self.structure(params, q.shape[0], q.dtype)
        if not structure.mass_constant:
            return SolveConstants(None, None, structure.bias_zero, time_direction)
        anywhere = jnp.ones(q.shape, q.dtype)
        M = self.mass(jnp.zeros((), jnp.result_type(float)), anywhere, anywhere, params)
        # Derivatives with respect to params go through M, never through the elimination.
        factor = None if self.constraints else factor_mass(jax.lax.stop_gradient(M))
        return SolveConstants(M, factor, structure.bias_zero, time_direction)

    def acceleration(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any = None,
        multiplier_rows: RowChoice | None = None,
    ) -> Float[Array, " n"]:
        """Solve M a = Q - h; constant M and zero h are not recomputed, absent forces skipped."""
        constants = self.precompute(q, params) if constants is None else constants
        M, right = self._balance(t, q, v, params, inputs, constants)
        if not self.constraints:
            return solve_mass(M, right, constants.factor)
        A, _ = self.rows(t, q, v, params)
        gamma = self.gamma(t, q, v, params, constants.time_direction)
        return self._solved(M, right, A, gamma, t, q, v, params, inputs, multiplier_rows)[0]

    def reactions(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        terms: AbstractTerms | None = None,
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """(a, lam), of least norm for dependent rows; NaN for contradictory rows.

        Args:
            t: time, s.
            q: coordinates, shape (n,).
            v: velocities, shape (n,).
            params: as the Lagrangian takes them.
            inputs: values of the inputs.
            terms: the same terms in another form; by default these.
        """
        terms, constants = self if terms is None else terms, SolveConstants(None, None, False)
        if terms is self:  # else they are short code, and to trace arrays for constants is longer
            constants = self.precompute(q, params)
        M, right = self._balance(t, q, v, params, inputs, constants, terms)
        if not self.constraints:
            return solve_mass(M, right), jnp.zeros((0,), q.dtype)
        rows, gamma = terms.rows_of(t, v, params), terms.gamma_of(params)
        stop_gradient, A = jax.lax.stop_gradient, rows(q)
        sizes = row_sizes(rows, *stop_gradient((q, A)))
        nonzero, void, _ = sizes
        if A.shape[0] == 1:
            choice = RowChoice(~void, ~void)
            a, lam = self._solved(M, right, A, gamma(t, q, v), t, q, v, params, inputs, choice)
            lam = jnp.where(void, 0.0, lam)
            fine = (nonzero | void)[0]
        else:
            read = self.rows_read(t, q, v, params, inputs)
            unread = np.logical_not(read)
            active_rows = independent_rows(
                *stop_gradient((M, A)), unread, nonzero=nonzero, mobile_first=True
            )
            choice = RowChoice(active_rows, nonzero)
            a, lam = self._solved(M, right, A, gamma(t, q, v), t, q, v, params, inputs, choice)
            units = units_of(*stop_gradient((M, A)))
            lam = shared(A, lam, active_rows, nonzero, unread, units)
            fine = redundant_rows_hold(
                *stop_gradient((A, a)), gamma, *stop_gradient(((t, q, v), sizes, right, units))
            )
        return jnp.where(fine, a, jnp.nan), jnp.where(fine, lam, jnp.nan)

    def multipliers(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: SolveConstants,
        multiplier_rows: RowChoice | None,
    ) -> Float[Array, " m"]:
        """The multipliers as forces read them, solved with these rows."""
        M, right = self._balance(t, q, v, params, inputs, constants)
        A, _ = self.rows(t, q, v, params)
        gamma = self.gamma(t, q, v, params, constants.time_direction)
        return self._solved(M, right, A, gamma, t, q, v, params, inputs, multiplier_rows)[1]

    def _solved(
        self,
        M: Array,
        right: Array,
        A: Array,
        gamma: Array,
        t: Array,
        q: Array,
        v: Array,
        params: Any,
        inputs: Mapping[str, Any],
        multiplier_rows: RowChoice | None,
    ) -> tuple[Array, Array]:
        """(a, lam) with constraints; lam as forces read it, if they do."""
        active_rows = None if multiplier_rows is None else multiplier_rows.active_rows
        if not any(map(reads_lam, self.forces)):
            return solve_kkt(
                M, A, right, gamma, active_rows, self.formulation, crossing=self.crossing
            )
        read = self.rows_read(t, q, v, params, inputs)

        def as_read(lam: Array) -> Array:
            if multiplier_rows is None or self.contact_rows_independent:
                return lam
            return shared(A, lam, *multiplier_rows, read, units_of(M, A))

        def reaction(lam: Array) -> Array:
            return self.reactive(t, q, v, params, inputs, lam)

        slopes = jax.make_jaxpr(jax.jacfwd(reaction))(gamma).jaxpr
        (reached,) = outputs_depend_on(slopes, [frozenset({"lam"})])
        reaction_as_read = lambda lam: reaction(as_read(lam))  # noqa: E731
        a, lam = solve_reactions(
            M, A, right, reaction_as_read, gamma, active_rows, affine=not reached
        )
        return a, as_read(lam)

    def _balance(
        self,
        t: Array,
        q: Array,
        v: Array,
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any,
        terms: AbstractTerms | None = None,
    ) -> tuple[Array, Array]:
        """(M, Q - h)."""
        of = self if terms is None else terms
        M = of.mass(t, q, v, params) if constants.mass is None else constants.mass
        return M, self.effort(t, q, v, params, inputs, constants.bias_zero, terms)

    def effort(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        bias_zero: bool = False,
        terms: AbstractTerms | None = None,
    ) -> Float[Array, " n"]:
        """Q - h; a zero h and absent forces are skipped."""
        of = self if terms is None else terms
        right = jnp.zeros_like(q) if bias_zero else -of.bias(t, q, v, params)
        return self.force(t, q, v, params, inputs) + right if self.forces else right


@lru_cache(maxsize=256)
def _structure(
    lagrangian: Callable, avals: _params.Static, static: _params.Static, size: int, dtype: Any
) -> Structure:
    def with_params(function: Callable) -> Callable:
        return lambda t, q, v, traced: function(t, q, v, _params.join(traced, static.tree))

    terms = ArrayTerms(lagrangian, ())
    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    q = jax.ShapeDtypeStruct((size,), dtype)
    mass, bias, L = map(with_params, (terms.mass, terms.bias, lagrangian))
    return find_structure(mass, bias, L, (t, q, q), avals.tree)
