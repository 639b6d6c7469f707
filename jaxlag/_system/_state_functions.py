"""Functions of one state: terms of the equations, velocities, energies."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag._core._arguments import state_first
from jaxlag._core._arrays import common, number
from jaxlag._core._errors import invalid, unsupported
from jaxlag._lowering import AccelerationProgram, ArrayTerms, Structure
from jaxlag._model._constraints import AbstractConstraint, ConstraintRows
from jaxlag._model._coordinates import Coordinates, state_vectors
from jaxlag._model._forces import AbstractForce
from jaxlag._model._inputs import check_inputs, check_range, evaluate
from jaxlag._model._quasi_velocities import QuasiVelocities
from jaxlag._model._states import States
from jaxlag._system._power import Power
from jaxlag._tracing import _params
from jaxlag._tracing._input_values import InputValues
from jaxlag._tracing._signature import real_scalar
from jaxlag._tracing._traced_function import warn_of_changes


class AbstractQuantities(eqx.Module):
    """Quantities of a declared system as functions of (q, v, params, t).

    `params` is any pytree. q and v have shape (n,), in SI units (m or rad, and per s); t is in s.

    Attributes:
        lagrangian: L(t, q, v, params).
        coordinates: their names and shapes.
        forces: applied forces.
        constraints: constraints, those of quasi-velocities first.
        quasi: quasi-velocities, if any.
        states: states beside the coordinates, if any.
    """

    lagrangian: eqx.AbstractVar[Callable]
    coordinates: eqx.AbstractVar[Coordinates]
    forces: eqx.AbstractVar[tuple[AbstractForce, ...]]
    constraints: eqx.AbstractVar[tuple[AbstractConstraint, ...]]
    quasi: eqx.AbstractVar[QuasiVelocities | None]
    states: eqx.AbstractVar[States | None]
    _in_u: eqx.AbstractVar[Callable | None]
    _kinetic: eqx.AbstractVar[Callable | None]
    _potential: eqx.AbstractVar[Callable | None]

    @property
    def size(self) -> int:
        """Number n of scalar coordinates."""
        return self.coordinates.size

    @property
    @abstractmethod
    def _terms(self) -> ArrayTerms:
        """The terms of the equations of motion, on arrays."""

    @property
    @abstractmethod
    def _program(self) -> AccelerationProgram:
        """The program of the accelerations."""

    @abstractmethod
    def _rows(self, params: Any, dtype: Any) -> ConstraintRows:
        """Names and shapes of the constraint rows, for such params."""

    @abstractmethod
    def _structure(self, params: Any, dtype: Any) -> Structure:
        """Dependencies of M, h and L."""

    @state_first
    def mass_matrix(
        self, q: Any, v: Any = None, params: Any = None, *, t: Any = 0.0
    ) -> Float[Array, "n n"]:
        """M(t, q, v) = d2L/dv2, shape (n, n), kg, kg m or kg m^2 by the pair of coordinates.

        Symmetric; `v` may be left out if M does not depend on it.

        Source: Siciliano et al., Robotics, eq. 7.30.

        Raises:
            ValueError: q or v of wrong length; v left out although M depends on it.
        """
        t, q, v, params = self._state(q, v, params, t)
        if v is None:
            if not self._structure(params, q.dtype).quadratic:
                raise invalid(
                    "mass_matrix: v",
                    "be given, since M depends on the velocities",
                    "it was left out",
                    "Call mass_matrix(q, v, params).",
                )
            v = jnp.zeros_like(q)
        return self._terms.mass(t, q, v, params)

    @state_first
    def bias(self, q: Any, v: Any, params: Any = None, *, t: Any = 0.0) -> Float[Array, " n"]:
        """h(t, q, v) = (dp/dq) v + dp/dt - dL/dq, shape (n,), N or N m.

        The generalized force for a = 0. It includes gravity and explicit time, but not the applied
        forces.

        Source: d/dt(dL/dv) - dL/dq (Pila, eq. 3.53) minus M a.
        """
        t, q, v, params = self._state(q, v, params, t)
        return self._terms.bias(t, q, v, params)

    @state_first
    def coriolis_matrix(
        self, q: Any, v: Any, params: Any = None, *, t: Any = 0.0
    ) -> Float[Array, "n n"]:
        """C(t, q, v) from the Christoffel symbols of M, shape (n, n).

        C_ij = sum_k 1/2 (dM_ij/dq_k + dM_ik/dq_j - dM_jk/dq_i) v_k, so that
        (v . grad_q) M - 2 C is skew-symmetric. C v is the part of h that is quadratic in v. The
        other parts are gravity, terms of L linear in v and explicit time.

        Source: Siciliano et al., Robotics, eq. 7.45.

        Raises:
            ValueError: M depends on the velocities (L is not quadratic in v), where Christoffel
                symbols do not exist.
        """
        t, q, v, params = self._state(q, v, params, t)
        if not self._structure(params, q.dtype).quadratic:
            raise unsupported(
                "`coriolis_matrix` of a Lagrangian that is not quadratic in the velocities",
                "its mass matrix d2L/dv2 depends on v",
                "Use bias(q, v, params), which holds for every Lagrangian.",
            )

        def mass(q: Array) -> Array:
            return self._terms.mass(t, q, v, params)

        def momentum_along_v(q: Array) -> Array:
            return mass(q) @ v

        _, M_dot = jax.jvp(mass, (q,), (v,))
        gradient = jax.jacfwd(momentum_along_v)(q)  # d(M v)_i / dq_j at fixed v
        return 0.5 * (M_dot + gradient - gradient.T)

    @state_first
    def quasi_velocities(
        self, q: Any, v: Any, params: Any = None, *, t: Any = 0.0
    ) -> Float[Array, " k"]:
        """u = U(t, q, v), shape (k,), m/s or rad/s, constrained ones included.

        Source: Pila, eq. 4.30.

        Raises:
            ValueError: the system has no quasi-velocities.
        """
        t, q, v, params = self._state(q, v, params, t)
        return self._with_quasi("quasi_velocities").of(t, q, v, params)

    @state_first
    def velocities(self, q: Any, u: Any, params: Any = None, *, t: Any = 0.0) -> Float[Array, " n"]:
        """v = B u + c, shape (n,), m/s or rad/s, from all quasi-velocities u, shape (k,).

        NaN if dU/dv is singular. `u` may be a dict by name, without the constrained ones.

        Source: Pila, eq. 4.32.

        Raises:
            ValueError: the system has no quasi-velocities; u of wrong length.
        """
        quasi = self._with_quasi("velocities")
        u = quasi.vector("u", u)
        t, q, _, params = self._state(q, None, params, t)
        q, u = common(q, u)
        v = quasi.velocities(t, q, u, params)
        return jnp.where(quasi.regular(t, q, params), v, jnp.nan)

    def _with_quasi(self, method: str) -> QuasiVelocities:
        if self.quasi is None:
            raise unsupported(
                f"`System.{method}` without quasi-velocities",
                "the system was declared without quasi=",
            )
        return self.quasi

    @state_first
    def momentum(self, q: Any, v: Any, params: Any = None, *, t: Any = 0.0) -> Float[Array, " n"]:
        """Momentum p = dL/dv, shape (n,), kg m/s or kg m^2/s (Pila, sec. 3.13)."""
        t, q, v, params = self._state(q, v, params, t)
        return self._terms.momentum(t, q, v, params)

    @state_first
    def energy(self, q: Any, v: Any, params: Any = None, *, t: Any = 0.0) -> Float[Array, ""]:
        """H = v . dL/dv - L, scalar, J.

        T + V if T is homogeneous quadratic in v (Pila, eq. 3.207). It is constant along a motion
        without applied forces if L does not contain t.
        """
        t, q, v, params = self._state(q, v, params, t)
        lagrangian = real_scalar("lagrangian", self.lagrangian)
        L, p = jax.value_and_grad(lagrangian, argnums=2)(t, q, v, params)
        return p @ v - L

    @state_first
    def power(
        self,
        q: Any,
        v: Any,
        params: Any = None,
        *,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> dict[str, Float[Array, ""]]:
        """Terms of dH/dt = sum_k v . Q_k - b . lam - dL/dt at fixed (q, v), by name, W.

        One term for each force under its name, one for each constraint whose rows A v + b = 0
        have a nonzero b, and "explicit time" if L depends on t. The power of a force is v . Q.
        This is its whole power unless its point of application moves at fixed q.

        Args:
            q: shape (n,).
            v: shape (n,).
            params: as the Lagrangian takes them.
            t: s.
            inputs: dict from names to input objects or arrays.

        Source: Goldstein, Classical Mechanics, sec. 2.7, with applied forces.
        """
        t, q, v, params = self._state(q, v, params, t)
        values = self._inputs_at(inputs, t, q, v, params)
        return self._power_terms(params, q.dtype)(t, q, v, params, values)

    @state_first
    def state_rates(
        self,
        q: Any,
        v: Any,
        params: Any = None,
        *,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> Float[Array, " k"]:
        """dx/dt of the states beside the coordinates, shape (k,), in their units per s.

        Args:
            q: shape (n,).
            v: shape (n,).
            params: as the Lagrangian takes them.
            t: s.
            inputs: dict from names to input objects or arrays, with the states by name.

        Raises:
            ValueError: the system has no states.

        Source: the rate in `States`.
        """
        if self.states is None:
            raise unsupported("`state_rates`", "the system was declared without states=")
        t, q, v, params = self._state(q, v, params, t)
        return self.states.rates(t, q, v, params, self._inputs_at(inputs, t, q, v, params))

    def _power_terms(self, params: Any, dtype: Any) -> Power:
        """The terms of dH/dt of this system."""
        explicit_time = self._structure(params, dtype).explicit_time
        rows = self._rows(params, dtype)
        return Power(self.lagrangian, self.forces, explicit_time, self._terms, rows)

    @state_first
    def kinetic(self, q: Any, v: Any, params: Any = None, *, t: Any = 0.0) -> Float[Array, ""]:
        """T(t, q, v), scalar, J, as declared by `kinetic=`.

        Source: L = T - V (Pila, ch. 3).

        Raises:
            ValueError: the system was declared by its Lagrangian alone.
        """
        t, q, v, params = self._state(q, v, params, t)
        return self._declared("kinetic", self._kinetic)(t, q, v, params)

    @state_first
    def potential(
        self, q: Any, v: Any = None, params: Any = None, *, t: Any = 0.0
    ) -> Float[Array, ""]:
        """V(t, q), scalar, J, as declared by `potential=`; `v` is accepted and not used.

        Source: L = T - V (Pila, ch. 3).

        Raises:
            ValueError: the system was declared by its Lagrangian alone.
        """
        t, q, v, params = self._state(q, v, params, t)
        return self._declared("potential", self._potential)(t, q, params)

    def _declared(self, name: str, function: Callable | None) -> Callable:
        if function is None:
            raise unsupported(
                f"`System.{name}` of a Lagrangian alone",
                "it is known only if the system is declared by kinetic= and potential=",
            )
        return function

    def _state(self, q: Any, v: Any, params: Any, t: Any) -> tuple[Array, Array, Any, Any]:
        warn_of_changes(self)
        traced, static = _params.halves(params)
        q, v = state_vectors(self.coordinates, q, v)
        dtype = jnp.result_type(float)
        t = number("t", "be a number", t, dtype, "Use jax.vmap for several times.")
        return t, q, v, _params.join(traced, static)

    def _inputs_at(self, inputs: Any, t: Array, q: Array, v: Array, params: Any) -> InputValues:
        inputs = check_inputs(inputs)
        check_range(inputs, t, "t")
        warn_of_changes(inputs)
        return evaluate(inputs, t, q, v, params)
