"""The terms of the equations of motion, as every lowering provides them."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool, Float

from jaxlag._linalg._independent_rows import RowChoice
from jaxlag._tracing import _params


class Terms(eqx.Module):
    """M(t,q,v) a + h(t,q,v) = Q(t,q,v,inputs) + A(t,q)^T lam,   A v + b = 0,   A a + gamma = 0.

    One state at a time: t scalar (s), q and v of shape (n,), `inputs` the dict of input VALUES
    there. Everything returned is in the units of the coordinates: M_ij a_j and h_i in N where
    q_i is in m, in N m where it is in rad. A lowering turns a declared system into these
    functions; all lowerings agree to round-off.
    """

    @abstractmethod
    def momentum(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """Momentum p = dL/dv."""

    @abstractmethod
    def mass(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, "n n"]:
        """Mass matrix M = d2L/dv2."""

    @abstractmethod
    def bias(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """Bias h = (dp/dq) v + dp/dt - dL/dq, all that is left of Lagrange's equations at a = 0."""

    @abstractmethod
    def euler_lagrange(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        a: Float[Array, " n"],
        params: Any,
    ) -> Float[Array, " n"]:
        """M a + h = d/dt(dL/dv) - dL/dq along the accelerations a; M is not formed."""

    @abstractmethod
    def force(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """Q, the sum of all applied generalized forces, dissipation included."""

    @abstractmethod
    def position(
        self, t: Float[Array, ""], q: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """Residuals phi(t, q) of the holonomic rows, in their order."""

    @abstractmethod
    def velocity(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " m"]:
        """Residuals A v + b of all rows."""

    @abstractmethod
    def rows(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """(A, b) of the constraint rows; m = 0 without constraints."""

    @abstractmethod
    def gamma(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " m"]:
        """Vector gamma = A' v + b', so that A a + gamma = 0."""

    @abstractmethod
    def precompute(
        self,
        q: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        sample: _params.Sample = _params.UNKNOWN,
        kept: Bool[Array, " m"] | None = None,
        reacting: RowChoice | None = None,
        time_direction: Array | float = 1.0,
    ) -> Any:
        """What accelerations need of what depends on params alone, to be computed once per solve.

        Of q and the inputs' values only shapes and dtypes matter; `sample` holds values of the
        params where these are traced, `kept` the rows that states are going to be projected by,
        `reacting` those that accelerations are going to be solved with.
        """

    @abstractmethod
    def acceleration(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        constants: Any = None,
        reacting: RowChoice | None = None,
    ) -> Float[Array, " n"]:
        """a, with one factorisation; NaN where M is not positive definite where A a = 0.

        `prepared`: what `prepare` returned for these params; computed here if left out. `reacting`:
        independent rows that imply the others; all if left out.
        """

    @abstractmethod
    def reactions(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """(a, lam); lam of least norm where rows depend on one another, NaN where they contradict.

        Of rows that forces read among themselves, as these see them, and of the others.
        """

    @abstractmethod
    def correction(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        constants: Any = None,
        kept: Bool[Array, " m"] | None = None,
    ) -> Float[Array, "n m"]:
        """M^-1 A^T (A M^-1 A^T)^-1: takes residuals c to the x nearest to 0 with A x = c."""
