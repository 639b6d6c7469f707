"""Terms of the equations of motion: the interface, and corrections that follow from M and A."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._linalg._kkt import augmented, correction_matrix, masked


class Solved(NamedTuple):
    """How terms are solved for accelerations and multipliers.

    Attributes:
        formulation: how accelerations are solved for with constraints.
        regular: whether M is known to be positive definite by itself.
        crossing: whether rows that become dependent are left out; otherwise results are NaN.
    """

    formulation: str
    regular: bool
    crossing: bool


class AbstractTerms(eqx.Module):
    """M(t,q,v) a + h(t,q,v) = Q(t,q,v,inputs) + A(t,q)^T lam,   A v + b = 0,   A a + gamma = 0.

    Methods take one state: t scalar (s), q and v of shape (n,). Results are in the units of the
    coordinates: M_ij a_j is in N if q_i is in m, in N m if it is in rad.
    """

    @property
    @abstractmethod
    def solved(self) -> Solved:
        """How they are solved."""

    @abstractmethod
    def mass(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, "n n"]:
        """M."""

    @abstractmethod
    def bias(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """h."""

    @abstractmethod
    def position(
        self, t: Float[Array, ""], q: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """phi(t, q) of the holonomic rows."""

    @abstractmethod
    def velocity(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " m"]:
        """A v + b."""

    @abstractmethod
    def rows(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """(A, b)."""

    @abstractmethod
    def rows_of(self, t: Float[Array, ""], v: Float[Array, " n"], params: Any) -> Callable:
        """A as a function of q."""

    @abstractmethod
    def rows_of_position(self, t: Float[Array, ""], params: Any) -> Callable:
        """d phi/dq as a function of q: the rows of A that are holonomic."""

    @abstractmethod
    def gamma_of(self, params: Any) -> Callable:
        """Gamma as a function of (t, q, v), with Baumgarte's terms forwards in time."""

    def correction(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        constants: Any = None,
        active_rows: Bool[Array, " m"] | None = None,
    ) -> Float[Array, "n m"]:
        """M^-1 A^T (A M^-1 A^T)^-1 over the active rows; the columns of the others are zero."""
        return self.corrections(t, q, v, params, constants, active_rows)[0]

    def corrections(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        constants: Any = None,
        active_rows: Bool[Array, " m"] | None = None,
        chosen: Sequence[int] | None = None,
    ) -> tuple[Float[Array, "n k"], Float[Array, " k"]]:
        """The same, and the diagonal of (A M^-1 A^T)^-1.

        For the chosen rows alone; A^T W A of all rows is added to an M that may be singular.
        """
        formulation, regular, crossing = self.solved
        M = (
            self.mass(t, q, v, params)
            if getattr(constants, "mass", None) is None
            else constants.mass
        )
        A, _ = self.rows(t, q, v, params)
        if chosen is not None:
            if not regular:
                M, _ = augmented(M, masked(A, active_rows))
            rows = np.array(chosen)
            A, active_rows = A[rows], None if active_rows is None else active_rows[rows]
        augment = chosen is None and crossing and not regular
        return correction_matrix(M, A, active_rows, formulation, crossing, augment)
