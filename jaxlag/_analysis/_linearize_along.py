"""Linearization along a motion, and its transition matrices."""

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._analysis._consistent_state import rows_at
from jaxlag._analysis._declared_point import DeclaredPoint, declared_point
from jaxlag._analysis._equations import equations_around, scene_of
from jaxlag._analysis._linearization import Linearization
from jaxlag._analysis._linearize import linearize
from jaxlag._analysis._minimal_states import MinimalStates, minimal_states
from jaxlag._analysis._outputs import Outputs, outputs_of
from jaxlag._analysis._tangent_space import tangent_basis
from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid, unsupported
from jaxlag._core._result import AbstractResult
from jaxlag._linalg._mass_solve import dependence_floor
from jaxlag._model._inputs import check_inputs
from jaxlag._model._states import check_no_states, named_states
from jaxlag._simulation._options._option_checks import check_start, check_states_start, check_times
from jaxlag._simulation._simulate import simulate
from jaxlag._simulation._solution import Solution
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._compiled import Compiled

ELSEWHERE = {
    "u0": "Give v0.",
    "throw": "It raises; inside of transforms read motion.ok.",
    "assemble": "Take the start from jl.assemble.",
}
"""Options of `simulate` that are refused, with what to do in their place."""


class LinearizedMotion(AbstractResult):
    """A motion, the linearized equations at its s times, and its transition matrices.

    A deviation x of the states in `states` at ts[0] is Phi(ts[i], ts[0]) x at ts[i].

    Attributes:
        motion: the motion at the times.
        linear: x' = f0 + A(t) x + B(t) u, y = y0 + C(t) x + D(t) u at each of them: a batch of s.
        transitions: Phi(ts[i], ts[0]) for every i, shape (s, k, k).
    """

    motion: Solution
    linear: Linearization
    transitions: Float[Array, "*batch s k k"]

    @property
    def states(self) -> tuple[str, ...]:
        """Names of x."""
        return self.linear.states

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for a single motion."""
        return self.motion.batch_shape

    def __getitem__(self, index: Any) -> Any:
        """Those of a batch by an index."""
        return self._select(index)


def linearize_along(
    system: System,
    q0: Any,
    v0: Any,
    ts: Any,
    params: Any = None,
    *,
    x0: Any = None,
    inputs: Mapping[str, Any] | None = None,
    outputs: Sequence[Any] | Mapping[str, Any] = (),
    independent: Sequence[str] | None = None,
    **options: Any,
) -> LinearizedMotion:
    """The equations linearized along a motion: A(t), B(t), C(t), D(t), and transition matrices.

    The motion is that of `jl.simulate`. At each time in ts the equations are those of
    `jl.linearize`, in the same independent states at all of them. The transition matrices satisfy

        d/dt Phi(t, t0) = A(t) Phi(t, t0),  Phi(t0, t0) = 1.

    They are not integrated from A(t) but are the derivatives of the solution at the accepted steps:
    exact for these steps. Eigenvalues of Phi after one period are the Floquet multipliers of a
    periodic motion. As inside of all transforms, "auto" does not continue a stiff motion by an
    implicit method: name one.

    Derivatives with respect to params and the start are exact, in the modes of `jl.simulate`; see
    there for kinks of forces. Under `jax.jit`, `jax.grad` or `jax.vmap` of them give `independent`
    if there are constraints. Where the named states do not determine the others, A and C are NaN.

    Args:
        system: the mechanical system with n coordinates.
        q0: coordinates at ts[0], on the constraints: (n,) or a dict by name; m or rad.
        v0: velocities in the same form; m/s or rad/s.
        ts: (s,) times in s, strictly monotone; ts[0] is the start.
        params: as the Lagrangian takes them.
        x0: states of the system at ts[0], as for `jl.simulate`.
        inputs: dict from names to input objects or arrays, as for `jl.simulate`. B and D have a
            column for every entry. `Feedback` is part of the linearized equations and has none.
        outputs: as for `jl.linearize`.
        independent: names of the independent coordinates and, with a prime, of the independent
            velocities, as for `jl.linearize`. By default those best determined at ts[0].
        options: further options of `jl.simulate`, such as `rtol`, `method`, `dt`.

    Returns:
        `LinearizedMotion`.

    Raises:
        ValueError: what `jl.linearize` and `jl.simulate` refuse; independent states that do not
            determine the others along the whole motion.
        SimulationError: the motion did not reach ts[-1].

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. I.14 (the
    variational equation).

    Example:
        After one period of an oscillator every deviation is back:

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> spring = jl.System(lambda t, q, v, params: 0.5 * (v @ v - q @ q), ("x",))
        >>> along = jl.linearize_along(spring, [0.3], [0.0], [0.0, 2 * jnp.pi])
        >>> along.states
        ('x', "x'")
        >>> bool(jnp.allclose(along.transitions[-1], jnp.eye(2), atol=1e-8))
        True
    """
    _check_options(options)
    if not isinstance(system, System):
        raise invalid("linearize_along: system", "be a jl.System", f"it was {system!r}")
    q0, v0, _ = check_start(system, q0, v0, None)
    ts = check_times(ts)[0]
    x0, q0, v0 = check_states_start(system, "x0", x0, q0, v0)
    inputs = check_inputs(inputs)
    check_no_states(inputs, system.states)
    signals = inputs | named_states(system.states, x0)
    point = declared_point("linearize_along", system, q0, v0, params, ts[0], signals)
    rows = point.system._rows(point.params, q0.dtype)
    known = bool(rows.size) and point.known
    outputs_of(point.system, outputs, rows.labels, (point.t, q0, v0, point.params))
    A = rows_at(*point[:3], point.t, point.q, point.v) if known else None
    states = minimal_states(system, rows, A, independent)
    motion, transitions = _solved(point, states, known and concrete(point.v), ts, inputs, options)
    if concrete(motion.raw_status):
        motion.check()
    names = [*states.names]
    if system.states is not None:
        names = names[: -len(system.states.layout.labels)]

    def at(t: Array, q: Array, v: Array, x: Any) -> Linearization:
        given = inputs | named_states(system.states, x)
        return linearize(
            system, q, v, params, t=t, inputs=given, outputs=outputs, independent=names
        )

    linear = jax.vmap(at)(motion.ts, motion.q, motion.v, motion.x)
    if concrete(linear):
        _check_determined(linear, motion.ts)
    return LinearizedMotion(motion, linear, transitions)


def _check_options(options: dict[str, Any]) -> None:
    """Refuse what is no option of `simulate`, and what has no meaning here."""
    known = inspect.signature(simulate).parameters
    for name in options:
        if name in ELSEWHERE:
            raise unsupported(f"`{name}` of linearize_along", "it has no use", ELSEWHERE[name])
        if name not in known:
            must = "be arguments of linearize_along or of simulate"
            raise invalid("linearize_along: options", must, f"one was {name!r}")


def _check_determined(linear: Linearization, ts: Array) -> None:
    """Refuse independent states that do not determine the others up to rounding."""
    lost = np.flatnonzero(~np.all(np.isfinite(linear.A), axis=(-2, -1)) | ~_determined(linear))
    if lost.size:
        must = "determine the others along the whole motion"
        was = f"{', '.join(linear.states)} did not at t = {float(ts[lost[0]]):.6g}"
        fix = "Name others, take a shorter motion, or check M and the declared functions there."
        raise invalid("linearize_along: independent", must, was, fix)


def _determined(linear: Linearization) -> np.ndarray:
    """Whether deviations of dependent coordinates are bounded, in units of equal inertia."""
    labels = linear.coordinates
    independent = [i for i, name in enumerate(linear.states) if name in labels]
    places = [labels.index(linear.states[i]) for i in independent]
    P = np.asarray(linear.basis)[:, : len(labels)][..., independent]
    inertias = np.diagonal(np.asarray(linear.mass), axis1=-2, axis2=-1)
    units = np.sqrt(np.where(inertias > 0, inertias, 1.0))
    most = np.abs(P) * units[:, :, None] / units[:, None, places]
    return np.max(most, axis=(-2, -1), initial=0.0) * dependence_floor(P.dtype) <= 1.0


def _solved(
    point: DeclaredPoint,
    states: MinimalStates,
    checked: bool,
    ts: Any,
    inputs: dict[str, Any],
    options: dict[str, Any],
) -> tuple[Solution, Array]:
    """The motion, and derivatives of the independent states at all times by those at the start."""
    system, sample, params, signals, t, q, v, _ = point
    basis = _basis((system, sample, states, checked), params, None, t, q, v)
    around = equations_around(scene_of(system, sample, Outputs(()), {}), params, signals, t, q, v)

    def moved(x: Array) -> tuple[Array, Solution]:
        at = around.point(around.z + basis @ x)
        x0 = None if system.states is None else at.x
        start = at.q, at.v
        motion = simulate(system, *start, ts, params, x0=x0, inputs=inputs, throw=False, **options)
        return _independent(system, states, motion, params), motion

    none = jnp.zeros(basis.shape[1], q.dtype)
    transitions, motion = jax.jacfwd(moved, has_aux=True)(none)
    return motion, transitions


def _independent(
    system: System, states: MinimalStates, motion: Solution, params: Any
) -> Float[Array, "s k"]:
    """The independent states at all times."""
    w, quasi = motion.v, system.quasi
    if quasi is not None:
        of = lambda t, q, v: quasi.of(t, q, v, params)[quasi.free]  # noqa: E731
        w = jax.vmap(of)(motion.ts, motion.q, motion.v)
    found = [motion.q[:, np.array(states.coordinates, int)]]
    found.append(w[:, np.array(states.velocities, int)])
    return jnp.concatenate(found if motion.x is None else [*found, motion.x], axis=1)


@Compiled
def _basis(
    system: System,
    sample: _params.Sample,
    states: MinimalStates,
    checked: bool,
    params: Any,
    _: None,
    t: Array,
    q: Array,
    v: Array,
) -> Float[Array, "s k"]:
    return tangent_basis(system, sample, states, checked, params, t, q, v)
