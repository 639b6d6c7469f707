"""The linearized equations in all coordinates and multipliers: descriptor form."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._analysis._consistent_state import rows_at
from jaxlag._analysis._declared_point import declared_point
from jaxlag._analysis._equations import Scene, equations_around, scene_of
from jaxlag._analysis._outputs import Outputs
from jaxlag._core._arguments import state_first
from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._core._result import AbstractResult
from jaxlag._lowering import State
from jaxlag._model._inputs import evaluate
from jaxlag._model._states import with_states
from jaxlag._system._row_advice import advice_on_rows
from jaxlag._system._system import System
from jaxlag._tracing._compiled import Compiled


class DescriptorForm(AbstractResult):
    """E z' = f0 + A z + B u: deviations from one point in all coordinates and multipliers.

    z are the deviations of (q, v, states, lam). The rows are the derivatives along them of

        q' = v,   M v' = Q - h + A^T lam,   states' = rates,   0 = phi or 0 = A v + b

    in this order, the second at the accelerations of the point. Holonomic constraints are rows of
    phi, others of A v + b. If there are constraints, E is singular, and the index is 3 (holonomic)
    or 2. With redundant rows the pencil s E - A is singular: their multipliers are not unique.

    Attributes:
        E: shape (2 n + s + m, 2 n + s + m), block-diagonal (1, M, 1, 0).
        A: the same shape.
        B: shape (2 n + s + m, p).
        f0: E times the rates at the point, shape (2 n + s + m,).
        variables: names of z: coordinates `"theta"`, velocities `"theta'"`, states, and multipliers
            by their rows.
        inputs: names of u.
    """

    E: Float[Array, "*batch k k"]
    A: Float[Array, "*batch k k"]
    B: Float[Array, "*batch k p"]
    f0: Float[Array, "*batch k"]
    variables: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for a single point."""
        return self.A.shape[:-2]

    def __getitem__(self, index: Any) -> Any:
        """Those of a batch by an index."""
        return self._select(index)


@state_first
def descriptor_form(
    system: System,
    q: Any,
    v: Any,
    params: Any = None,
    *,
    t: Any = 0.0,
    inputs: Mapping[str, Any] | Sequence[str] | None = (),
) -> DescriptorForm:
    """The linearized equations E z' = f0 + A z + B u in coordinates, velocities and multipliers.

    No coordinates are eliminated: matrices keep the structure of M and of the rows, for solvers of
    descriptor systems. `jl.linearize` gives the equations in minimal coordinates: at rest the
    eigenvalues of its A are the finite ones of the pencil s E - A, if the rows are independent.

    Equations are those with multipliers, also of systems with quasi-velocities. Derivatives with
    respect to params and to the point are exact, in every mode. Kinks are not looked for. Under
    `jax.jit`, `jax.grad` and `jax.vmap` of t, q or params the constraints are not checked.

    Args:
        system: the mechanical system with n coordinates.
        q: coordinates, (n,) or a dict by name; m or rad.
        v: velocities in the same form; m/s or rad/s.
        params: as the Lagrangian takes them.
        t: instant, s.
        inputs: dict from names to input objects or arrays, or names, as for `jl.linearize`.

    Returns:
        `DescriptorForm`.

    Raises:
        ValueError: a state off the constraints; an argument that is not what it must be; a singular
            point.

    Source: Kunkel, Mehrmann, Differential-Algebraic Equations, EMS 2006, sec. 2.

    Example:
        A pendulum of length 1 in Cartesian coordinates, hanging: two eigenvalues are finite.

        >>> import jax, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> pendulum = jl.System(
        ...     lambda t, q, v, params: 0.5 * v @ v - 9.81 * q[1],
        ...     ("x", "y"),
        ...     constraints=(jl.Holonomic(lambda t, q, params: q @ q - 1.0, "rod"),),
        ... )
        >>> form = jl.descriptor_form(pendulum, [0.0, -1.0], [0.0, 0.0])
        >>> form.variables
        ('x', 'y', "x'", "y'", 'rod')
        >>> print(form.A[2])
        [-9.81  0.    0.    0.    0.  ]
    """
    point = declared_point("descriptor_form", system, q, v, params, t, inputs)
    system, sample, params, signals, t, q, v, known = point
    if known and system._rows(params, q.dtype).size:
        rows_at(system, sample, params, t, q, v)
    found = _descriptor((scene_of(system, sample, Outputs(()), signals),), params, signals, t, q, v)
    if concrete(found) and not all(np.all(np.isfinite(x)) for x in jax.tree.leaves(found)):
        must, was = "be a regular point", "the linearized equations were not finite"
        fix = advice_on_rows(system, params, t, q) or "Check M and the declared functions there."
        raise invalid("descriptor_form: q and v", must, was, fix)
    return found


@Compiled
def _descriptor(
    scene: Scene, params: Any, signals: dict[str, Any], t: Array, q: Array, v: Array
) -> DescriptorForm:
    system, n = scene.system, q.shape[0]
    around = equations_around(scene, params, signals, t, q, v)
    at, terms = around.point(around.z), system._terms
    rows = system._rows(params, q.dtype)
    state = State(t, q, v, params, at.values)
    if rows.size:
        a, lam, _ = system._program.reactions(state, scene.sample)
    else:
        a, lam = system._program.acceleration(state), jnp.zeros((0,), q.dtype)
    parts = [q, v, at.x, lam, *map(jnp.ravel, around.opened.values())]
    ends = np.cumsum([x.shape[0] for x in parts])
    holonomic = np.array(rows.holonomic, bool)

    def right(z: Array) -> Array:
        """Right sides at these accelerations."""
        q, v, x, lam, *given = jnp.split(z, ends[:-1])
        shaped = zip(around.opened.items(), given, strict=True)
        given = {name: part.reshape(jnp.shape(value)) for (name, value), part in shaped}
        values = evaluate({**around.feedback, **given}, t, q, v, params)
        values = with_states(values, system.states, x)
        found = [v, -terms.euler_lagrange(t, q, v, a, params)]
        found[1] += terms.force(t, q, v, params, values, lam if rows.size else None)
        if system.states is not None:
            found.append(system.states.rates_at(t, q, v, x, params, values))
        if rows.size:
            found[1] += lam @ terms.rows(t, q, v, params)[0]
            phi = rows.of_all(terms.position(t, q, params))
            found.append(jnp.where(holonomic, phi, terms.velocity(t, q, v, params)))
        return jnp.concatenate(found)

    z = jnp.concatenate(parts)
    slope = jax.jacfwd(right)(z)
    M = terms.mass(t, q, v, params)
    one, of_states = (jnp.eye(x.shape[0], dtype=q.dtype) for x in (q, at.x))
    none = jnp.zeros((rows.size, rows.size), q.dtype)
    E = jax.scipy.linalg.block_diag(one, M, of_states, none)
    inertia = jnp.zeros_like(slope[:, 0]).at[n : 2 * n].set(M @ a)
    labels = system.coordinates.labels
    states = () if system.states is None else system.states.layout.labels
    names = (*labels, *(f"{x}'" for x in labels), *states, *rows.labels)
    k = E.shape[0]
    return DescriptorForm(E, slope[:, :k], slope[:, k:], right(z) + inertia, names, around.labels)
