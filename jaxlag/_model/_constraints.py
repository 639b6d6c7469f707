"""Constraints A(t,q) v + b(t,q) = 0, each declared by a residual; rows have names."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._errors import invalid
from jaxlag._model._forces import EXPLICIT_TIME, AbstractForce, reads_lam
from jaxlag._tracing._signature import require_arity
from jaxlag._tracing._traced_function import traced_function, traced_unless_module


class AbstractConstraint(eqx.Module):
    """Rows of A(t,q) v + b(t,q) = 0, with the generalized force A^T lam on the system.

    Attributes:
        names: one name for all rows, or one for each.
        holonomic: whether the rows are the rates of a position residual phi(t, q) = 0.
    """

    names: eqx.AbstractVar[str | tuple[str, ...]]
    holonomic: eqx.AbstractClassVar[bool]

    @property
    def all_names(self) -> tuple[str, ...]:
        """The names as a tuple."""
        return (self.names,) if isinstance(self.names, str) else self.names

    def position(
        self, t: Float[Array, ""], q: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """phi(t, q), for holonomic constraints."""
        raise NotImplementedError

    def velocity(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """A v + b."""
        raise NotImplementedError


class Holonomic(AbstractConstraint):
    """Position constraint phi(t, q) = 0, rheonomic if phi depends on t.

    A = d phi/dq, b = d phi/dt and gamma follow from phi by automatic differentiation. The
    generalized force of the constraint on the system is A^T lam. With phi = r(q) - r0 for a
    point held at r0, lam is the force on that point (N, along the axes of r). With
    phi = |r|^2 - l^2, -2 l lam is the tension of the rod.

    Args:
        phi: function `phi(t, q, params)` returning a scalar or shape (k,).
        names: one name, and `motion.multipliers[name]` has the shape of phi, or a
            name for each of the k rows.

    Raises:
        ValueError: `phi` cannot be called in this form; names that are empty or not distinct.
            While tracing: a row without coordinates.

    Source: Pila, eqs. 3.10, 3.11, 3.118.
    """

    holonomic = True

    phi: Callable = eqx.field(static=True)
    names: str | tuple[str, ...] = eqx.field(static=True)

    def __init__(self, phi: Callable, names: str | Sequence[str]) -> None:
        self.names = _names("Holonomic", names)
        require_arity(f"constraint {names!r}: phi", phi, ("t", "q", "params"))
        self.phi = traced_function(phi)

    def position(
        self, t: Float[Array, ""], q: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """phi(t, q)."""
        return _rows(self, "phi", self.phi(t, q, params), q.dtype)

    def velocity(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """d phi/dt = A v + b, by one derivative along the motion."""
        phi = partial(self.position, params=params)
        return jax.jvp(phi, (t, q), (jnp.ones_like(t), v))[1]


class Pfaffian(AbstractConstraint):
    """Velocity constraint A(t, q) v + b(t, q) = 0, integrable or not (rolling, knife edges).

    Args:
        residual: function `residual(t, q, v, params)`, affine in v, returning a scalar or shape
            (k,). With a velocity of the contact point as residual, lam is the force on that point.
        names: one name, and `motion.multipliers[name]` has the shape of the residual,
            or a name for each of the k rows.

    Raises:
        ValueError: `residual` cannot be called in this form; names that are empty or not distinct.
            While tracing: a row that is not affine in v according to its program, or that
            contains no velocity.

    Source: Pila, eqs. 3.12, 3.14, 3.118.
    """

    holonomic = False

    residual: Callable = eqx.field(static=True)
    names: str | tuple[str, ...] = eqx.field(static=True)

    def __init__(self, residual: Callable, names: str | Sequence[str]) -> None:
        self.names = _names("Pfaffian", names)
        require_arity(f"constraint {names!r}: residual", residual, ("t", "q", "v", "params"))
        self.residual = traced_unless_module(residual)

    def velocity(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """The residual."""
        return _rows(self, "residual", self.residual(t, q, v, params), q.dtype)


@dataclass(frozen=True)
class Baumgarte:
    """Stabilization A a + gamma + 2 alpha (A v + b) + beta^2 phi = 0 instead of projection.

    Residuals decay at the rates alpha +- sqrt(alpha^2 - beta^2), but are never zero. Rates that
    are not small against 1/h make the equations stiff. Rows without phi use alpha alone.

    Attributes:
        alpha: 1/s.
        beta: 1/s.

    Source: Baumgarte, Comp. Meth. Appl. Mech. Eng. 1 (1972) 1.
    """

    alpha: float
    beta: float

    def __post_init__(self) -> None:
        for name in ("alpha", "beta"):
            value = getattr(self, name)
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not 0 <= value < float("inf"):
                raise invalid(
                    f"Baumgarte: {name}", "be a number that is not negative", f"it was {value!r}"
                )


def _names(kind: str, names: Any) -> str | tuple[str, ...]:
    given = (names,) if isinstance(names, str) else names
    fix = 'Write "rod", or ("x of pin", "y of pin") for two rows.'
    if not isinstance(given, Sequence) or not given:
        raise invalid(
            f"{kind}: names", "be a name or a sequence of names", f"it was {names!r}", fix
        )
    for name in given:
        if not isinstance(name, str) or not name:
            raise invalid(f"{kind}: names", "be non-empty strings", f"one was {name!r}", fix)
        if name == EXPLICIT_TIME:
            must = "not contain the name of the power of explicit time"
            raise invalid(f"{kind}: names", must, f"one was {name!r}", "Choose another name.")
    return names if isinstance(names, str) else tuple(given)


def _rows(constraint: AbstractConstraint, function: str, value: Any, dtype: Any) -> Array:
    """The value of a residual as a flat array; raises with the constraint's name while tracing."""
    argument = f"constraint {constraint.names!r}: {function}"
    if not eqx.is_array_like(value):
        raise invalid(argument, "return an array", f"it returned {value!r}", "Use jnp.stack.")
    value = jnp.asarray(value)
    names = constraint.names
    count = None if isinstance(names, str) else len(names)
    right = value.ndim <= 1 if count is None else value.shape in ((count,), ())
    if count not in (None, 1) and value.shape == ():
        right = False
    if not right or not jnp.issubdtype(value.dtype, jnp.floating):
        must = "a scalar or a vector" if count is None else f"{count} numbers, one for each name"
        raise invalid(
            argument, f"return {must}", f"it returned {value.dtype} of shape {value.shape}"
        )
    if value.size == 0:
        raise invalid(argument, "have at least one row", f"it returned shape {value.shape}")
    return jnp.ravel(value).astype(dtype)


def check_constraints(constraints: Any) -> tuple[AbstractConstraint, ...]:
    """Constraints as a tuple; raises unless each is one of the classes here, names distinct."""
    if isinstance(constraints, AbstractConstraint):
        fix = "Write constraints=(constraint,)."
        raise invalid("constraints", "be a sequence", "it was a single constraint", fix)
    if not isinstance(constraints, Iterable):
        was, fix = f"it was {constraints!r}", "Leave it out where there are none."
        raise invalid("constraints", "be a sequence of constraints", was, fix)
    constraints = tuple(constraints)
    names: list[str] = []
    for constraint in constraints:
        if not isinstance(constraint, AbstractConstraint):
            raise invalid(
                "constraints",
                "contain Holonomic and Pfaffian objects",
                f"one was {constraint!r}",
                'Write jl.Holonomic(phi, "name") or jl.Pfaffian(residual, "name").',
            )
        names += constraint.all_names
    for name in names:
        if names.count(name) > 1:
            was = f"{name!r} occurs {names.count(name)} times"
            raise invalid("constraints", "have distinct names", was)
    return constraints


def check_reactions(
    constraints: tuple[AbstractConstraint, ...], forces: tuple[AbstractForce, ...]
) -> None:
    """Raise unless rows and forces have distinct names, and forces read existing rows."""
    names = [name for constraint in constraints for name in constraint.all_names]
    taken = {force.name for force in forces}
    for name in names:
        if name in taken:
            was = f"{name!r} is also the name of a force"
            raise invalid("constraints", "have names that no force has", was)
    for force in filter(reads_lam, forces):
        if not constraints:
            was = "the system has none"
            raise invalid(
                f"force {force.name!r}",
                "belong to a system with constraints if it reads lam",
                was,
            )
        if force.contact is not None and force.contact not in names:
            was = f"it was {force.contact!r}"
            raise invalid(f"force {force.name!r}: contact", f"be among {names}", was)


class ConstraintRows(NamedTuple):
    """Names, shapes and kinds of the constraint rows, found by tracing.

    Attributes:
        shapes: name -> shape of its rows, in the order of the rows.
        labels: one label for every row: the name, or name[i].
        holonomic: for every row, whether it has a position residual.
        driven: for every row, whether b may differ from 0, so that the row may do work.
        sure: for every row, whether its program shows that A is more than rounding.
    """

    shapes: tuple[tuple[str, tuple[int, ...]], ...]
    labels: tuple[str, ...]
    holonomic: tuple[bool, ...]
    driven: tuple[bool, ...]
    sure: tuple[bool, ...]

    @property
    def chooses(self) -> bool:
        """Whether rows for the solves are selected: of several, or one that may be void."""
        return self.size > 1 or not all(self.sure)

    @property
    def size(self) -> int:
        """Number m of rows."""
        return len(self.labels)

    @property
    def velocity(self) -> tuple[bool, ...]:
        """For every row, whether it has no position residual."""
        return tuple(not holonomic for holonomic in self.holonomic)

    @property
    def names(self) -> tuple[str, ...]:
        """For every row its name."""
        return tuple(name for name, shape in self.shapes for _ in range(int(np.prod(shape))))

    def contradiction(self, coordinates: int) -> str:
        """Advice on contradictory rows."""
        if self.size <= coordinates:
            return ""
        return (
            f" There are {self.size} rows for {coordinates} coordinates: rows beyond that number "
            "must follow from the others."
        )

    @property
    def driven_names(self) -> tuple[str, ...]:
        """Names of rows that may do work."""
        names, row = [], 0
        for name, shape in self.shapes:
            stop = row + int(np.prod(shape))
            if any(self.driven[row:stop]):
                names.append(name)
            row = stop
        return tuple(names)

    def unflatten(self, lam: Array) -> dict[str, Array]:
        """Parts of the last axis of lam, shape (..., m), by name."""
        parts, start = {}, 0
        for name, shape in self.shapes:
            stop = start + int(np.prod(shape))
            parts[name] = lam[..., start:stop].reshape(lam.shape[:-1] + shape)
            start = stop
        return parts

    def of_all(self, phi: Array) -> Array:
        """Position residuals, shape (k,), for every row: 0 for Pfaffian rows."""
        rows = np.flatnonzero(self.holonomic)
        return jnp.zeros((self.size,), phi.dtype).at[rows].set(phi)

    def holonomic_only(self, phi: Array) -> dict[str, Array]:
        """Parts of position residuals, shape (..., k), by name."""
        parts, start, row = {}, 0, 0
        for name, shape in self.shapes:
            count = int(np.prod(shape))
            if self.holonomic[row]:
                parts[name] = phi[..., start : start + count].reshape(phi.shape[:-1] + shape)
                start += count
            row += count
        return parts


NO_ROWS = ConstraintRows((), (), (), (), ())


def position_rows(
    constraints: tuple[AbstractConstraint, ...], t: Array, q: Array, params: Any
) -> Float[Array, " k"]:
    """phi(t, q) of the holonomic rows."""
    parts = [c.position(t, q, params) for c in constraints if c.holonomic]
    return jnp.concatenate(parts) if parts else jnp.zeros((0,), q.dtype)


def velocity_rows(
    constraints: tuple[AbstractConstraint, ...], t: Array, q: Array, v: Array, params: Any
) -> Float[Array, " m"]:
    """A v + b of all rows."""
    parts = [c.velocity(t, q, v, params) for c in constraints]
    return jnp.concatenate(parts) if parts else jnp.zeros((0,), q.dtype)


def position_or_zero(
    constraints: tuple[AbstractConstraint, ...], t: Array, q: Array, params: Any
) -> Float[Array, " m"]:
    """phi(t, q) for every row, 0 for Pfaffian rows."""

    def of(c: AbstractConstraint) -> Array:
        if c.holonomic:
            return c.position(t, q, params)
        like = jax.eval_shape(lambda: c.velocity(t, q, jnp.zeros_like(q), params))
        return jnp.zeros(like.shape, q.dtype)

    return jnp.concatenate([of(c) for c in constraints])
