"""Roots of more equations than unknowns, independent of the units of both."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxlag._statics._root_search import Marquardt, RelativeDamping, decomposed

Residuals = Callable[[Array], Array]
"""F(z), shape (m,) to (e,), of which F = 0 is wanted."""
Scale = Callable[[Array, Array, Array], Array]
"""Sizes of the terms of F from sizes of z, F and J."""
SEARCHES = 2
DAMPING = 1e-3
"""First damping: the guess is taken to be near a root."""


class LeastSquares(NamedTuple):
    """F and its derivative J at a point, in units in which J is about 1.

    Attributes:
        F: residuals.
        J: their derivatives.
        r: units of the residuals.
        c: units of the unknowns.
        left: singular vectors of (1/r) J c.
        sizes: singular values.
        right: singular vectors.
        regular: which of them exceed rounding.
    """

    F: Float[Array, " e"]
    J: Float[Array, "e k"]
    r: Float[Array, " e"]
    c: Float[Array, " k"]
    left: Float[Array, "e l"]
    sizes: Float[Array, " l"]
    right: Float[Array, "k l"]
    regular: Bool[Array, " l"]

    @property
    def inverse(self) -> Float[Array, "k e"]:
        """The pseudo-inverse of J in these units."""
        part = self.left.T / jnp.where(self.regular, self.sizes, 1)[:, None]
        return self.c[:, None] * (self.right @ jnp.where(self.regular[:, None], part, 0)) / self.r

    @property
    def step(self) -> Float[Array, " k"]:
        """The Newton step: the x of least norm with J x nearest to -F, in these units."""
        return self.inverse @ -self.F

    @property
    def beside(self) -> Float[Array, " e"]:
        """The part of F that no step of the unknowns changes."""
        F = self.F / self.r
        within = jnp.where(self.regular, self.left.T @ F, 0)
        return self.r * (F - self.left @ within)


def decomposed_at(
    F: Float[Array, " e"], J: Float[Array, "e k"], scale: Float[Array, " e"]
) -> LeastSquares:
    """The same with units and singular values; units of the residuals are their scale.

    Rows of J that are rounding stay small in these units. In those of the row itself they would
    count as much as others.
    """
    r = jnp.where((scale > 0) & jnp.isfinite(scale), scale, 1)
    largest = jnp.max(jnp.abs(J) / r[:, None], axis=0, initial=0.0)
    c = 1 / jnp.where(largest > 0, largest, 1)
    return LeastSquares(F, J, r, c, *decomposed(c[None] * J / r[:, None]))


class End(NamedTuple):
    """The end point of a search.

    Attributes:
        z: all variables.
        F: residuals.
        J: their derivatives with respect to all variables.
        steps: of the first search.
    """

    z: Float[Array, " m"]
    F: Float[Array, " e"]
    J: Float[Array, "e m"]
    steps: Int[Array, ""]


def least_squares(
    residuals: Residuals,
    scale: Scale,
    z0: Float[Array, " m"],
    free: Bool[Array, " m"],
    max_steps: int,
) -> End:
    """Root or nearest point in some of the variables z, by Levenberg-Marquardt.

    It is begun again where it ended, in the units of that point. F and J occur in one loop, so that
    their program is compiled once beside that of the search; the last turn has no search.

    Args:
        residuals: F(z).
        scale: sizes of the terms of F.
        z0: start.
        free: which of the variables are unknowns.
        max_steps: bound on the steps of each search.
    """
    wide = jnp.result_type(float)  # optimistix keeps its damping in this dtype
    eps, m = float(jnp.finfo(z0.dtype).eps), z0.shape[0]
    solver = Marquardt(eps, RelativeDamping(jnp.asarray(DAMPING, wide)))

    def searched(z: Array, near: LeastSquares) -> tuple[Array, Array]:
        size = jnp.linalg.norm(near.F / near.r)
        length = jnp.linalg.norm(near.step / near.c)
        size, length = (jnp.where((x > 0) & jnp.isfinite(x), x, 1) for x in (size, length))
        fill = jnp.zeros((max(0, m - near.F.shape[0]),), wide)

        def place(y: Array) -> Array:
            return z + jnp.where(free, near.c * length * y.astype(z.dtype), 0)

        def scaled(y: Array, _: Any) -> Array:
            return jnp.append((residuals(place(y)) / near.r / size).astype(wide), fill)

        y0 = jnp.zeros((m,), wide)
        found = optx.least_squares(scaled, solver, y0, max_steps=max_steps, throw=False)
        return place(found.value), jnp.asarray(found.stats["num_steps"], jnp.int32)

    def body(end: End, turn: Array) -> tuple[End, End]:
        both = jax.jacfwd(lambda z: (residuals(z),) * 2, has_aux=True)
        J, F = both(end.z)
        here = End(end.z, F, J, end.steps)
        near = decomposed_at(
            F, jnp.where(free, J, 0), scale(jnp.abs(end.z) + jnp.abs(end.z - z0), F, J)
        )
        z, steps = jax.lax.cond(
            turn < SEARCHES, searched, lambda z, near: (z, jnp.zeros((), jnp.int32)), end.z, near
        )
        return End(z, F, J, jnp.where(end.steps == 0, steps, end.steps)), here

    F = jax.eval_shape(residuals, z0)
    none = jnp.zeros(F.shape, F.dtype)
    start = End(z0, none, jnp.outer(none, z0), jnp.zeros((), jnp.int32))
    every = jax.lax.scan(body, start, jnp.arange(SEARCHES + 1))[1]
    return jax.tree.map(lambda x: x[-1], every)


class Root(NamedTuple):
    """The assessment of the end point of a search.

    Attributes:
        found: whether it is a root.
        finite: whether F and J are finite.
        near: F and J there.
        slack: what counts as rounding of F.
    """

    found: Bool[Array, ""]
    finite: Bool[Array, ""]
    near: LeastSquares
    slack: Float[Array, " e"]


def assessed(
    end: End,
    free: Bool[Array, " m"],
    z0: Float[Array, " m"],
    scale: Scale,
    rounding: Float[Array, " e"],
    rtol: Float[Array, ""],
) -> Root:
    """Whether the end point is a root of F, and what counts as rounding of F.

    The Newton step must be small relative to the unknown or the distance searched, or as small as
    rounding of F makes it. What no step changes must be rounding.

    Args:
        end: the end point.
        free: which of the variables are unknowns.
        z0: start of the search.
        scale: sizes of the terms of F.
        rounding: of F, beside that of its terms.
        rtol: bound on Newton steps.
    """
    z, F, J, _ = end
    sizes, eps = scale(jnp.abs(z) + jnp.abs(z - z0), F, J), float(jnp.finfo(z.dtype).eps)
    near = decomposed_at(F, jnp.where(free, J, 0), sizes)
    slack = rounding + 8 * sum(J.shape) * eps * sizes
    step, reach = jnp.abs(near.step), jnp.abs(z) + jnp.abs(z - z0)
    settled = jnp.all((step <= rtol * reach) | (step <= jnp.abs(near.inverse) @ slack))
    finite = jnp.all(jnp.isfinite(F)) & jnp.all(jnp.isfinite(J))
    left = jnp.linalg.norm(near.beside / near.r) <= jnp.linalg.norm(slack / near.r)
    return Root(settled & left & finite, finite, near, slack)
