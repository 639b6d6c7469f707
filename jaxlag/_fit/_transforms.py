"""Transforms: maps from all real numbers onto the allowed values of a parameter.

The optimizer works on unconstrained numbers u. The parameter `value(u)` is valid for every u.
"""

import math
from abc import abstractmethod
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._errors import invalid


class AbstractTransform(eqx.Module):
    """A smooth map from u of shape (k,) onto the valid values of one leaf of params."""

    @abstractmethod
    def value(self, u: Float[Array, " k"], shape: tuple[int, ...]) -> Array:
        """The parameter, of this shape."""

    @abstractmethod
    def start(self, name: str, value: Any) -> tuple[np.ndarray, bool]:
        """(u that gives this value, whether the value is on a bound).

        Raises:
            ValueError: an invalid value; `name` is its name.
        """

    def entries(self, shape: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
        """Indices of the numbers that determine the leaf, as many as there are u."""
        return tuple(np.ndindex(*shape))

    @property
    def limits(self) -> tuple[float, float]:
        """The bounds of each u."""
        return -np.inf, np.inf

    @property
    def reach(self) -> float:
        """Largest change of u in one step: logarithms are no longer linear beyond 1."""
        return 1.0


def _lower(size: int) -> tuple[tuple[int, ...], ...]:
    """Indices of a lower triangle."""
    return tuple((i, j) for i in range(size) for j in range(i + 1))


@final
class Free(AbstractTransform):
    """Any real numbers: value = u."""

    def value(self, u: Float[Array, " k"], shape: tuple[int, ...]) -> Array:
        """U itself."""
        return u.reshape(shape)

    def start(self, name: str, value: Any) -> tuple[np.ndarray, bool]:
        """The value itself."""
        return np.ravel(np.asarray(value, float)), False

    @property
    def reach(self) -> float:
        """Infinite."""
        return np.inf


@final
class Positive(AbstractTransform):
    """Positive numbers: value = exp(u).

    For numbers that cannot be zero, such as masses and lengths. Otherwise, as for friction, use
    `Bounded(0.0, np.inf)`: a logarithm that has become very negative does not return.
    """

    def value(self, u: Float[Array, " k"], shape: tuple[int, ...]) -> Array:
        """exp(u)."""
        return jnp.exp(u).reshape(shape)

    def start(self, name: str, value: Any) -> tuple[np.ndarray, bool]:
        """log(value); a value of 0 has none and raises."""
        x = np.ravel(np.asarray(value, float))
        if not np.all(x > 0):
            fix = "Start it above 0, or bound it by jl.transforms.Bounded(0.0, np.inf)."
            raise invalid(
                f"params0[{name!r}]", "be positive (jl.transforms.Positive)", f"it was {value}", fix
            )
        return np.log(x), False


@final
class Bounded(AbstractTransform):
    """Numbers between two bounds or on them: value = u, clipped to the bounds.

    A search that would leave the bounds continues along them, and returns if that is better.

    Args:
        lower: in the unit of the parameter; may be -inf.
        upper: greater than lower; may be inf, but not both.

    Raises:
        ValueError: the bounds are crossed, equal or both infinite.
    """

    lower: float
    upper: float

    def __init__(self, lower: float | int, upper: float | int) -> None:
        self.lower, self.upper = float(lower), float(upper)
        if not self.lower < self.upper:
            was = f"they were {lower} and {upper}"
            raise invalid("Bounded: lower and upper", "be in increasing order", was)
        if math.isinf(self.lower) and math.isinf(self.upper):
            raise invalid(
                "Bounded: lower and upper", "include a finite bound", "both were infinite"
            )

    def value(self, u: Float[Array, " k"], shape: tuple[int, ...]) -> Array:
        """U clipped to the bounds, with the derivative of u: a search can return from there."""
        held = jnp.clip(u, self.lower, self.upper)
        return (u + jax.lax.stop_gradient(held - u)).reshape(shape)

    def start(self, name: str, value: Any) -> tuple[np.ndarray, bool]:
        """The value itself."""
        x = np.ravel(np.asarray(value, float))
        if not np.all((x >= self.lower) & (x <= self.upper)):
            must = f"lie between its bounds {self.lower:g} and {self.upper:g}"
            raise invalid(f"params0[{name!r}]", must, f"it was {value}")
        return x, bool(np.any((x == self.lower) | (x == self.upper)))

    @property
    def limits(self) -> tuple[float, float]:
        """The bounds."""
        return self.lower, self.upper

    @property
    def reach(self) -> float:
        """Infinite: only the bounds limit a step."""
        return np.inf


@final
class SPD(AbstractTransform):
    """Symmetric positive definite (n, n) matrices by their log-Cholesky factor.

    value = C C^T, C lower triangular with exp(u) on its diagonal; k = n (n + 1) / 2.

    Source: Pinheiro, Bates, Unconstrained parametrizations for variance-covariance matrices,
    Statistics and Computing 6 (1996).
    """

    def value(self, u: Float[Array, " k"], shape: tuple[int, ...]) -> Array:
        """C C^T."""
        n = shape[0]
        lower = jnp.zeros(shape, u.dtype).at[np.tril_indices(n, -1)].set(u[n:])
        factor = lower + jnp.diag(jnp.exp(u[:n]))
        return factor @ factor.T

    def start(self, name: str, value: Any) -> tuple[np.ndarray, bool]:
        """Logarithms of the diagonal of C, then the elements below it."""
        x = np.asarray(value, float)
        if x.ndim != 2 or x.shape[0] != x.shape[1] or not np.allclose(x, x.T):
            must, was = "be a symmetric matrix", f"its shape was {x.shape}"
            raise invalid(
                f"params0[{name!r}]", must, was if x.ndim != 2 else f"it was {x.tolist()}"
            )
        try:
            factor = np.linalg.cholesky(x)
        except np.linalg.LinAlgError:
            smallest = np.linalg.eigvalsh(x)[0]
            was = f"its smallest eigenvalue was {smallest:g}"
            raise invalid(f"params0[{name!r}]", "be positive definite", was) from None
        return np.concatenate([np.log(np.diag(factor)), factor[np.tril_indices(len(x), -1)]]), False

    def entries(self, shape: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
        """The lower triangle."""
        return _lower(shape[0])


@final
class Inertia(AbstractTransform):
    """Inertias of bodies of positive density, about the center of mass.

    The leaf is a matrix (3, 3) or principal moments (3,), kg m^2. With the second moment of mass
    S = 1/2 tr(I) 1 - I, any symmetric positive definite S belongs to some body. This is stricter
    than I > 0: it includes the triangle inequalities I1 <= I2 + I3. S is the parameter, by its
    log-Cholesky factor or the logarithms of its three numbers.

    Source: Traversaro et al., Identification of fully physical consistent inertial parameters
    using optimization on manifolds, IROS 2016; Rucker, Wensing, Smooth parameterization of
    rigid-body inertia, RA-L 7 (2022).
    """

    def value(self, u: Float[Array, " k"], shape: tuple[int, ...]) -> Array:
        """tr(S) 1 - S."""
        if len(shape) == 1:
            moments = jnp.exp(u)
            return jnp.sum(moments) - moments
        second = SPD().value(u, shape)
        return jnp.trace(second) * jnp.eye(3, dtype=u.dtype) - second

    def start(self, name: str, value: Any) -> tuple[np.ndarray, bool]:
        """u of S; raises for an inertia that no body has."""
        x = np.asarray(value, float)
        if x.shape not in ((3,), (3, 3)):
            must = "be a matrix (3, 3) or three principal moments (jl.transforms.Inertia)"
            raise invalid(f"params0[{name!r}]", must, f"its shape was {x.shape}")
        moments = x if x.ndim == 1 else np.linalg.eigvalsh(x)
        second = np.sum(moments) / 2 - moments
        if not np.all(second > 0):
            must = "obey the triangle inequalities, each moment less than the sum of the others"
            raise invalid(f"params0[{name!r}]", must, f"the moments were {moments.tolist()}")
        if x.ndim == 1:
            return np.log(second), False
        return SPD().start(name, np.trace(x) / 2 * np.eye(3) - x)

    def entries(self, shape: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
        """The lower triangle, or the three moments."""
        return _lower(3) if len(shape) == 2 else ((0,), (1,), (2,))


@final
class PseudoInertia(AbstractTransform):
    """The ten inertial parameters of a body: m, m c (3), and I about the origin of the frame.

    The leaf is (10,): m [kg], m c_x, m c_y, m c_z [kg m], I_xx, I_yy, I_zz, I_xy, I_xz, I_yz
    [kg m^2], the products with the signs of the matrix. A body of positive
    density exists exactly if the pseudo-inertia [[S, m c], [m c^T, m]], S = 1/2 tr(I) 1 - I, is
    positive definite. This matrix is the parameter, by its log-Cholesky factor.

    Source: Wensing, Kim, Slotine, Linear matrix inequalities for physically consistent inertial
    parameter identification, RA-L 3 (2018); Rucker, Wensing (2022).
    """

    def value(self, u: Float[Array, " k"], shape: tuple[int, ...]) -> Array:
        """The ten numbers."""
        J = SPD().value(u, (4, 4))
        S = J[:3, :3]
        I = jnp.trace(S) * jnp.eye(3, dtype=u.dtype) - S  # noqa: E741
        products = jnp.stack([I[0, 1], I[0, 2], I[1, 2]])
        return jnp.concatenate([J[3, 3][None], J[3, :3], jnp.diag(I), products])

    def start(self, name: str, value: Any) -> tuple[np.ndarray, bool]:
        """u of the pseudo-inertia; raises for numbers that no body has."""
        x = np.asarray(value, float)
        if x.shape != (10,):
            must = "be ten numbers (jl.transforms.PseudoInertia)"
            raise invalid(f"params0[{name!r}]", must, f"its shape was {x.shape}")
        I = np.diag(x[4:7])  # noqa: E741
        I[[0, 0, 1], [1, 2, 2]] = I[[1, 2, 2], [0, 0, 1]] = x[7:]
        J = np.zeros((4, 4))
        J[:3, :3] = np.trace(I) / 2 * np.eye(3) - I
        J[3, :3] = J[:3, 3] = x[1:4]
        J[3, 3] = x[0]
        if np.linalg.eigvalsh(J)[0] <= 0:
            must = "be those of a body of positive density: a positive definite pseudo-inertia"
            was = f"its smallest eigenvalue was {np.linalg.eigvalsh(J)[0]:g}"
            raise invalid(f"params0[{name!r}]", must, was)
        return SPD().start(name, J)
