"""Quasi-velocities u = U(t, q, v), and their kinematics v = V(t, q, u)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxlag._core._arguments import name_sequence
from jaxlag._core._arrays import real
from jaxlag._core._errors import invalid
from jaxlag._linalg._refined_qr import (
    factored,
    inverse_of,
    least_sine,
    nearest,
    refined,
    sines,
)
from jaxlag._linalg._row_residuals import row_sizes
from jaxlag._model._constraints import Pfaffian
from jaxlag._tracing._dependence import outputs_depend_on
from jaxlag._tracing._signature import require_arity
from jaxlag._tracing._traced_function import traced_function


class QuasiVelocities(eqx.Module):
    """Velocities u = U(t, q, v) = Theta^T v + theta_0 in place of v, such as body rates or slip.

    Either U is given: then v = (Theta^T)^-1 (u - theta_0) with Theta^T = dU/dv, square. Or
    `kinematics` gives v from u, v = B u + c. B may have more rows than columns. Examples are the
    rates of a quaternion, whose unit norm is a `Holonomic` constraint, and speeds
    that satisfy Pfaffian rows by definition.

    A name in `constrained` is a constraint: the row U_name = 0, whose multiplier has this name.
    In the quasi-velocity formulation it is not part of the state.

    dU/dv may be singular at some places, as at a pitch of 90 degrees or with a wheel
    steered by 90 degrees: there u does not determine v, although the motion may continue. A
    motion with u in its state ends just before such a place with the status kinematics_singular;
    with fixed steps one step before it. With formulation "auto", outside of transforms and with L
    a function of v, `simulate` then repeats the motion with multipliers, and reports this.

    Args:
        U: function `U(t, q, v, params)`, affine in v, returning shape (k,), in m/s or rad/s.
        names: k names; with U as many as there are coordinates; with `kinematics` no more than
            that, and no fewer than the constraints leave free.
        constrained: the names of quasi-velocities that are zero.
        kinematics: function `f(t, q, u, params)`, affine in u (k,), returning v, shape (n,).

    Raises:
        ValueError: neither or both of U and `kinematics`, functions that cannot be called in
            these forms, names that are empty, not distinct or unknown; no free quasi-velocity.
            While tracing: shapes that do not fit the names, functions that are not affine.

    Source: Pila, Introduction to Lagrangian Dynamics, sec. 4.3, eqs. 4.28 to 4.58; Greenwood,
    Advanced Dynamics, sec. 4.1.
    """

    U: Callable | None = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    constrained: tuple[str, ...] = eqx.field(static=True)
    kinematics: Callable | None = eqx.field(static=True)

    def __init__(
        self,
        U: Callable | None = None,
        names: Sequence[str] = (),
        constrained: Sequence[str] = (),
        *,
        kinematics: Callable | None = None,
    ) -> None:
        if (U is None) == (kinematics is None):
            was = "it got neither" if U is None else "it got both"
            fix = "Write U(t, q, v, params), or kinematics=f with f(t, q, u, params)."
            raise invalid("QuasiVelocities", "get either U or kinematics", was, fix)
        if U is not None:
            require_arity("QuasiVelocities: U", U, ("t", "q", "v", "params"))
        if kinematics is not None:
            form = ("t", "q", "u", "params")
            require_arity("QuasiVelocities: kinematics", kinematics, form)
        self.U = None if U is None else traced_function(U)
        self.kinematics = None if kinematics is None else traced_function(kinematics)
        self.names = _names("names", names)
        self.constrained = _names("constrained", constrained)
        if not self.names:
            raise invalid("QuasiVelocities: names", "name at least one", "it was empty")
        for name in self.constrained:
            if name not in self.names:
                must, was = f"be among the names {list(self.names)}", f"one was {name!r}"
                raise invalid("QuasiVelocities: constrained", must, was)
        if len(self.constrained) == len(self.names):
            raise invalid(
                "QuasiVelocities: constrained", "leave out at least one name", "it had all"
            )

    @property
    def size(self) -> int:
        """Number k of quasi-velocities, constrained ones included."""
        return len(self.names)

    @property
    def free(self) -> np.ndarray:
        """Indices of the free ones."""
        return np.array([i for i, name in enumerate(self.names) if name not in self.constrained])

    @property
    def bound(self) -> np.ndarray:
        """Indices of the constrained ones, in the order of `constrained`."""
        return np.array([self.names.index(name) for name in self.constrained], int)

    @property
    def rows(self) -> tuple[Pfaffian, ...]:
        """The constraint of the constrained names: U_name = 0 for each."""
        if not self.constrained:
            return ()
        return (Pfaffian(Vanishing(self), self.constrained),)

    def of(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """u = U(t, q, v), shape (k,), in m/s or rad/s; without U the u with B u + c nearest to v.

        The nearest u is accurate to rounding for rows of B of units up to 1e12 apart, in float32
        1e6.

        Args:
            t: time, s.
            q: coordinates, shape (n,).
            v: velocities, shape (n,).
            params: as U takes them.

        Raises:
            ValueError: the function does not return one real number for each name.
        """
        if self.U is not None:
            return self._checked("U", self.U(t, q, v, params), self.size, v.dtype)
        B, c = self._affine(t, q, v.dtype, params)
        return nearest(B, v - c)

    def velocities(
        self, t: Float[Array, ""], q: Float[Array, " n"], u: Float[Array, " k"], params: Any
    ) -> Float[Array, " n"]:
        """v = V(t, q, u), shape (n,), in m/s or rad/s; NaN where Theta^T is singular.

        Args:
            t: time, s.
            q: coordinates, shape (n,).
            u: quasi-velocities, shape (k,), constrained ones included.
            params: as U takes them.

        Raises:
            ValueError: the function does not return one real number for each coordinate.
        """
        n = q.shape[0]
        if self.kinematics is not None:
            return self._checked("kinematics", self.kinematics(t, q, u, params), n, u.dtype)

        def along(v: Array) -> Array:
            return self.of(t, q, v, params)

        rest = jnp.zeros((n,), u.dtype)
        theta_0, jvp_fn = jax.linearize(along, rest)
        theta = jax.vmap(jvp_fn)(jnp.eye(n, dtype=u.dtype))  # Theta_ij: of v_i in u_j
        size, Q, R = factored(theta)
        fine = jnp.all(jnp.abs(jnp.diagonal(R)) > least_sine(theta.dtype))

        def regular(x: Array) -> Array:
            """Replace singular values so that the derivatives of masked results are finite."""
            return jnp.where(fine, x, jnp.eye(n, dtype=x.dtype))

        theta = regular(theta)
        inverse = inverse_of(jnp.where(fine, size, 1.0), regular(Q), regular(R))
        v = lax.custom_linear_solve(
            lambda v: v @ theta,
            u - theta_0,
            lambda transposed, b: refined(lambda b: b @ inverse, transposed, b),
            lambda transposed, b: refined(lambda b: inverse @ b, transposed, b),
        )
        return jnp.where(fine, v, jnp.nan)

    def sines(
        self, t: Float[Array, ""], q: Float[Array, " n"], params: Any, dtype: Any
    ) -> Float[Array, " k"]:
        """Sine of the angle between every quasi-velocity and those before it; 0 if dependent.

        Also 0 if it vanishes up to rounding, as cos(pitch) yaw' does at a pitch of 90 degrees.

        Args:
            t: time, s.
            q: coordinates, shape (n,).
            params: as U takes them.
            dtype: dtype of velocities.
        """

        def rows(q: Array) -> Array:
            return self._columns(t, q, params, dtype).T

        here = rows(q)
        nonzero = row_sizes(rows, q, here).nonzero
        return jnp.where(nonzero, jnp.nan_to_num(sines(here.T), nan=0.0), 0.0)

    def pivots(self, t: Float[Array, ""], q: Float[Array, " n"], params: Any) -> Float[Array, " k"]:
        """Distance of the coefficients of every quasi-velocity from the span of those before it.

        The rows of dU/dv, shape (k,), or, with `kinematics`, the columns of B: |R_jj| of
        Q R = (dU/dv)^T or B.

        Args:
            t: time, s.
            q: coordinates, shape (n,), m or rad.
            params: as U takes them.
        """
        size, _, R = factored(self._columns(t, q, params, q.dtype))
        return size * jnp.abs(jnp.diagonal(R))

    def determinant(
        self, t: Float[Array, ""], q: Float[Array, " n"], params: Any
    ) -> Float[Array, ""]:
        """det dU/dv, or det B, or det B^T B for a tall B: 0 or infinite where it is singular.

        Args:
            t: time, s.
            q: coordinates, shape (n,), m or rad.
            params: as U takes them.
        """
        columns = self._columns(t, q, params, q.dtype)
        square = columns.shape[0] == columns.shape[1]
        return jnp.linalg.det(columns if square else columns.T @ columns)

    def moves(self, q: Any, params: Any) -> bool:
        """Whether dU/dv, or B, depends on time or coordinates, according to its program.

        Args:
            q: coordinates, or an array of their shape and dtype.
            params: as U takes them.
        """
        like = jax.ShapeDtypeStruct(q.shape, q.dtype)
        time = jax.ShapeDtypeStruct((), jnp.result_type(float))

        def determinant(t: Array, q: Array) -> Array:
            return self.determinant(t, q, params)

        program = jax.make_jaxpr(determinant)(time, like).jaxpr
        (found,) = outputs_depend_on(program, [frozenset("t"), frozenset("q")])
        return bool(found)

    def regular(self, t: Float[Array, ""], q: Float[Array, " n"], params: Any) -> Bool[Array, ""]:
        """Whether u and v determine each other.

        Args:
            t: time, s.
            q: coordinates, shape (n,).
            params: as U takes them.
        """
        return jnp.all(self.sines(t, q, params, q.dtype) > least_sine(q.dtype))

    def vector(self, argument: str, u: Any) -> Float[Array, " k"]:
        """All quasi-velocities from k numbers, or a dict by name; constrained ones may be left out.

        Args:
            argument: its name in errors.
            u: m/s or rad/s.

        Raises:
            ValueError: other names or another number of values.
        """
        if isinstance(u, Mapping):
            needed = [name for name in self.names if name not in self.constrained]
            if not set(needed) <= set(u) <= set(self.names):
                must = f"name {needed}" + (
                    f", may name {list(self.constrained)}," * bool(self.constrained)
                )
                raise invalid(argument, f"{must} and nothing else", f"it named {list(u)}")
            u = [u.get(name, 0.0) for name in self.names]
        x = real(argument, u)
        if x.shape != (self.size,):
            fix = f"Give one entry for each of {list(self.names)}, constrained ones included."
            raise invalid(argument, f"have shape ({self.size},)", f"its shape was {x.shape}", fix)
        return x

    def full(self, w: Float[Array, " r"]) -> Float[Array, " k"]:
        """All quasi-velocities, shape (k,), from the free ones, shape (r,); the others are zero."""
        if not self.constrained:
            return w
        return jnp.zeros((self.size,), w.dtype).at[self.free].set(w)

    def _columns(self, t: Array, q: Array, params: Any, dtype: Any) -> Array:
        """(dU/dv)^T or B: a column for every quasi-velocity."""
        if self.U is None:
            return self._affine(t, q, dtype, params)[0]
        rest = jnp.zeros(q.shape, dtype)
        return jax.jacfwd(lambda v: self.of(t, q, v, params))(rest).T

    def _affine(self, t: Array, q: Array, dtype: Any, params: Any) -> tuple[Array, Array]:
        """(B, c)."""

        def along(u: Array) -> Array:
            return self.velocities(t, q, u, params)

        c, jvp_fn = jax.linearize(along, jnp.zeros((self.size,), dtype))
        return jax.vmap(jvp_fn, out_axes=1)(jnp.eye(self.size, dtype=dtype)), c

    def _checked(self, function: str, value: Any, size: int, dtype: Any) -> Array:
        argument = f"QuasiVelocities: {function}"
        if not eqx.is_array_like(value):
            raise invalid(argument, "return an array", f"it returned {value!r}", "Use jnp.stack.")
        value = jnp.asarray(value)
        if value.shape != (size,) or not jnp.issubdtype(value.dtype, jnp.floating):
            of = "name" if function == "U" else "coordinate"
            must = f"return {size} numbers, one for each {of}"
            raise invalid(argument, must, f"it returned {value.dtype} of shape {value.shape}")
        return value.astype(dtype)


class Vanishing(eqx.Module):
    """The residual of the constrained quasi-velocities; hashes by its quasi-velocities."""

    quasi: QuasiVelocities

    def __call__(self, t: Array, q: Array, v: Array, params: Any) -> Array:
        return self.quasi.of(t, q, v, params)[self.quasi.bound]


class InQuasiVelocities(eqx.Module):
    """A function of (t, q, u, params) as a function of (t, q, v, params)."""

    function: Callable = eqx.field(static=True)
    quasi: QuasiVelocities

    def __call__(self, t: Array, q: Array, v: Array, params: Any) -> Any:
        return self.function(t, q, self.quasi.of(t, q, v, params), params)


def check_quasi(quasi: Any, n: int, taken: dict[str, str]) -> None:
    """Raise unless these can be the quasi-velocities of n coordinates.

    Args:
        quasi: the declared object.
        n: number of coordinates.
        taken: used name -> its owner.
    """
    if not isinstance(quasi, QuasiVelocities):
        must, fix = "be a jl.QuasiVelocities", "Write jl.QuasiVelocities(U, names)."
        raise invalid("quasi", must, f"it was {quasi!r}", fix)
    for name in quasi.names:
        if name in taken:
            raise invalid(
                "quasi: names", "differ from other names", f"{name!r} is also {taken[name]}"
            )
    k = quasi.size
    if quasi.kinematics is None and k != n:
        raise invalid(
            "quasi: names",
            f"be as many as there are coordinates, {n}, so that v follows from u",
            f"there were {k}",
            "Also name the combinations that constraints set to zero, in constrained=; or give v "
            "as a function of u by kinematics=.",
        )
    if k > n:
        raise invalid("quasi: names", f"be no more than the {n} coordinates", f"there were {k}")


def _names(argument: str, names: Any) -> tuple[str, ...]:
    fix = 'Write names=("wx", "wy", "wz").'
    argument = f"QuasiVelocities: {argument}"
    names = name_sequence(argument, names, fix)
    for name in names:
        if not isinstance(name, str) or not name:
            raise invalid(argument, "be non-empty strings", f"one was {name!r}", fix)
        if names.count(name) > 1:
            raise invalid(argument, "be distinct", f"{name!r} occurs {names.count(name)} times")
    return names
