"""Static equilibrium by virtual work, and its stability."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlag._core._arguments import positive_integer, renamed
from jaxlag._core._arrays import concrete, number, of_state, stop_gradient
from jaxlag._core._batching import Chunks, at_once_implicit, in_lanes
from jaxlag._core._by_name import no_attribute
from jaxlag._core._custom_jvp import keeping_rules
from jaxlag._core._errors import EquilibriumError, invalid, shortened
from jaxlag._core._result import AbstractResult
from jaxlag._core._status import Status
from jaxlag._linalg._independent_rows import least_norm
from jaxlag._linalg._row_residuals import row_sizes, without_rounding
from jaxlag._model._constraints import ConstraintRows
from jaxlag._model._coordinates import vector
from jaxlag._model._forces import reads_lam
from jaxlag._model._inputs import check_inputs, check_range, evaluate
from jaxlag._statics._rest_search import Rest, find_rest
from jaxlag._statics._root_search import differentiable_if, solve_tangent
from jaxlag._system._closure_tracers import lift_closure_tracers
from jaxlag._system._inspection import check_declaration
from jaxlag._system._row_advice import advice_on_rows
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._traced_function import warn_of_changes


class Equilibrium(AbstractResult):
    """A state of rest q in which all generalized forces balance, with its stability.

    Shapes are those of one search; after `jax.vmap` every array has the batch axes in front.

    Attributes:
        system: the mechanical system.
        q: coordinates (n,), m or rad; the nearest point found if the status is not ok.
        residual: Q - h + A^T lam at (q, v = 0), (n,): the unbalanced force in N or N m.
        scale: (n,), N or N m: the scale of the forces, |Q| + |h| + sum_j |K_ij| (|q_j| + |q_j -
            q0_j|), all of them at q. A residual is small relative to it at a root.
        stiffness: K = -d(Q - h + A^T lam)/dq at rest and fixed lam, (n, n); the Hessian of
            V - lam . phi if the forces derive from a potential.
        damping: D = -d(Q - h)/dv at rest, (n, n): dissipation in its symmetric part, gyroscopic
            forces in the skew one.
        variation: (n, n), the change of K over a small displacement in its softest
            direction: eps^0.4 of q and the distance searched, or the uncertainty of q.
        rows: A of the constraints, (m, n).
        status: int32, see `Status`: ok, implicit_solve_failed or nonfinite.
        iterations: int32, steps of the search that found q, including those of its relaxation.
    """

    system: System
    q: Float[Array, "*batch n"]
    residual: Float[Array, "*batch n"]
    scale: Float[Array, "*batch n"]
    stiffness: Float[Array, "*batch n n"]
    damping: Float[Array, "*batch n n"]
    variation: Float[Array, "*batch n n"]
    rows: Float[Array, "*batch m n"]
    _lam: Float[Array, "*batch m"]
    status: Int[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    _layout: ConstraintRows = eqx.field(static=True)

    @property
    def multipliers(self) -> dict[str, Float[Array, "..."]]:
        """Multipliers lam by the name of the row, with Q - h + A^T lam = 0.

        For dependent rows those of least norm sum_k (|A_k| lam_k)^2.
        """
        return self._layout.unflatten(self._lam)

    def __getattr__(self, name: str) -> Any:
        if name == "lam":
            raise AttributeError("Equilibrium.lam is Equilibrium.multipliers now")
        return no_attribute(self, name)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for a single equilibrium."""
        return self.q.shape[:-1]

    def __getitem__(self, name: Any) -> Any:
        """A coordinate by its name, in its declared shape; equilibria of a batch by an index."""
        if not isinstance(name, str):
            return self._select(name)
        return self.system.coordinates.part(self.q, name)

    @property
    def eigenvalues(self) -> Float[Array, "*batch n"]:
        """Eigenvalues of the symmetric part of K, ascending; with constraints on A x = 0.

        Infinite for each direction that is held by a constraint.
        """
        K = _symmetric(self.stiffness)
        if self.rows.shape[-2] == 0:
            return jnp.linalg.eigvalsh(K)
        restricted, held = _restricted(K, self.rows)
        return jnp.where(held, jnp.inf, restricted)

    @property
    def conservative(self) -> Bool[Array, "*batch"]:
        """Whether K is symmetric up to rounding, as for forces with a potential.

        Forces that depend on velocities do not matter: see `damping`.
        """
        K = _scaled(self.stiffness, _units(self.stiffness))
        return jnp.all(jnp.abs(K - jnp.swapaxes(K, -1, -2)) <= _slack(K), axis=(-2, -1))

    @property
    def stable(self) -> Bool[Array, "*batch"]:
        """Whether the symmetric part of K is positive definite and that of D not negative.

        With constraints on their tangent space A x = 0.

        If the forces at rest have a potential, K is the Hessian of V: a strict minimum is stable
        by Lagrange's and Dirichlet's theorem, also with gyroscopic and dissipative forces
        (Thomson and Tait). With a D that supplies energy the motion grows by itself. K must be
        positive beyond rounding and beyond its own `variation`, D not negative beyond rounding.

        False means a saddle, a maximum, self-excitation, or that linear forces do not decide: a
        coordinate without any force, a higher order (V = q^3, but also V = q^4), a D that
        is not finite, or a kink of V such as zero length of a spring of length l0 > 0, where
        `energy.spring` treats |r| as constant and so reports a balance. Follower forces
        (`conservative` False) can make an equilibrium flutter although this is True.

        Source: Lagrange, Mecanique analytique; Gantmacher, Lectures in Analytical Mechanics,
        sec. 34; Merkin, Introduction to the Theory of Stability, ch. 6.
        """
        units = _units(self.stiffness)
        K, D = (_scaled(_symmetric(A), units) for A in (self.stiffness, self.damping))
        spread = jnp.linalg.norm(_scaled(self.variation, units), axis=(-2, -1))
        largest = jnp.max(jnp.abs(_scaled(self.damping, units)), axis=(-2, -1), initial=0.0)
        if self.rows.shape[-2] > 0:
            # Displacements in these units are displacements times the units.
            A = self.rows / units[..., None, :]
            softest, weakest = (jnp.min(_restricted(X, A)[0], axis=-1) for X in (K, D))
        else:
            softest, weakest = (jnp.linalg.eigvalsh(X)[..., 0] for X in (K, D))
        stiff = softest > _slack(K) + spread
        passive = weakest >= -_slack(D) * largest
        return stiff & passive & (self.status == int(Status.ok))

    def message(self) -> str:
        """How a single search ended, as text."""
        self.require_single("message")
        labels = self.system.coordinates.labels
        status = Status(int(self.status))
        if status is Status.ok:
            return f"ok at q = {shortened(self.q)} after {int(self.iterations)} steps"
        left, scale = np.abs(self.residual), np.asarray(self.scale)
        with np.errstate(invalid="ignore"):
            relative = np.divide(left, scale, out=np.zeros_like(left), where=left != 0)
        worst = int(np.argmax(np.where(np.isfinite(relative), relative, np.inf)))
        on = " on the constraints" if self.rows.shape[-2] else ""
        return shortened(
            f"{status.name}: no equilibrium was found. After {int(self.iterations)} steps the "
            f"nearest point was q = {self.q}; the remaining force on {labels[worst]!r} is "
            f"{self.residual[worst]:.6g}, {relative[worst]:.1e} of its scale "
            f"{self.scale[worst]:.3g}. Damped motion{on} from q0 and points around it did not "
            "reach an equilibrium either. Choose a closer q0, or check whether the forces can "
            "balance."
        )


@renamed(tol="rtol=")
def equilibrium(
    system: System,
    q0: Any,
    params: Any = None,
    *,
    t: Any = 0.0,
    inputs: Mapping[str, Any] | None = None,
    rtol: Any = None,
    max_steps: int = 256,
    throw: bool = True,
) -> Equilibrium:
    """State of rest in which the virtual work of all forces vanishes, near q0.

    Solves Q_i(t, q, 0) - dV/dq_i = 0 for all i, more generally Q - h = 0 at v = 0, which includes
    the terms of rotating frames (T_0) and of L linear in v. With holonomic constraints it solves
    Q - h + A^T lam = 0 and phi(t, q) = 0 for (q, lam). Levenberg-Marquardt on the n
    equations, in units in which K is about 1, so that units of q, L and Q do not matter. M is not
    needed and may be singular or zero. For a system that depends on t this is the balance at the
    instant t, not a motion. The Newton step K^-1 (Q - h) at q distinguishes a root from forces that
    only decay.

    The search takes the nearest balance, stable or not: from about upright a pendulum is found
    upright. If it fails, as in a minimum of |Q - h| that is no root, the system is moved
    onto its constraints and relaxed: damped motion (q' = Q - h + A^T lam) by implicit Euler steps.
    If the forces have a potential, each of these steps reduces V, in general to a minimum on the
    constraints. Another search refines its end. If that also fails, the system is
    relaxed from up to three states around q0, as far from it as the search has gone.

    The derivative follows from the implicit function theorem, dq/dp = K^-1 d(Q - h)/dp, in every
    mode and order. If K is singular up to rounding it is the one of least norm, in the same units:
    zero along coordinates without any force. It is NaN if the status is not ok.

    Args:
        system: the mechanical system with n coordinates.
        q0: start of the search: (n,) numbers or a dict by name; m or rad.
        params: as the Lagrangian takes them.
        t: instant, s.
        inputs: dict from names to input objects or arrays, as in `simulate`.
        rtol: Newton steps must be below rtol (|q_j| + |q_j - q0_j|), or below rtol times the
            length over which K changes; less than 1, by default 1e-10 in float64, 1e-4 in
            float32.
        max_steps: bound on the steps of the first search. What follows it is begun only while it
            has taken fewer together.
        throw: outside `jit` and `vmap`, raise for a status other than ok. Inside them nothing is
            raised: read `status`.

    Raises:
        ValueError: q0 of wrong length or not finite; t not a finite number; rtol not a number
            between 0 and 1; max_steps not positive; constraints that are not holonomic, or forces
            that depend on multipliers.
        EquilibriumError: none was found; reports the nearest point and its unbalanced force. With
            `throw=True` and concrete values.

    Source: Pila, eqs. 3.24, 3.25 (virtual work); Nocedal, Wright, Numerical Optimization,
    sec. 10.3 (Levenberg-Marquardt); Deuflhard, Newton Methods for Nonlinear Problems, ch. 2
    (interpretation of a Newton step); Kelley, Keyes, SIAM J. Numer. Anal. 35 (1998) 508
    (relaxation).

    Example:
        A mass hanging on a spring stretches it by m g / k:

        >>> import jax, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> hanging = jl.System(
        ...     coordinates=("x",),
        ...     kinetic=lambda t, q, v, p: 0.5 * p["m"] * v[0] ** 2,
        ...     potential=lambda t, q, p: 0.5 * p["k"] * q[0] ** 2 - p["m"] * 9.81 * q[0],
        ... )
        >>> rest = jl.equilibrium(hanging, [0.0], {"m": 2.0, "k": 100.0})
        >>> print(f"{rest['x']:.4f} m, stable: {rest.stable}")
        0.1962 m, stable: True
    """
    if not isinstance(system, System):
        raise invalid("system", "be a jl.System", f"it was {system!r}")
    if not all(c.holonomic for c in system.constraints) or any(map(reads_lam, system.forces)):
        raise invalid(
            "system",
            "have holonomic constraints only, and no forces that depend on multipliers",
            "it has others",
            "With these its states of rest may not be isolated: declare it without them.",
        )
    (q0,) = of_state("q0", vector(system.coordinates, "q0", q0))
    if concrete(q0) and not np.all(np.isfinite(q0)):
        raise invalid("q0", "be finite", f"it was {q0}")
    max_steps = positive_integer("max_steps", max_steps)
    if rtol is None:
        rtol = 1e-10 if q0.dtype == jnp.float64 else 1e-4
    rtol = number("rtol", "be a positive number", rtol, q0.dtype)
    if concrete(rtol) and not rtol > 0:
        raise invalid("rtol", "be a positive number", f"it was {rtol}")
    if concrete(rtol) and not rtol < 1:
        raise invalid("rtol", "be less than 1", f"it was {rtol}")
    t = number("t", "be a number", t, jnp.result_type(float))
    inputs = check_inputs(inputs)
    check_range(inputs, t, "t")
    warn_of_changes(system, inputs)
    system = system._mechanics
    traced, static = _params.split(lift_closure_tracers(system, params, q0, inputs))
    inputs_traced, inputs_static = eqx.partition(inputs, _params.is_array)
    key = (system, _params.Static(static), _params.Static(inputs_static), max_steps)
    found = _search(key, (q0, t, rtol, traced, inputs_traced))
    if throw and concrete(found.status) and int(found.status) != int(Status.ok):
        # Under grad the numbers are traced, and have values all the same.
        found = stop_gradient(found)
        more = ""
        if np.ndim(found.status) == 0 and concrete(traced, t, found.q):
            more = f" {advice_on_rows(system, params, t, found.q)}".rstrip()
        raise EquilibriumError(f"Search ended with status {found.message()}{more}", found)
    return found


@partial(jax.jit, static_argnums=0)
def _search(key: Any, values: Any) -> Equilibrium:
    system, params_static, inputs_static, max_steps = key
    q0, t, rtol, *given = values
    n, rest = q0.shape[0], jnp.zeros_like(q0)
    params = _params.join(given[0], params_static.tree)
    check_declaration(system, params, eqx.combine(given[1], inputs_static.tree), t, q0, rest)
    rows = system._rows(params, q0.dtype)
    nothing = jnp.zeros((0,), q0.dtype)

    def idle_rows(t: Array, params: Any) -> Array:
        """Rows that are 0 = 0 up to rounding at the start and nearby: their lam is 0."""
        params = _params.join(params, params_static.tree)

        def of(q: Array) -> Array:
            return system._terms.rows(t, q, rest, params)[0]

        def phi(q: Array) -> tuple[Array]:
            return (system._terms.position(t, q, params),)

        _, void, size = row_sizes(of, *jax.lax.stop_gradient((q0, of(q0))))
        (here,) = without_rounding(phi, void, size, q0)
        return void & (here == 0.0)

    idle = idle_rows(*jax.lax.stop_gradient((t, given[0]))) if rows.size else nothing > 0

    def forces(idle: Array, t: Array, params: Any, inputs: Any) -> tuple[Any, Any, Any, Any]:
        """(triple of Q, h and A; Q - h + A^T lam at (q, v); phi at q; all equations at z)."""
        params = _params.join(params, params_static.tree)
        inputs = eqx.combine(inputs, inputs_static.tree)

        def parts(q: Array, v: Array) -> tuple[Array, Array, Array]:
            given = evaluate(inputs, t, q, v, params)
            Q, h = system._terms.force(t, q, v, params, given), system._terms.bias(t, q, v, params)
            A = system._terms.rows(t, q, jnp.zeros_like(q), params)[0]
            return Q, h, jnp.where(idle[:, None], 0.0, A)

        def unbalanced(q: Array, v: Array, lam: Array) -> Array:
            Q, h, A = parts(q, v)
            return Q - h + lam @ A if rows.size else Q - h

        def phi(q: Array) -> Array:
            return jnp.where(idle, 0.0, system._terms.position(t, q, params))

        def whole(z: Array) -> Array:
            q, lam = z[:n], z[n:]
            if not rows.size:
                return unbalanced(q, jnp.zeros_like(q), lam)
            closed = phi(q) + jnp.where(idle, lam, 0.0)
            return jnp.concatenate([unbalanced(q, jnp.zeros_like(q), lam), closed])

        return parts, unbalanced, phi if rows.size else lambda _: jnp.zeros((0,), q0.dtype), whole

    def searched(q0: Array, rtol: Array, *given: Any) -> Rest:
        parts, _, phi, whole = forces(*given)

        def at_rest(q: Array) -> tuple[tuple[Array, Array], Array]:
            Q, h, A = parts(q, jnp.zeros_like(q))
            return (Q, h), A

        return find_rest(at_rest, phi, whole, q0, rtol, max_steps)

    constant = jax.lax.stop_gradient((q0, rtol, idle, t, *given))
    if jax.default_backend() == "cpu":
        chunks = Chunks(searched, at_once_implicit(n + rows.size))
        found = in_lanes(searched, lambda _: chunks, *constant)
    else:
        found = searched(*constant)
    z, balance, steps = jax.lax.stop_gradient(found)
    parts, unbalanced, _, whole = forces(idle, t, *given)

    @keeping_rules
    def root(z: Array) -> Array:
        return jax.lax.custom_root(whole, z, lambda _, z: z, solve_tangent)

    z = root(z)
    if rows.size:
        # For dependent rows the search finds the multipliers nearest to its start.
        q, lam = z[:n], z[n:]
        z = jnp.concatenate([q, least_norm(parts(q, rest)[2], lam, units=balance.units[:n])])
    z = differentiable_if(balance.found, z)
    q, lam = z[:n], z[n:]

    def unbalanced_at(state: Array) -> tuple[Array, Array]:
        residual = unbalanced(state[:n], state[n:], lam)
        return residual, residual

    slopes, residual = jax.jacfwd(unbalanced_at, has_aux=True)(jnp.concatenate([q, rest]))
    failure = jnp.where(balance.finite, int(Status.implicit_solve_failed), int(Status.nonfinite))
    return Equilibrium(
        system,
        q,
        residual=residual,
        scale=balance.scale[:n],
        stiffness=-slopes[:, :n],
        damping=-slopes[:, n:],
        variation=balance.variation[:n, :n],
        rows=parts(q, rest)[2],
        _lam=lam,
        status=jnp.where(balance.found, int(Status.ok), failure).astype(jnp.int32),
        iterations=steps,
        _layout=rows,
    )


def _restricted(K: Array, A: Array) -> tuple[Array, Array]:
    """(eigenvalues: of K on A x = 0, and larger ones for held directions; which are held)."""
    n = K.shape[-1]
    _, sizes, axes = jnp.linalg.svd(A, full_matrices=True)
    floor = 16 * n * float(jnp.finfo(K.dtype).eps)
    across = sizes > floor * sizes[..., :1]
    missing = jnp.zeros((*across.shape[:-1], n - across.shape[-1]), bool)
    across = jnp.concatenate([across, missing], -1)
    axes = jnp.swapaxes(axes, -1, -2)
    in_axes = jnp.swapaxes(axes, -1, -2) @ K @ axes
    above = 2 * jnp.sum(jnp.abs(in_axes), axis=(-2, -1))[..., None] + 1
    free = ~(across[..., :, None] | across[..., None, :])
    free_block = jnp.where(free, in_axes, 0.0)
    diagonal = jnp.where(across, above, 0.0)[..., None] * jnp.eye(n, dtype=K.dtype)
    found = jnp.linalg.eigvalsh(free_block + diagonal)
    return found, found > 0.75 * above


def _symmetric(K: Array) -> Array:
    return 0.5 * (K + jnp.swapaxes(K, -1, -2))


def _units(K: Array) -> Array:
    """Units of the coordinates in which nonzero diagonal elements of K are +-1."""
    d = jnp.abs(jnp.diagonal(K, axis1=-2, axis2=-1))
    return jnp.sqrt(jnp.where(d > 0, d, 1.0).astype(K.dtype))


def _scaled(A: Array, units: Array) -> Array:
    """A matrix in these units.

    Definiteness does not depend on units (Sylvester's law), but rounding does.
    """
    return A / (units[..., :, None] * units[..., None, :])


def _slack(K: Array) -> float:
    return 64 * K.shape[-1] * float(jnp.finfo(K.dtype).eps)
