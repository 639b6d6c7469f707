"""Forces, accelerations and reactions of a system at one state."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag._core._arguments import state_first
from jaxlag._core._errors import invalid
from jaxlag._lowering import ArrayTerms, QuasiState, State
from jaxlag._model._forces import reads_lam
from jaxlag._system._state_functions import AbstractQuantities
from jaxlag._tracing import _params
from jaxlag._tracing._compiled import Compiled
from jaxlag._tracing._input_values import InputValues


class AbstractReactions(AbstractQuantities):
    """Forces, accelerations and reactions from M a + h = Q + A^T lam, A a + gamma = 0."""

    @state_first
    def generalized_force(
        self,
        q: Any,
        v: Any,
        params: Any = None,
        *,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
        names: Sequence[str] | None = None,
    ) -> Float[Array, " n"]:
        """Q(t, q, v, inputs, lam), shape (n,), N or N m: the sum of the applied forces.

        Args:
            q: shape (n,).
            v: shape (n,).
            params: as the Lagrangian takes them.
            t: s.
            inputs: dict from names to input objects or arrays.
            names: only these forces; by default all, dissipation included.

        Source: Pila, sec. 3.3 (virtual work) and 3.7 (Rayleigh).

        Raises:
            ValueError: wrong lengths, unknown force names, missing inputs.
        """
        t, q, v, params = self._state(q, v, params, t)
        known = [force.name for force in self.forces]
        for name in known if names is None else names:
            if name not in known:
                raise invalid("generalized_force: names", f"be among {known}", f"one was {name!r}")
        chosen = tuple(f for f in self.forces if names is None or f.name in names)
        values = self._inputs_at(inputs, t, q, v, params)
        lam = None
        if any(map(reads_lam, chosen)):
            _, lam, _ = self._reactions(t, q, v, params, values)
        terms = ArrayTerms(self.lagrangian, chosen, self.constraints)
        return terms.force(t, q, v, params, values, lam)

    @state_first
    def acceleration(
        self,
        q: Any,
        v: Any,
        params: Any = None,
        *,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> Float[Array, " n"]:
        """Acceleration a with M a + h = Q + A^T lam, shape (n,), m/s^2 or rad/s^2.

        NaN if M is singular (with constraints: on their tangent space), and if no acceleration
        satisfies all rows, as in passing a dead point.

        Args:
            q: shape (n,).
            v: shape (n,).
            params: as the Lagrangian takes them.
            t: s.
            inputs: dict from names to input objects or arrays.

        Source: Pila, eq. 3.118.
        """
        t, q, v, params = self._state(q, v, params, t)
        values = self._inputs_at(inputs, t, q, v, params)
        if self.constraints:
            return self._reactions(t, q, v, params, values)[0]
        return self._program.acceleration(State(t, q, v, params, values))

    @state_first
    def multipliers(
        self,
        q: Any,
        v: Any,
        params: Any = None,
        *,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> dict[str, Float[Array, "..."]]:
        """Multipliers lam of M a + h = Q + A^T lam, A a + gamma = 0, by the name of the row.

        For dependent rows the multipliers have least norm sum_k (|A_k| lam_k)^2, in which
        |A_k lam_k| is the generalized force of row k alone. If forces read multipliers, the norm is
        least within the rows that they read, and within the other rows.
        |A_k| is the Euclidean length of the row in the units of the coordinates: meters instead of
        millimeters, or radians instead of degrees, change the distribution. A^T lam is the same, to
        rounding, for all units and lever lengths. The unit is J over that of the row's residual,
        for a `Pfaffian` W over it: N for a length or a velocity.

        Args:
            q: shape (n,), consistent with the constraints.
            v: shape (n,), likewise.
            params: as the Lagrangian takes them.
            t: s.
            inputs: dict from names to input objects or arrays.

        Source: Pila, eq. 3.118.
        """
        t, q, v, params = self._state(q, v, params, t)
        values = self._inputs_at(inputs, t, q, v, params)
        return self._rows(params, q.dtype).unflatten(self._reactions(t, q, v, params, values)[1])

    @state_first
    def constraint_force(
        self,
        q: Any,
        v: Any,
        params: Any = None,
        *,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> Float[Array, " n"]:
        """A^T lam, shape (n,), N or N m: the generalized force of all constraints.

        Unique also for dependent rows.

        Args:
            q: shape (n,), consistent with the constraints.
            v: shape (n,), likewise.
            params: as the Lagrangian takes them.
            t: s.
            inputs: dict from names to input objects or arrays.

        Source: Pila, eq. 3.118.
        """
        t, q, v, params = self._state(q, v, params, t)
        values = self._inputs_at(inputs, t, q, v, params)
        if not self.constraints:
            return jnp.zeros_like(q)
        return self._reactions(t, q, v, params, values)[2]

    def _quasi_reactions(
        self,
        q: Any,
        v: Any,
        params: Any = None,
        *,
        t: Any = 0.0,
        inputs: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Accelerations and reactions from the equations in quasi-velocities, by name.

        "a", shape (n,), from u' and v = B u + c; "multipliers", by the name of the row, from
        A^T lam = M a + h - Q, of least norm as in `multipliers`; "constraint_force", A^T lam. To
        rounding these equal `acceleration`, `multipliers` and `constraint_force`, which solve for
        the multipliers.

        Args:
            q: shape (n,), consistent with the constraints.
            v: shape (n,), likewise.
            params: as the Lagrangian takes them.
            t: s.
            inputs: dict from names to input objects or arrays.

        Source: Pila, eqs. 4.44 to 4.58.

        Raises:
            ValueError: the system has no quasi-velocities.
        """
        self._with_quasi("quasi_velocities")
        t, q, v, params = self._state(q, v, params, t)
        values = self._inputs_at(inputs, t, q, v, params)
        rows = self._rows(params, q.dtype)
        a, lam, force = _quasi_reactions((self,), params, dict(values), t, q, v)
        return {"a": a, "multipliers": rows.unflatten(lam), "constraint_force": force}

    @state_first
    def residuals(
        self, q: Any, v: Any, params: Any = None, *, t: Any = 0.0
    ) -> tuple[dict[str, Float[Array, "..."]], dict[str, Float[Array, "..."]]]:
        """(phi(t, q) of the holonomic rows, A v + b of all rows), each by name.

        Source: Pila, eqs. 3.10, 3.14.
        """
        t, q, v, params = self._state(q, v, params, t)
        rows = self._rows(params, q.dtype)
        rates = rows.unflatten(self._terms.velocity(t, q, v, params))
        return rows.holonomic_only(self._terms.position(t, q, params)), rates

    def _reactions(
        self, t: Array, q: Array, v: Array, params: Any, values: Mapping[str, Any]
    ) -> tuple[Array, Array, Array]:
        """(a, lam, A^T lam), compiled as one program because of many small operations."""
        self._rows(params, q.dtype)
        sample = _params.sample(_params.halves(params)[0])
        return _reactions((self, sample), params, dict(values), t, q, v)


@Compiled
def _reactions(
    system: AbstractReactions,
    sample: _params.Sample,
    params: Any,
    values: dict[str, Any],
    t: Array,
    q: Array,
    v: Array,
) -> tuple[Array, Array, Array]:
    return system._program.reactions(State(t, q, v, params, InputValues(values)), sample)


@Compiled
def _quasi_reactions(
    system: AbstractReactions,
    params: Any,
    values: dict[str, Any],
    t: Array,
    q: Array,
    v: Array,
) -> tuple[Array, Array, Array]:
    """(a, lam, A^T lam), compiled as one."""
    quasi = system.quasi
    assert quasi is not None
    terms = ArrayTerms(
        system.lagrangian, system.forces, system.constraints, quasi=quasi, in_u=system._in_u
    )
    w = quasi.of(t, q, v, params)[quasi.free]
    moving = QuasiState(terms, t, q, w, params, InputValues(values))
    if system.constraints:
        a, lam = moving.reactions()
        force = lam @ terms.rows(t, q, v, params)[0]
    else:
        a = moving.velocity_rate(moving.accelerations())
        lam, force = jnp.zeros((0,), q.dtype), jnp.zeros_like(q)
    regular = quasi.regular(t, q, params)
    a, lam, force = (jnp.where(regular, x, jnp.nan) for x in (a, lam, force))
    return a, lam, force
