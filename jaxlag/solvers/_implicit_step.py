"""Newton's method for the implicit equations of a step, converged to rounding."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import PyTree

from jaxlag._core._custom_jvp import CustomJVP

MOST, EACH = 8, 12  # Jacobians, iterations with each
MEMORY = 3  # iterations over which decreasing increments must halve


def root(residual: Callable[[Array], Array], guess: Array, rounded: Array) -> tuple[Array, Array]:
    """(z with residual(z) = 0, whether it was found), by the simplified Newton method.

    The Jacobian is kept between iterations. They stop when the increment of no component decreases,
    or when it is the last digit of the component. Increments are then rounding, so that no
    tolerance adds an error of one sign in every step. Rounding may decrease again by chance: if all
    increments are small, a component that has stopped stays so. Near an equilibrium, or where one
    coordinate rests at 0, z itself is rounding, and increments are not small relative to z. The
    Jacobian is then recomputed: if it is unchanged, the iteration contracts, and increments that do
    not decrease are noise; such components stay stopped, too. Slow iterations also continue with
    the new Jacobian.

    The derivative of z is that of the solution, dz = -(dr/dz)^-1 dr: forward, reverse, and forward
    over reverse to any order. JAX refuses reverse over reverse through a loop of steps.

    Args:
        residual: of z, shape (m,), with m components.
        guess: near the solution. It is returned if no solution was found, nan if the residual is
            not finite there.
        rounded: scale of the rounding of the first components of z, the velocities; only these
            are tested. It defines small increments, not the end of the iteration.

    Source: Hairer, Lubich, Wanner, Geometric Numerical Integration, sec. VIII.6 (iterations until
    convergence, and their round-off).
    """
    # All values of its closure, also truth values, which `jax.closure_convert` leaves inside.
    given, static = eqx.partition(eqx.filter_closure_convert(residual, guess), eqx.is_array)

    def function(z: Array, given: PyTree) -> Array:
        return eqx.combine(given, static)(z)

    @CustomJVP
    def solve(guess: Array, rounded: Array, given: PyTree) -> tuple[Array, Array]:
        return _solved(lambda z: function(z, given), guess, rounded)

    @solve.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple:
        given = primals[2]
        z, found = solve(*primals)
        r_dot = jax.jvp(lambda given: function(z, given), (given,), (tangents[2],))[1]
        slope = jax.jacfwd(lambda z: function(z, given))(z)
        return (z, found), (-jnp.linalg.solve(slope, r_dot), None)

    z, found = solve(guess, rounded, given)
    return z, found > 0


def _solved(residual: Callable, guess: Array, rounded: Array) -> tuple[Array, Array]:
    """(z, 1.0 if found): a float, as a truth value has no derivative."""
    count, eps = rounded.shape[0], jnp.finfo(guess.dtype).eps
    no, zero = jnp.asarray(False), jnp.asarray(0, jnp.int32)

    def iterate(factor: Any, z: Array, contracts: Array) -> tuple[Array, Array, Array]:
        """(z, whether increments stopped decreasing, whether they are small)."""

        def body_fun(carry: tuple) -> tuple:
            z, least, stopped, was_small, k = carry
            change = lu_solve(factor, residual(z))
            z, size = z - change, jnp.abs(change[:count])
            scale = jnp.abs(z[:count]) + jnp.abs(guess[:count])
            new = jnp.minimum(least[-1], size)
            small = jnp.all(size <= eps**0.75 * (scale + rounded))
            stopped = stopped & (contracts | (was_small & small))
            stopped = stopped | (size <= eps * scale) | ~(new < 0.5 * least[0])
            return z, jnp.stack([*least[1:], new]), stopped, small, k + 1

        def cond_fun(carry: tuple) -> Array:
            return ~jnp.all(carry[2]) & (carry[4] < EACH)

        unknown = jnp.full((MEMORY, count), jnp.inf, guess.dtype)
        init = (z, unknown, jnp.zeros(count, bool), no, zero)
        z, _, stopped, small, _ = jax.lax.while_loop(cond_fun, body_fun, init)
        return z, jnp.all(stopped) & jnp.all(jnp.isfinite(z)), small

    def anew(carry: tuple) -> tuple:
        z, slope, _, k = carry
        new = jax.jacfwd(residual)(z)
        factor = lu_factor(new)
        contracts = _radius(jnp.eye(z.shape[0], dtype=z.dtype) - lu_solve(factor, slope)) < 0.5
        z, stopped, small = iterate(factor, z, contracts)
        return z, new, stopped & (small | contracts), k + 1

    def cond_fun(carry: tuple) -> Array:
        z, _, done, k = carry
        return ~done & (k < MOST) & jnp.all(jnp.isfinite(z))

    unknown = jnp.zeros((guess.shape[0], guess.shape[0]), guess.dtype)
    z, _, done, _ = jax.lax.while_loop(cond_fun, anew, (guess, unknown, no, zero))
    guess_finite = jnp.all(jnp.isfinite(residual(guess)))
    z = jnp.where(done, z, jnp.where(guess_finite, guess, jnp.nan))
    return z, done.astype(z.dtype)


def _radius(matrix: Array) -> Array:
    """An approximation of the spectral radius, which does not depend on units."""
    power = matrix
    for _ in range(3):
        power = power @ power
    return jnp.sqrt(jnp.sum(power**2)) ** (1 / 8)
