"""Root search for a balance of forces, independent of the units of forces and coordinates."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxlag._core._custom_jvp import CustomJVP

Forces = Callable[[Array], Array]
"""F(q), the equations F = 0, (n,) in and out."""


class Newton(NamedTuple):
    """F and its derivative J at a point, in units c of the coordinates in which J is about 1.

    `c * F` and `c J c` are in units of one energy, for all units of the coordinates.
    The pseudo-inverse omits directions in which c J c is singular up to rounding.
    """

    F: Float[Array, " n"]
    J: Float[Array, "n n"]
    c: Float[Array, " n"]
    left: Float[Array, "n n"]
    sizes: Float[Array, " n"]
    right: Float[Array, "n n"]
    regular: Bool[Array, " n"]

    def solve(self, y: Float[Array, " n"]) -> Float[Array, " n"]:
        """The x of least norm in these units with J x = y, in the least-squares sense."""
        part = self.left.T @ (self.c * y) / jnp.where(self.regular, self.sizes, 1)
        return self.c * (self.right @ jnp.where(self.regular, part, 0))

    @property
    def step(self) -> Float[Array, " n"]:
        """Step to the root of the linearized F."""
        return self.solve(-self.F)


def newton(forces: Forces, q: Float[Array, " n"]) -> Newton:
    """F, J and the singular values for Newton's method at q."""
    F, J = forces(q), jax.jacfwd(forces)(q)
    return _newton(F, J, jnp.zeros_like(J))


def _newton(F: Array, J: Array, noise: Array) -> Newton:
    c = units(J, F)
    floor = 4 * jnp.linalg.norm(c[:, None] * noise * c[None])
    return Newton(F, J, c, *decomposed(c[:, None] * J * c[None], floor))


def units(J: Float[Array, "n n"], F: Float[Array, " n"]) -> Float[Array, " n"]:
    """Units c of the coordinates in which c J c has rows and columns of largest element about 1.

    First c_j = |J_jj|^-1/2, independent of units up to a common factor. Then, for diagonals that
    are zero or small, a few sweeps of Ruiz's scaling. A coordinate without any stiffness has the
    unit in which its force equals that of the others.

    Source: Ruiz, A scaling algorithm to equilibrate both rows and columns norms in matrices,
    RAL-TR-2001-034.
    """
    d = jnp.abs(jnp.diagonal(J))
    c = jnp.where(d > 0, jax.lax.rsqrt(jnp.where(d > 0, d, 1)), 1)
    for _ in range(4):
        size = jnp.abs(c[:, None] * J * c[None])
        largest = jnp.maximum(jnp.max(size, axis=0), jnp.max(size, axis=1))
        c = c * jnp.where(largest > 0, jax.lax.rsqrt(jnp.where(largest > 0, largest, 1)), 1)
    free = ~jnp.any(J != 0, axis=0) & ~jnp.any(J != 0, axis=1)
    others = jnp.max(jnp.where(free, 0, jnp.abs(c * F)))
    others = jnp.where(others > 0, others, 1)
    return jnp.where(free, others / jnp.where(F != 0, jnp.abs(F), others), c)


def decomposed(J: Array, floor: Any = 0.0) -> tuple[Array, Array, Array, Array]:
    """(U, s, V, regular) with J = U diag(s) V^T; regular values exceed rounding and `floor`."""
    left, sizes, right = jnp.linalg.svd(J, full_matrices=False)
    rounding = 16 * J.shape[0] * float(jnp.finfo(J.dtype).eps) * jnp.max(sizes, initial=0.0)
    return left, sizes, right.T, (sizes > rounding) & (sizes > floor)


class _Damped(NamedTuple):
    c: Array
    sizes: Array
    right: Array
    part: Array
    gain: Array


class RelativeDamping(optx.AbstractDescent):
    """Levenberg-Marquardt steps damped relative to the current Jacobian.

    Solves min |J d + r|^2 + lam gain^2 |d / c|^2, with c_j the inverse norms of J's columns and
    gain = |r| / |Newton step / c|: lam = 1 about halves the Newton step, also if r has become
    flat. optimistix's own descent has lam against the constant 1.

    Attributes:
        first: lam at the start.

    Source: Marquardt, J. SIAM 11 (1963) 431 (scaling by columns); More, The Levenberg-Marquardt
    algorithm, Lecture Notes in Mathematics 630 (1978).
    """

    first: Float[Array, ""]

    def init(self, y: Any, f_info_struct: Any) -> _Damped:
        square = jnp.zeros((y.shape[0], y.shape[0]), y.dtype)
        return _Damped(y, y, square, y, jnp.zeros((), y.dtype))

    def query(self, y: Any, f_info: Any, state: Any) -> _Damped:
        J, r = f_info.jac.as_matrix(), f_info.residual
        norms = jnp.linalg.norm(J, axis=0)
        c = 1 / jnp.where(norms > 0, norms, 1)
        left, sizes, right, regular = decomposed(J * c[None])
        part, sizes = jnp.where(regular, left.T @ r, 0), jnp.where(regular, sizes, 1)
        length = jnp.linalg.norm(part / sizes)
        gain = jnp.linalg.norm(r) / jnp.where(length > 0, length, 1)
        return _Damped(c, sizes, right, part, gain)

    def step(self, step_size: Any, state: _Damped) -> Any:
        damping = self.first.astype(step_size.dtype) / step_size * state.gain**2
        d = state.part * state.sizes / (state.sizes**2 + damping)
        return -state.c * (state.right @ d), optx.RESULTS.successful


class Marquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt with `RelativeDamping`, reduced after each step with a good model."""

    rtol: float
    atol: float
    descent: RelativeDamping
    norm: Callable
    search: optx.ClassicalTrustRegion
    verbose: Callable

    def __init__(self, eps: float, descent: RelativeDamping) -> None:
        self.rtol, self.atol, self.descent = 4 * eps, eps, descent
        self.norm, self.verbose = optx.max_norm, lambda **_: None
        self.search = optx.ClassicalTrustRegion(high_cutoff=0.75)


def search(
    max_steps: int, forces: Forces, q0: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """(root or nearest point, number of steps as a float, which has a tangent)."""
    eps = float(jnp.finfo(q0.dtype).eps)
    start = newton(forces, q0)
    damping = _first_damping(forces, q0, start)
    length = jnp.linalg.norm(start.step / start.c) / (1 + damping)
    length = jnp.where((length > 0) & jnp.isfinite(length), length, 1)
    size = jnp.linalg.norm(start.c * start.F)
    size = jnp.where((size > 0) & jnp.isfinite(size), size, 1)
    wide = jnp.result_type(float)  # optimistix keeps its damping in this dtype

    def place(z: Array) -> Array:
        return q0 + start.c * length * z.astype(q0.dtype)

    def scaled(z: Array, _: Any) -> Array:
        return (start.c * forces(place(z)) / size).astype(wide)

    solver = Marquardt(eps, RelativeDamping(damping))
    z0 = jnp.zeros(q0.shape, wide)
    found = optx.least_squares(scaled, solver, z0, max_steps=max_steps, throw=False)
    near = newton(forces, place(found.value))
    q, further = place(found.value), place(found.value) + near.step
    better = jnp.linalg.norm(near.c * forces(further)) < jnp.linalg.norm(near.c * near.F)
    return jnp.where(better, further, q), jnp.asarray(found.stats["num_steps"]).astype(q0.dtype)


def _first_damping(forces: Forces, q0: Array, start: Newton) -> Array:
    """Damping by the curvature of F along the Newton step s.

    With k = |F''[s, s]| / |F|, twice the error of the step, lam = k (1, k): one exact step
    if F is linear; if J is almost singular the step that F'' allows, as for the minimum
    of |F|^2.
    """
    eps = float(jnp.finfo(q0.dtype).eps)
    s, small = start.step, eps**0.5
    change = jax.jvp(forces, (q0 + small * s,), (s,))[1] - start.J @ s
    left = jnp.linalg.norm(start.c * start.F)
    missed = jnp.linalg.norm(start.c * change) / small / jnp.where(left > 0, left, 1)
    damping = jnp.clip(missed * jnp.minimum(1, missed), eps, eps**-2)
    return jnp.where(jnp.isfinite(damping), damping, 1)


def solve_tangent(linear: Any, y: Float[Array, " n"]) -> Float[Array, " n"]:
    """The x of least norm with linear(x) = y, for `jax.lax.custom_root`; linear in y."""
    return solve_regular(jax.jacfwd(linear)(y), y)


def solve_regular(A: Float[Array, "n n"], y: Float[Array, " n"]) -> Float[Array, " n"]:
    """The x of least norm with A x = y; linear in y.

    Singular directions are projected out by matrices that are not differentiated.
    """
    fixed = jax.lax.stop_gradient(A)
    c = units(fixed, jnp.zeros_like(y))
    left, _, right, regular = decomposed(c[:, None] * fixed * c[None])
    left, right = jnp.where(regular, 0, left), jnp.where(regular, 0, right)
    scaled = c[:, None] * A * c[None] + left @ right.T
    y = c * y
    return c * jnp.linalg.solve(scaled, y - left @ (left.T @ y))


class Balance(NamedTuple):
    """The assessment of the end point of a search; `scale` as in `Equilibrium`.

    `units` are the units of the coordinates in which K is about 1.
    """

    found: Bool[Array, ""]
    finite: Bool[Array, ""]
    scale: Float[Array, " n"]
    variation: Float[Array, "n n"]
    units: Float[Array, " n"]


def judge(
    forces: Forces,
    present: Float[Array, " n"],
    q: Float[Array, " n"],
    q0: Float[Array, " n"],
    rtol: Float[Array, ""],
) -> Balance:
    """Whether q is a root of F, judged by the forces at q alone and not by those at the start.

    At a root every component of the Newton step s is small relative to the coordinate or the
    distance searched, or so small that F is linear over it up to `rtol`. Where F only decays, s is
    as long as the distance over which F changes. If F is only rounding, as near a root of higher
    order, rtol^0.4 is sufficient. In addition, F must be only rounding in directions in which J is
    singular, and the search must not have moved along these, as it does towards forces that vanish
    at infinity. J counts as singular up to its change when q moves by its rounding.

    Args:
        forces: F.
        present: |Q| + |h| at q, the forces that balance.
        q: the end point.
        q0: start of the search.
        rtol: see `equilibrium`.
    """
    n, eps = q.shape[0], float(jnp.finfo(q.dtype).eps)
    nudged = q * jnp.asarray(1 + 4 * eps * (-1.0) ** np.arange(n), q.dtype)
    J, J_beside = jax.lax.map(jax.jacfwd(forces), jnp.stack([q, nudged]))
    F = forces(q)
    here = _newton(F, J, J_beside - J)
    reach = jnp.abs(q) + jnp.abs(q - q0)
    scale = present + jnp.abs(here.J) @ reach
    s = here.step
    bend = 0.5 * jnp.abs(here.solve(jax.jvp(forces, (q + s,), (s,))[1] - here.J @ s))
    # If forces cancel inside F, its rounding is larger than its own size indicates.
    slack = jnp.asarray(4 * eps * (-1.0) ** np.arange(n), q.dtype) * reach
    beside = jax.lax.map(forces, jnp.stack([q + slack, q - slack]))
    rounding = 8 * n * eps * scale + 4 * jnp.max(jnp.abs(beside - F[None]), axis=0)
    balanced = jnp.all(jnp.abs(F) <= rounding)
    near = jnp.where(balanced, rtol**0.4, rtol) * reach
    settled = (jnp.abs(s) <= near) | (bend <= rtol * jnp.abs(s))
    across = jnp.where(here.regular, 0, here.left.T @ (here.c * here.F))
    moved = (q - q0) / here.c
    adrift = jnp.linalg.norm(jnp.where(here.regular, 0, here.right.T @ moved))
    drifted = adrift > 0.9 * jnp.linalg.norm(moved)
    found = (
        jnp.all(settled)
        & (jnp.linalg.norm(across) <= jnp.linalg.norm(here.c * rounding))
        & ~drifted
    )
    finite = jnp.all(jnp.isfinite(here.F)) & jnp.all(jnp.isfinite(here.J))
    variation = _variation(forces, here, present, rounding, q, reach)
    return Balance(found & finite, finite, scale, variation, here.c)


def _variation(
    forces: Forces, here: Newton, present: Array, rounding: Array, q: Array, reach: Array
) -> Array:
    """Change of J over a small displacement in both directions along its softest axis.

    The displacement is eps^0.4 of the coordinates there or the distance searched. If both
    are zero, it is that of the displacement by the forces present; if these are zero, eps^0.65.
    It is at least four Newton steps, and at least the uncertainty of q by rounding of F.
    """
    eps = float(jnp.finfo(q.dtype).eps)
    J = here.c[:, None] * here.J * here.c[None]
    J = jnp.where(jnp.isfinite(J), J, 0)
    axes = jnp.linalg.eigh(-0.5 * (J + J.T))[1]
    u = axes[:, 0]
    sizes = (
        jnp.max(jnp.abs(u) * reach / here.c),
        jnp.max(reach / here.c),
        jnp.max(here.c * present),
        eps**0.25 / jnp.max(here.c * jnp.abs(u)),
    )
    size = jnp.zeros((), q.dtype)
    for candidate in sizes:
        size = jnp.where(size > 0, size, candidate)
    weakest = jnp.min(jnp.where(here.regular, here.sizes, jnp.inf))
    unresolved = jnp.linalg.norm(here.c * rounding) / weakest
    steps = 4 * jnp.linalg.norm(here.step / here.c)
    d = jnp.maximum(eps**0.4 * size, jnp.maximum(steps, unresolved)) * here.c * u
    neighbors = jax.lax.map(jax.jacfwd(forces), jnp.stack([q + d, q - d]))
    return jnp.max(jnp.abs(neighbors - here.J[None]), axis=0)


@CustomJVP
def differentiable_if(known: Bool[Array, ""], x: Float[Array, " n"]) -> Float[Array, " n"]:
    """x, with NaN derivatives unless `known`."""
    return x


@differentiable_if.defjvp
def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
    known, x = primals
    factor = jnp.where(known, 1.0, jnp.nan).astype(x.dtype)
    return x, factor * tangents[1]
