"""System: the declaration of a mechanical system."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag import _params
from jaxlag._coordinates import Coordinates
from jaxlag._errors import bad, real_scalar, require_arity
from jaxlag._explain import explain
from jaxlag._forces import AbstractForce, check_forces
from jaxlag._inputs import InputValues, check_inputs, check_range, evaluate
from jaxlag._linalg import first_unhealthy
from jaxlag._lowering import OPERATIONS, ArrayTerms, ScalarTerms, Structure, find_structure
from jaxlag._power import Power
from jaxlag._terms import Terms
from jaxlag._vectors import state_vectors


class _Difference(eqx.Module):
    """L = T - V as a function that hashes by the identity of T and V."""

    kinetic: Callable = eqx.field(static=True)
    potential: Callable = eqx.field(static=True)

    def __call__(self, t: Array, q: Array, v: Array, params: Any) -> Array:
        return self.kinetic(t, q, v, params) - self.potential(t, q, params)


class System(eqx.Module):
    """A mechanical system given by its Lagrangian L(t, q, v, params).

    Equations of motion: d/dt(dL/dv) - dL/dq = Q, that is M a + h = Q with M = d2L/dv2.
    L may contain t, terms linear in v, and need not be quadratic in v; M must be positive
    definite. What needs no params is checked here, everything else at first use or by
    `check`.

    Methods that take a state are called as (params, q, v, t): `params` any pytree, q and v of
    shape (n,) in SI units (m or rad, and per s), t in s. They compose with jit, vmap and every
    derivative of JAX. A system hashes by the identity of its functions: declare it once, not
    in a loop, or every declaration compiles anew.

    Args:
        lagrangian: scalar function `L(t, q, v, params)`, in J. Either this, or both of
            `kinetic` and `potential`.
        coordinates: names, or names with shapes `{"x": (8, 3), "theta": ()}`; L receives q
            and v flat, `unflatten` gives the parts.
        kinetic: scalar function `T(t, q, v, params)`, in J; then L = T - V.
        potential: scalar function `V(t, q, params)`, in J.
        forces: applied forces, each with its own name: `PointForce`, `Couple`,
            `GeneralizedForce`, `Rayleigh`.
        lowering: how accelerations are compiled: "auto", as straight-line code on scalars where
            it exists and is short, else on arrays; "scalar", however long it is; "array".

    Raises:
        ValueError: neither or both ways of giving L, functions that cannot be called in these
            forms, missing or duplicate names.

    Source: Pila, Introduction to Lagrangian Dynamics, eqs. 3.50 to 3.56; Goldstein, Classical
    Mechanics, sec. 1.4.
    """

    lagrangian: Callable = eqx.field(static=True)
    coordinates: Coordinates = eqx.field(static=True)
    forces: tuple[AbstractForce, ...]
    lowering: str = eqx.field(static=True)
    _kinetic: Callable | None = eqx.field(static=True)
    _potential: Callable | None = eqx.field(static=True)

    def __init__(
        self,
        lagrangian: Callable | None = None,
        coordinates: Sequence[str] | Mapping[str, tuple[int, ...]] = (),
        *,
        kinetic: Callable | None = None,
        potential: Callable | None = None,
        forces: Sequence[AbstractForce] = (),
        lowering: str = "auto",
    ) -> None:
        pair = kinetic is not None or potential is not None
        if (lagrangian is None) == (not pair) or (pair and (kinetic is None or potential is None)):
            given = {"lagrangian": lagrangian, "kinetic": kinetic, "potential": potential}
            names = [name for name, value in given.items() if value is not None]
            raise bad(
                "System",
                "get either lagrangian, or both kinetic and potential",
                f"it got {' and '.join(names) or 'none of them'}",
            )
        if lagrangian is not None:
            require_arity("lagrangian", lagrangian, ("t", "q", "v", "params"))
            self.lagrangian = lagrangian
        else:
            assert kinetic is not None
            assert potential is not None
            require_arity("kinetic", kinetic, ("t", "q", "v", "params"))
            require_arity("potential", potential, ("t", "q", "params"))
            self.lagrangian = _Difference(kinetic, potential)
        self._kinetic, self._potential = kinetic, potential
        self.coordinates = Coordinates(coordinates)
        self.forces = check_forces(forces)
        if lowering not in ("auto", "scalar", "array"):
            raise bad("lowering", "be 'auto', 'scalar' or 'array'", f"it was {lowering!r}")
        self.lowering = lowering

    def __hash__(self) -> int:
        return hash((self.lagrangian, self.coordinates, self.forces, self.lowering))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, System) and (
            (self.lagrangian, self.coordinates, self.forces, self.lowering)
            == (other.lagrangian, other.coordinates, other.forces, other.lowering)
        )

    @property
    def terms(self) -> Terms:
        """The lowered terms of the equations of motion."""
        array = ArrayTerms(self.lagrangian, self.forces)
        if self.lowering == "array":
            return array
        return ScalarTerms(array, OPERATIONS if self.lowering == "auto" else None)

    @property
    def size(self) -> int:
        """Number n of scalar coordinates."""
        return self.coordinates.size

    def unflatten(self, q: Array) -> dict[str, Array]:
        """Named parts of q (or v, a, p), shape (..., n)."""
        return self.coordinates.unflatten(q)

    def flatten(self, parts: Mapping[str, Any]) -> Array:
        """Flat vector, shape (n,), from a dict of named values."""
        return self.coordinates.flatten(parts)

    def mass_matrix(self, params: Any, q: Any, v: Any = None, t: Any = 0.0) -> Float[Array, "n n"]:
        """M(t, q, v) = d2L/dv2, shape (n, n), kg, kg m or kg m^2 by the pair of coordinates.

        Symmetric; `v` may be left out where M does not depend on it.

        Source: Siciliano et al., Robotics, eq. 7.30.

        Raises:
            ValueError: q or v of wrong length; v left out although M depends on it.
        """
        t, q, v, params = self._state(params, q, v, t)
        if v is None:
            if not self.structure(params, q.dtype).quadratic:
                raise bad(
                    "mass_matrix: v",
                    "be given, since M depends on the velocities",
                    "it was left out",
                    "Call mass_matrix(params, q, v).",
                )
            v = jnp.zeros_like(q)
        return self.terms.mass(t, q, v, params)

    def bias(self, params: Any, q: Any, v: Any, t: Any = 0.0) -> Float[Array, " n"]:
        """h(t, q, v) = (dp/dq) v + dp/dt - dL/dq, shape (n,), N or N m.

        The generalized force needed to hold a = 0; gravity and explicit time included, applied
        forces not.

        Source: d/dt(dL/dv) - dL/dq (Pila, eq. 3.53) less M a.
        """
        t, q, v, params = self._state(params, q, v, t)
        return self.terms.bias(t, q, v, params)

    def coriolis_matrix(self, params: Any, q: Any, v: Any, t: Any = 0.0) -> Float[Array, "n n"]:
        """C(t, q, v) from the Christoffel symbols of M, shape (n, n).

        C_ij = sum_k 1/2 (dM_ij/dq_k + dM_ik/dq_j - dM_jk/dq_i) v_k, so that
        (v . grad_q) M - 2 C is skew-symmetric. C v is the part of h that is quadratic in v;
        gravity, terms of L linear in v and explicit time are the rest.

        Source: Siciliano et al., Robotics, eq. 7.45.

        Raises:
            ValueError: M depends on the velocities (L is not quadratic in v), where Christoffel
                symbols do not exist.
        """
        t, q, v, params = self._state(params, q, v, t)
        if not self.structure(params, q.dtype).quadratic:
            raise bad(
                "coriolis_matrix",
                "get a Lagrangian quadratic in the velocities",
                "its mass matrix d2L/dv2 depends on v",
                "Use bias(params, q, v), which holds for every Lagrangian.",
            )

        def mass(q: Array) -> Array:
            return self.terms.mass(t, q, v, params)

        def momentum_along_v(q: Array) -> Array:
            return mass(q) @ v

        _, M_dot = jax.jvp(mass, (q,), (v,))
        gradient = jax.jacfwd(momentum_along_v)(q)  # d(M v)_i / dq_j at fixed v
        return 0.5 * (M_dot + gradient - gradient.T)

    def generalized_force(
        self,
        params: Any,
        q: Any,
        v: Any,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
        names: Sequence[str] | None = None,
    ) -> Float[Array, " n"]:
        """Q(t, q, v, inputs), shape (n,), N or N m: the sum of the applied forces.

        Args:
            params: as the Lagrangian takes them.
            q: shape (n,).
            v: shape (n,).
            t: s.
            inputs: dict from names to input objects or arrays.
            names: only these forces; by default all, dissipation included.

        Source: Pila, sec. 3.3 (virtual work) and 3.7 (Rayleigh).

        Raises:
            ValueError: wrong lengths, unknown force names, missing inputs.
        """
        t, q, v, params = self._state(params, q, v, t)
        known = [force.name for force in self.forces]
        for name in known if names is None else names:
            if name not in known:
                raise bad("generalized_force: names", f"be among {known}", f"one was {name!r}")
        chosen = tuple(f for f in self.forces if names is None or f.name in names)
        values = self._inputs_at(inputs, t, q, v, params)
        return ArrayTerms(self.lagrangian, chosen).force(t, q, v, params, values)

    def momentum(self, params: Any, q: Any, v: Any, t: Any = 0.0) -> Float[Array, " n"]:
        """Momentum p = dL/dv, shape (n,), kg m/s or kg m^2/s (Pila, sec. 3.13)."""
        t, q, v, params = self._state(params, q, v, t)
        return self.terms.momentum(t, q, v, params)

    def energy(self, params: Any, q: Any, v: Any, t: Any = 0.0) -> Float[Array, ""]:
        """H = v . dL/dv - L, scalar, J.

        T + V where T is homogeneous quadratic in v (Pila, eq. 3.207); constant along a motion
        without applied forces if L does not contain t.
        """
        t, q, v, params = self._state(params, q, v, t)
        lagrangian = real_scalar("lagrangian", self.lagrangian)
        L, p = jax.value_and_grad(lagrangian, argnums=2)(t, q, v, params)
        return p @ v - L

    def power(
        self,
        params: Any,
        q: Any,
        v: Any,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> dict[str, Float[Array, ""]]:
        """Terms of dH/dt = sum_k v . Q_k - dL/dt at fixed (q, v), by name, W.

        One term for each force under its name, and "explicit time" where L depends on t. A force
        is credited with v . Q, which is all of its power unless its point of application moves
        at fixed q.

        Args:
            params: as the Lagrangian takes them.
            q: shape (n,).
            v: shape (n,).
            t: s.
            inputs: dict from names to input objects or arrays.

        Source: Goldstein, Classical Mechanics, sec. 2.7, with applied forces.
        """
        t, q, v, params = self._state(params, q, v, t)
        values = self._inputs_at(inputs, t, q, v, params)
        return self.power_terms(params, q.dtype)(t, q, v, params, values)

    def power_terms(self, params: Any, dtype: Any) -> Power:
        """The terms of dH/dt that this system has."""
        explicit_time = self.structure(params, dtype).explicit_time
        return Power(self.lagrangian, self.forces, explicit_time)

    def kinetic(self, params: Any, q: Any, v: Any, t: Any = 0.0) -> Float[Array, ""]:
        """T(t, q, v), scalar, J, as declared by `kinetic=`.

        Source: L = T - V (Pila, ch. 3).

        Raises:
            ValueError: the system was declared by its Lagrangian alone.
        """
        t, q, v, params = self._state(params, q, v, t)
        return self._declared("kinetic", self._kinetic)(t, q, v, params)

    def potential(self, params: Any, q: Any, v: Any = None, t: Any = 0.0) -> Float[Array, ""]:
        """V(t, q), scalar, J, as declared by `potential=`; `v` is accepted and not used.

        Source: L = T - V (Pila, ch. 3).

        Raises:
            ValueError: the system was declared by its Lagrangian alone.
        """
        t, q, v, params = self._state(params, q, v, t)
        return self._declared("potential", self._potential)(t, q, params)

    def acceleration(
        self,
        params: Any,
        q: Any,
        v: Any,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> Float[Array, " n"]:
        """Acceleration a with M a + h = Q, shape (n,), m/s^2 or rad/s^2; NaN where M is singular.

        Args:
            params: as the Lagrangian takes them.
            q: shape (n,).
            v: shape (n,).
            t: s.
            inputs: dict from names to input objects or arrays.

        Source: Pila, eq. 3.118 without constraints.
        """
        t, q, v, params = self._state(params, q, v, t)
        values = self._inputs_at(inputs, t, q, v, params)
        return self.terms.acceleration(t, q, v, params, values)

    def check(
        self,
        params: Any,
        q: Any,
        v: Any,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> None:
        """Examine the declaration at one state, with these params; silent if all is well.

        Traces L and the forces, then looks at the numbers: L (J) finite, M = d2L/dv2, shape (n, n),
        positive definite by its pivots, a with M a + h = Q finite.

        Source: Golub, Van Loan, Matrix Computations, sec. 4.1 (L D L^T and its pivots).

        Raises:
            ValueError: L not a real scalar or not finite, a force of wrong shape, missing
                inputs, a coordinate without inertia (named).
        """
        t, q, v, params = self._state(params, q, v, t)
        values = self._inputs_at(inputs, t, q, v, params)
        self.check_traceable(params, q.dtype, values)
        L = self.lagrangian(t, q, v, params)
        if not bool(jnp.isfinite(L)):
            raise bad("lagrangian", "be finite at the given state", f"it was {L}")
        index = int(first_unhealthy(self.terms.mass(t, q, v, params)))
        if index >= 0:
            raise bad(
                f"coordinate {self.coordinates.label(index)!r}",
                "have inertia: d2L/dv2 positive definite",
                f"its pivot was not positive at q = {q}, v = {v}",
                "Add its kinetic energy to L, check the sign of T, or drop the coordinate.",
            )
        a = self.terms.acceleration(t, q, v, params, values)
        if not bool(jnp.all(jnp.isfinite(a))):
            label = self.coordinates.label(int(jnp.argmin(jnp.isfinite(a))))
            raise bad(f"acceleration of {label!r}", "be finite at the given state", f"a = {a}")

    def explain(self, params: Any) -> str:
        """What was found in M a + h = Q of this system, and what is therefore skipped, as text.

        Dependencies of M, h and L on t, q, v and params are read from the traced program, never
        from numbers; so are cyclic coordinates, blocks of M and the like. Forces that read inputs
        are left out of the operations counted.
        """
        traced, static = _params.split(params)
        params = _params.join(traced, static)
        dtype = jnp.result_type(float)
        self.check_traceable(params, dtype, None)
        terms, lowered = self.terms, None
        if isinstance(terms, ScalarTerms):
            free = tuple(f for f in self.forces if not getattr(f, "takes_inputs", False))
            terms = ScalarTerms(ArrayTerms(self.lagrangian, free), terms.limit)
            lowered = terms.lowered(jax.ShapeDtypeStruct((self.size,), dtype), params, {})
        return explain(self, self.structure(params, dtype), lowered)

    def structure(self, params: Any, dtype: Any) -> Structure:
        """Dependencies of M, h and L, traced once per (system, shapes, dtypes)."""
        traced, static = _params.split(params)
        avals = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type), traced
        )
        return _structure(self, _params.Static(avals), _params.Static(static), jnp.dtype(dtype))

    def check_traceable(self, params: Any, dtype: Any, values: Any) -> None:
        """Trace L and the forces at abstract states; raise if a shape or dtype is wrong.

        Args:
            params: as the Lagrangian takes them.
            dtype: of the state.
            values: values of the inputs by name; None to leave the forces out.
        """
        t = jax.ShapeDtypeStruct((), jnp.result_type(float))
        q = v = jax.ShapeDtypeStruct((self.size,), dtype)
        traced, static = _params.split(params)
        terms = self.terms

        def all_terms(t: Array, q: Array, v: Array, traced: Any) -> Array:
            params = _params.join(traced, static)
            p = terms.momentum(t, q, v, params)
            return p if values is None else p + terms.force(t, q, v, params, values)

        jax.eval_shape(all_terms, t, q, v, traced)

    def _declared(self, name: str, function: Callable | None) -> Callable:
        if function is None:
            raise bad(
                f"System.{name}",
                "be called on a system declared by kinetic= and potential=",
                "this one was declared by its Lagrangian alone",
            )
        return function

    def _state(self, params: Any, q: Any, v: Any, t: Any) -> tuple[Array, Array, Any, Any]:
        traced, static = _params.split(params)
        q, v = state_vectors(self.coordinates, q, v)
        return jnp.asarray(t, jnp.result_type(float)), q, v, _params.join(traced, static)

    def _inputs_at(self, inputs: Any, t: Array, q: Array, v: Array, params: Any) -> InputValues:
        inputs = check_inputs(inputs)
        check_range(inputs, t, "t")
        return evaluate(inputs, t, q, v, params)


@lru_cache(maxsize=256)
def _structure(
    system: System, avals: _params.Static, static: _params.Static, dtype: Any
) -> Structure:
    def with_params(function: Callable) -> Callable:
        return lambda t, q, v, traced: function(t, q, v, _params.join(traced, static.tree))

    terms = system.terms
    mass, bias, lagrangian = map(with_params, (terms.mass, terms.bias, system.lagrangian))
    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    q = jax.ShapeDtypeStruct((system.size,), dtype)
    return find_structure(mass, bias, lagrangian, (t, q, q), avals.tree)
