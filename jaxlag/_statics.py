"""Static equilibrium by virtual work, and its stability."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxlag import _params
from jaxlag._arguments import check_declaration
from jaxlag._errors import EquilibriumError, bad
from jaxlag._inputs import check_inputs, check_range, evaluate
from jaxlag._status import Status
from jaxlag._system import System
from jaxlag._vectors import vector


class Equilibrium(eqx.Module):
    """A state of rest q in which all generalized forces balance, and what holds it there.

    Shapes are those of one search; after `jax.vmap` every array has the batch axes in front.

    Attributes:
        system: what is at rest.
        q: coordinates (n,), m or rad; the nearest point found where the status is not ok.
        residual: Q - h at (q, v = 0), (n,): N or N m left unbalanced.
        scale: (n,), N or N m: the forces that a residual is small against, |Q - h| at the start
            of the search plus sum_j |K_ij| (1 + |q_j|).
        stiffness: K = -d(Q - h)/dq at rest, (n, n); the Hessian of V where the forces derive from
            a potential.
        status: int32, see `Status`: ok, implicit_solve_failed or nonfinite.
        iterations: int32, steps of the search.
    """

    system: System
    q: Float[Array, "*batch n"]
    residual: Float[Array, "*batch n"]
    scale: Float[Array, "*batch n"]
    stiffness: Float[Array, "*batch n n"]
    status: Int[Array, "*batch"]
    iterations: Int[Array, "*batch"]

    def __getitem__(self, name: str) -> Array:
        """A coordinate by its name, in its declared shape."""
        return self.system.coordinates.part(self.q, name)

    @property
    def eigenvalues(self) -> Float[Array, "*batch n"]:
        """Eigenvalues of the symmetric part of K, ascending."""
        return jnp.linalg.eigvalsh(_symmetric(self.stiffness))

    @property
    def conservative(self) -> Bool[Array, "*batch"]:
        """Whether K is symmetric up to rounding, as it is where the forces have a potential."""
        K = _scaled(self.stiffness)
        slack = 64 * K.shape[-1] * jnp.finfo(K.dtype).eps
        return jnp.all(jnp.abs(K - jnp.swapaxes(K, -1, -2)) <= slack, axis=(-2, -1))

    @property
    def stable(self) -> Bool[Array, "*batch"]:
        """Whether the symmetric part of K is positive definite beyond rounding.

        Where the forces have a potential this is the Hessian of V: a strict minimum, stable by
        Lagrange's and Dirichlet's theorem; False means a saddle, a maximum, or that a higher
        order decides (a coordinate on which nothing depends). Follower forces (`conservative`
        False) can make an equilibrium flutter although this is True.

        Source: Lagrange, Mecanique analytique; Gantmacher, Lectures in Analytical Mechanics,
        sec. 34.
        """
        K = _scaled(_symmetric(self.stiffness))
        least = jnp.linalg.eigvalsh(K)[..., 0]
        return (least > 64 * K.shape[-1] * jnp.finfo(K.dtype).eps) & (self.status == int(Status.ok))

    def message(self) -> str:
        """How a single search ended, in words."""
        if self.q.ndim != 1:
            raise bad("message", "be asked of a single equilibrium", f"batch {self.q.shape[:-1]}")
        labels = self.system.coordinates.labels
        status = Status(int(self.status))
        if status is Status.ok:
            return f"ok at q = {self.q} after {int(self.iterations)} steps"
        left, scale = np.abs(self.residual), np.asarray(self.scale)
        with np.errstate(invalid="ignore"):
            relative = np.divide(left, scale, out=np.zeros_like(left), where=left != 0)
        worst = int(np.argmax(np.where(np.isfinite(relative), relative, np.inf)))
        return (
            f"{status.name}: no equilibrium was found. After {int(self.iterations)} steps the "
            f"nearest point was q = {self.q}; the force on {labels[worst]!r} left there is "
            f"{self.residual[worst]:.6g}, {relative[worst]:.1e} of its scale "
            f"{self.scale[worst]:.3g}. Start nearer to it, or see whether the forces can balance."
        )


def equilibrium(
    system: System,
    q0: Any,
    params: Any = None,
    *,
    t: Any = 0.0,
    inputs: Mapping[str, Any] | None = None,
    tol: Any = None,
    max_steps: int = 256,
    throw: bool = True,
) -> Equilibrium:
    """State of rest in which the virtual work of all forces vanishes, near q0.

    Solves Q_i(t, q, 0) - dV/dq_i = 0 for all i, more generally Q - h = 0 at v = 0, which keeps
    the terms of rotating frames (T_0) and of L linear in v. Levenberg-Marquardt on the n
    equations; M is not needed and may be singular or zero. For a system that depends on t this is
    the balance at the instant t, not a motion.

    The derivative is that of the implicit function, dq/dp = K^-1 d(Q - h)/dp, in every mode and
    order; it is not finite where K is singular.

    Args:
        system: what is at rest, n coordinates.
        q0: start of the search: (n,) numbers or a dict by name; m or rad.
        params: as the Lagrangian takes them.
        t: instant, s.
        inputs: dict from names to input objects or arrays, as in `simulate`.
        tol: residuals must be below `tol * scale` (see `Equilibrium`); by default 1e-10 in
            float64, 1e-4 in float32.
        max_steps: bound on the steps of the search.
        throw: raise where a concrete result has a status other than ok.

    Raises:
        ValueError: q0 of wrong length or not finite, tol not positive, max_steps not positive.
        EquilibriumError: none was found; says how near, and what force is left. With
            `throw=True` and concrete values.

    Source: Pila, eqs. 3.24, 3.25 (virtual work); Nocedal, Wright, Numerical Optimization,
    sec. 10.3 (Levenberg-Marquardt).

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
        raise bad("system", "be a jl.System", f"it was {system!r}")
    q0 = vector(system.coordinates, "q0", q0)
    if _params.concrete(q0) and not np.all(np.isfinite(q0)):
        raise bad("q0", "be finite", f"it was {q0}")
    if isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1:
        raise bad("max_steps", "be a positive integer", f"it was {max_steps!r}")
    if tol is None:
        tol = 1e-10 if q0.dtype == jnp.float64 else 1e-4
    tol = jnp.asarray(tol, q0.dtype)
    if _params.concrete(tol) and not (tol.ndim == 0 and tol > 0):
        raise bad("tol", "be a positive number", f"it was {tol}")
    t = jnp.asarray(t, jnp.result_type(float))
    inputs = check_inputs(inputs)
    check_range(inputs, t, "t")
    traced, static = _params.split(params)
    inputs_traced, inputs_static = eqx.partition(inputs, _params.is_array)
    key = (system, _params.Static(static), _params.Static(inputs_static), max_steps)
    found = _search(key, (q0, t, tol, traced, inputs_traced))
    if throw and _params.concrete(found.status) and int(found.status) != int(Status.ok):
        raise EquilibriumError(f"Search ended with status {found.message()}", found)
    return found


@partial(jax.jit, static_argnums=0)
def _search(key: Any, values: Any) -> Equilibrium:
    system, params_static, inputs_static, max_steps = key
    q0, t, tol, params, inputs = values
    params = _params.join(params, params_static.tree)
    inputs = eqx.combine(inputs, inputs_static.tree)
    rest = jnp.zeros_like(q0)
    check_declaration(system, params, inputs, t, q0, rest)

    def unbalanced(q: Array) -> Array:
        given = evaluate(inputs, t, q, rest, params)
        Q = system.terms.force(t, q, rest, params, given)
        return Q - system.terms.bias(t, q, rest, params)

    q, steps = jax.lax.custom_root(
        unbalanced, q0, partial(_solve, max_steps), _solve_tangent, has_aux=True
    )
    residual = unbalanced(q)
    stiffness = -jax.jacfwd(unbalanced)(q)
    scale = jnp.abs(unbalanced(q0)) + jnp.abs(stiffness) @ (1 + jnp.abs(q))
    balanced = jnp.all(jnp.abs(residual) <= tol * scale)
    finite = jnp.all(jnp.isfinite(residual)) & jnp.all(jnp.isfinite(stiffness))
    failure = jnp.where(finite, int(Status.implicit_solve_failed), int(Status.nonfinite))
    status = jnp.where(balanced & finite, int(Status.ok), failure).astype(jnp.int32)
    return Equilibrium(system, q, residual, scale, stiffness, status, steps.astype(jnp.int32))


def _solve(max_steps: int, unbalanced: Any, q0: Array) -> tuple[Array, Array]:
    """(root or nearest point, number of steps: as a float, which has a tangent)."""
    eps = float(jnp.finfo(q0.dtype).eps)
    solver = optx.LevenbergMarquardt(rtol=4 * eps, atol=eps)
    wide = jnp.result_type(float)  # optimistix keeps its damping in this dtype, whatever q's

    def widened(q: Array, _: Any) -> Array:
        return unbalanced(q.astype(q0.dtype)).astype(wide)

    found = optx.least_squares(widened, solver, q0.astype(wide), max_steps=max_steps, throw=False)
    return found.value.astype(q0.dtype), jnp.asarray(found.stats["num_steps"]).astype(q0.dtype)


def _solve_tangent(linear: Any, y: Array) -> Array:
    return jnp.linalg.solve(jax.jacfwd(linear)(y), y)


def _symmetric(K: Array) -> Array:
    return 0.5 * (K + jnp.swapaxes(K, -1, -2))


def _scaled(K: Array) -> Array:
    """K with coordinates in units in which its diagonal is +-1 where it is not 0.

    Definiteness does not depend on units (Sylvester's law), rounding does.
    """
    d = jnp.abs(jnp.diagonal(K, axis1=-2, axis2=-1))
    d = jnp.sqrt(jnp.where(d > 0, d, 1.0).astype(K.dtype))
    return K / (d[..., :, None] * d[..., None, :])
