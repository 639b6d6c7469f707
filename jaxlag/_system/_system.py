"""System: the declaration of a mechanical system."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxlag._core._arguments import state_first
from jaxlag._core._by_name import no_attribute
from jaxlag._core._errors import invalid
from jaxlag._linalg._kkt import augmented
from jaxlag._linalg._mass_solve import first_unhealthy
from jaxlag._lowering import (
    OPERATIONS,
    AccelerationProgram,
    ArrayProgram,
    ArrayTerms,
    ScalarProgram,
    Structure,
    check_kinematics,
    find_sparsity,
    layout,
)
from jaxlag._model._constraints import (
    AbstractConstraint,
    ConstraintRows,
    check_constraints,
    check_reactions,
)
from jaxlag._model._coordinates import Coordinates
from jaxlag._model._forces import AbstractForce, check_forces
from jaxlag._model._inputs import check_inputs
from jaxlag._model._quasi_velocities import InQuasiVelocities, QuasiVelocities, check_quasi
from jaxlag._model._states import States, check_states
from jaxlag._system._explain import explain
from jaxlag._system._inspection import advice_on_mass, check_traceable
from jaxlag._system._nonfinite import nonfinite
from jaxlag._system._reactions import AbstractReactions
from jaxlag._system._row_advice import vanishing_rows
from jaxlag._tracing import _params
from jaxlag._tracing._signature import require_arity
from jaxlag._tracing._traced_function import as_written, traced_function


class _Difference(eqx.Module):
    """L = T - V as a function that hashes by the identity of T and V."""

    kinetic: Callable = eqx.field(static=True)
    potential: Callable = eqx.field(static=True)

    def __call__(self, t: Array, q: Array, v: Array, params: Any) -> Array:
        return self.kinetic(t, q, v, params) - self.potential(t, q, params)


_FORMERLY_PUBLIC = {
    *("terms", "rows", "structure", "power_terms", "in_u", "mass_regular", "contacts_apart"),
    *("check_traceable", "quasi_reactions"),
}


class System(AbstractReactions):
    """A mechanical system given by its Lagrangian L(t, q, v, params).

    Equations of motion: d/dt(dL/dv) - dL/dq = Q + A^T lam with A v + b = 0, that is
    M a + h = Q + A^T lam with M = d2L/dv2. L may contain t, terms linear in v, and need not be
    quadratic in v. M must be positive definite where A v = 0, so that links without mass are
    possible. Checks without params are made here, all others at first use or by `check`.

    Methods of a state are called as (q, v, params, t=t): `params` any pytree, q and v of
    shape (n,) in SI units (m or rad, and per s), t in s. Arrays and floats in params are traced,
    with derivatives in the real ones. Python ints, truth values, text and functions are part of the
    program, which recompiles for each of their values. The methods compose with jit, vmap and every
    derivative of JAX. A system hashes by the identity of its functions: declare it once, not
    in a loop, or every declaration recompiles. Every function is traced once for each kind of
    arguments (shapes, dtypes, static params). The values of its globals and closures at that time
    are used from then on, for motions, energies and accelerations. If a number, an array or a
    function among them changes later, a warning names it.

    Args:
        lagrangian: scalar function `L(t, q, v, params)`, in J. Either this, or both of
            `kinetic` and `potential`.
        coordinates: names, or names with shapes `{"x": (8, 3), "y": 3, "theta": ()}`; L receives q
            and v flat, `unflatten` returns the parts.
        kinetic: scalar function `T(t, q, v, params)`, in J; then L = T - V.
        potential: scalar function `V(t, q, params)`, in J.
        forces: applied forces, each with its own name: `PointForce`, `Torque`,
            `GeneralizedForce`, `Rayleigh`.
        constraints: `Holonomic` and `Pfaffian` constraints, each row with its own name.
        quasi: `QuasiVelocities` for the state in place of v; the constrained ones among them are
            additional rows, beside `constraints`.
        states: `States` beside the coordinates, as the current of a motor, which forces may read.
        written_in: the velocities in the arguments of L, or T: "v", or "u" for all
            quasi-velocities, as in L(t, q, u, params). L must contain the constrained ones, since
            their momenta enter the equations.
        lowering: how accelerations are compiled: "auto", as straight-line code on scalars if
            this exists and is short, else on arrays; "scalar", for any length; "array".

    Raises:
        ValueError: neither or both ways of giving L, functions that cannot be called in these
            forms, missing or duplicate names.

    Source: Pila, Introduction to Lagrangian Dynamics, eqs. 3.50 to 3.56; Goldstein, Classical
    Mechanics, sec. 1.4.
    """

    lagrangian: Callable = eqx.field(static=True)
    coordinates: Coordinates = eqx.field(static=True)
    forces: tuple[AbstractForce, ...]
    constraints: tuple[AbstractConstraint, ...]
    quasi: QuasiVelocities | None
    states: States | None
    written_in: str = eqx.field(static=True)
    lowering: str = eqx.field(static=True)
    _in_u: Callable | None = eqx.field(static=True)
    _kinetic: Callable | None = eqx.field(static=True)
    _potential: Callable | None = eqx.field(static=True)

    def __init__(
        self,
        lagrangian: Callable | None = None,
        coordinates: Sequence[str] | Mapping[str, tuple[int, ...] | int] = (),
        *,
        kinetic: Callable | None = None,
        potential: Callable | None = None,
        forces: Sequence[AbstractForce] = (),
        constraints: Sequence[AbstractConstraint] = (),
        quasi: QuasiVelocities | None = None,
        states: States | None = None,
        written_in: str = "v",
        lowering: str = "auto",
    ) -> None:
        pair = kinetic is not None or potential is not None
        if (lagrangian is None) == (not pair) or (pair and (kinetic is None or potential is None)):
            given = {"lagrangian": lagrangian, "kinetic": kinetic, "potential": potential}
            names = [name for name, value in given.items() if value is not None]
            raise invalid(
                "System",
                "get either lagrangian, or both kinetic and potential",
                f"it got {' and '.join(names) or 'none of them'}",
            )
        self.coordinates = Coordinates(coordinates)
        self.forces = check_forces(forces)
        rows = check_constraints(constraints)
        if quasi is not None:
            check_quasi(quasi, self.coordinates.size, self._taken(rows))
            rows = check_constraints((*quasi.rows, *rows))
        check_reactions(rows, self.forces)
        self.constraints, self.quasi = rows, quasi
        taken = self._taken(rows)
        taken |= {f"{name}'": "a velocity" for name in self.coordinates.names}
        taken |= {} if quasi is None else dict.fromkeys(quasi.names, "a quasi-velocity")
        self.states = check_states(states, taken)
        if written_in not in ("v", "u"):
            raise invalid("written_in", "be 'v' or 'u'", f"it was {written_in!r}")
        if written_in == "u" and quasi is None:
            was = "the system has none"
            raise invalid("written_in='u'", "be used with quasi-velocities", was)
        if written_in == "u" and quasi is not None and quasi.size < self.coordinates.size:
            speeds = [c.all_names[0] for c in self.constraints if not c.holonomic]
            if speeds:
                raise invalid(
                    "written_in",
                    "be 'v' if kinematics= leaves out velocities that Pfaffian rows set to zero, "
                    "since their momenta enter the equations",
                    f"it was 'u', and there is the Pfaffian row {speeds[0]!r}",
                    "Give L as a function of v; or name as many quasi-velocities as coordinates, "
                    "and those that are zero also in constrained=.",
                )
        self.written_in = written_in
        form = ("t", "q", written_in, "params")
        if lagrangian is None:
            assert kinetic is not None
            assert potential is not None
            require_arity("kinetic", kinetic, form)
            require_arity("potential", potential, ("t", "q", "params"))
            kinetic, potential = traced_function(kinetic), traced_function(potential)
            whole: Callable = _Difference(kinetic, potential)
        else:
            require_arity("lagrangian", lagrangian, form)
            whole = traced_function(lagrangian)
        self._in_u = None
        if written_in == "u":
            assert quasi is not None
            self._in_u = whole
            kinetic = None if kinetic is None else InQuasiVelocities(kinetic, quasi)
            whole = InQuasiVelocities(whole, quasi)
        self.lagrangian = whole
        self._kinetic, self._potential = kinetic, potential
        if lowering not in ("auto", "scalar", "array"):
            raise invalid("lowering", "be 'auto', 'scalar' or 'array'", f"it was {lowering!r}")
        self.lowering = lowering

    @property
    def _key(self) -> tuple:
        parts = (self.lagrangian, self.coordinates, self.forces, self.constraints)
        return (*parts, self.quasi, self.states, self.lowering)

    def _taken(self, rows: Sequence[AbstractConstraint]) -> dict[str, str]:
        """Names that quasi-velocities and states must not have -> their owners."""
        taken = dict.fromkeys(self.coordinates.names, "a coordinate")
        taken |= {force.name: "a force" for force in self.forces}
        fix = "a constraint (a name in constrained= already declares its row)"
        return taken | {name: fix for row in rows for name in row.all_names}

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, System) and self._key == other._key

    @property
    def _terms(self) -> ArrayTerms:
        """The terms of the equations of motion, on arrays."""
        return ArrayTerms(self.lagrangian, self.forces, self.constraints)

    @property
    def _program(self) -> AccelerationProgram:
        """The program of the accelerations."""
        if self.lowering == "array":
            return ArrayProgram(self._terms)
        return ScalarProgram(self._terms, OPERATIONS if self.lowering == "auto" else None)

    def with_forces(self, *forces: AbstractForce) -> "System":
        """The same system with additional forces.

        Raises:
            ValueError: an object that is no force, a name that is already used.
        """
        both = check_forces((*self.forces, *forces))
        check_reactions(self.constraints, both)
        if self.quasi is not None:
            taken = dict.fromkeys((force.name for force in both), "a force")
            check_quasi(self.quasi, self.size, taken)
        return eqx.tree_at(lambda s: s.forces, self, both, is_leaf=lambda x: x is self.forces)

    @property
    def _mechanics(self) -> "System":
        """The same without states: forces read their values as inputs."""
        if self.states is None:
            return self
        return eqx.tree_at(lambda s: s.states, self, None, is_leaf=lambda x: x is self.states)

    def unflatten(self, q: Array) -> dict[str, Array]:
        """Named parts of q (or v, a, p), shape (..., n)."""
        return self.coordinates.unflatten(q)

    def flatten(self, parts: Mapping[str, Any]) -> Array:
        """Flat vector, shape (n,), from a dict of named values."""
        return self.coordinates.flatten(parts)

    def _rows(self, params: Any, dtype: Any) -> ConstraintRows:
        """Names and shapes of the constraint rows, for such params.

        Raises:
            ValueError: quasi-velocities that are not affine, or fewer than the constraints leave.
        """
        if self.quasi is not None:
            check_kinematics(self.quasi, params, self.size, dtype)
        rows = layout(self.constraints, params, self.size, dtype)
        if self.quasi is not None and len(self.quasi.free) + rows.size < self.size:
            raise invalid(
                "quasi: names",
                f"leave at least {self.size - rows.size} that are not constrained, the degrees of "
                f"freedom of {self.size} coordinates with {rows.size} rows",
                f"there were {len(self.quasi.free)}",
                "Add quasi-velocities for the missing degrees of freedom, or add the missing "
                "constraints.",
            )
        return rows

    @state_first
    def check(
        self,
        q: Any,
        v: Any,
        params: Any = None,
        *,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> None:
        """Examine the declaration at one state, with these params; no output if it is valid.

        Traces L and the forces, then checks the numbers: L (J) finite, M = d2L/dv2, shape (n, n),
        positive definite by its pivots (with constraints on their tangent space), the rows of
        the constraints affine in v, a with M a + h = Q + A^T lam finite. States beside (q, v) are
        given by name among the inputs.

        Source: Golub, Van Loan, Matrix Computations, sec. 4.1 (L D L^T and its pivots).

        Raises:
            ValueError: L not a real scalar, a force of wrong shape, missing inputs, a coordinate
                without inertia (named); a function of which a value, or a derivative in the
                equations, is not finite (named, with the line of the operation).
        """
        t, q, v, params = self._state(q, v, params, t)
        values = self._inputs_at(inputs, t, q, v, params)
        check_traceable(self, params, q.dtype, values)
        L = as_written(self.lagrangian)(t, q, v, params)
        M = self._terms.mass(t, q, v, params)
        terms = [L, M]
        if self.constraints:
            self._rows(params, q.dtype)
            terms += self._terms.rows(t, q, v, params)
        if not all(bool(jnp.all(jnp.isfinite(x))) for x in terms):
            self._refuse_nonfinite(params, inputs, t, q, v)
            was = f"L was {L}, M {M}" + (f", A {terms[2]}" if self.constraints else "")
            raise invalid("lagrangian and constraints", "be finite at the given state", was)
        if self.constraints:
            M, _ = augmented(M, terms[2])
        vanishing = vanishing_rows(self, params, t, q)
        if vanishing:
            must = "have a nonzero gradient where it holds"
            was = "it was 0 there, with an extremum of the residual, as for y**2 or a length"
            fix = "Write the quantity itself, y; for a length, each component."
            raise invalid(f"constraint {vanishing[0]!r}", must, was, fix)
        index = int(first_unhealthy(M))
        if index >= 0:
            raise invalid(
                f"coordinate {self.coordinates.label(index)!r}",
                "have inertia: d2L/dv2 positive definite",
                f"its pivot was not positive at q = {q}, v = {v}",
                "Add its kinetic energy to L, check the sign of T, or drop the coordinate. "
                + advice_on_mass(params),
            )
        a = self.acceleration(q, v, params, t=t, inputs=inputs)
        beside = () if self.states is None else (self.states.rates(t, q, v, params, values),)
        if not all(bool(jnp.all(jnp.isfinite(x))) for x in (a, *beside)):
            self._refuse_nonfinite(params, inputs, t, q, v)
            label = self.coordinates.label(int(jnp.argmin(jnp.isfinite(a))))
            raise invalid(f"acceleration of {label!r}", "be finite at the given state", f"a = {a}")

    def _refuse_nonfinite(self, params: Any, inputs: Any, t: Array, q: Array, v: Array) -> None:
        """Raise for the first declared function that is not finite, if there is one."""
        found = nonfinite(self, params, check_inputs(inputs), t, q, v)
        if found is not None:
            raise found.error()

    def __getattr__(self, name: str) -> Any:
        if name in _FORMERLY_PUBLIC:
            raise AttributeError(
                f"System.{name} is private now. Public are mass_matrix, bias, multipliers, power, "
                "check and explain"
            )
        return no_attribute(self, name)

    def explain(self, params: Any) -> str:
        """Structure found in M a + h = Q of this system, and operations skipped by it, as text.

        Dependencies of M, h and L on t, q, v and params are read from the traced program, never
        from numbers. The same holds for cyclic coordinates, blocks of M and the like. The counted
        operations do not include forces that read inputs.
        """
        traced, static = _params.split(params)
        params = _params.join(traced, static)
        dtype = jnp.result_type(float)
        check_traceable(self, params, dtype, None)
        program, lowered = self._program, None
        free = tuple(f for f in self.forces if not getattr(f, "takes_inputs", False))
        whole = ArrayTerms(
            self.lagrangian, free, self.constraints, quasi=self.quasi, in_u=self._in_u
        )
        if isinstance(program, ScalarProgram):
            program = ScalarProgram(whole, program.limit)
            lowered = program.lowered(jax.ShapeDtypeStruct((self.size,), dtype), params, {})
        sparse = None
        if lowered is None or lowered.equations is None:
            sparse = find_sparsity(whole, params, self.size, dtype)
        rows = self._rows(params, dtype)
        return explain(self, self._structure(params, dtype), lowered, rows, sparse)

    def _structure(self, params: Any, dtype: Any) -> Structure:
        """Dependencies of M, h and L, traced once per (Lagrangian, shapes, dtypes)."""
        return ArrayTerms(self.lagrangian, ()).structure(params, self.size, dtype)
