"""Linearization of the equations of motion in minimal coordinates of the constraints."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxlag._analysis._consistent_state import rows_at
from jaxlag._analysis._declared_point import declared_point
from jaxlag._analysis._equations import Scene, equations_around, scene_of
from jaxlag._analysis._kinks import bends, examined, kinks
from jaxlag._analysis._linearization import Linearization
from jaxlag._analysis._minimal_states import MinimalStates, entries, minimal_states
from jaxlag._analysis._outputs import outputs_of
from jaxlag._analysis._tangent_space import tangent_basis
from jaxlag._core._arguments import name_sequence, state_first
from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._system._row_advice import advice_on_rows
from jaxlag._system._system import System
from jaxlag._tracing._compiled import Compiled


@state_first
def linearize(
    system: System,
    q: Any,
    v: Any,
    params: Any = None,
    *,
    t: Any = 0.0,
    inputs: Mapping[str, Any] | Sequence[str] | None = (),
    outputs: Sequence[Any] | Mapping[str, Any] = (),
    independent: Sequence[str] | None = None,
    drop: Sequence[str] = (),
) -> Linearization:
    """The equations of motion linearized about a state: x' = f0 + A x + B u, y = y0 + C x + D u.

    x are deviations of independent coordinates and velocities, all others follow from the
    constraints:

        delta q = P x_q,  delta v = S x_q + N x_v,  phi_q P = 0,  A N = 0,
        A S + d(A v + b)/dq P = 0

    with the identity in the independent rows of P and N, and 0 in those of S. The rates are those
    of the whole equations along these directions. Redundant rows are allowed. If the system has
    quasi-velocities, these take the place of v, and all free ones are independent. States of the
    system follow.

    Coordinates and velocities are chosen by pivoting, so that the dependent ones are well
    determined. The derivatives, with respect to params and to the point, are exact, in every mode.
    Under `jax.jit`, `jax.grad` or `jax.vmap` of t, q or params, give `independent` if there are
    constraints, as their rows are then unknown. Then A, C and the basis are NaN off the
    constraints, and if the named states do not determine the others. Kinks, places beside which
    more rows are independent, and what depends on states in `drop` are not looked for.

    Args:
        system: the mechanical system with n coordinates.
        q: coordinates, (n,) or a dict by name; m or rad.
        v: velocities in the same form; m/s or rad/s.
        params: as the Lagrangian takes them.
        t: instant, s.
        inputs: dict from names to input objects or arrays, as for `jl.simulate`, with values of the
            states of the system; or names, of numbers that are 0. B and D have a column for every
            entry. `Feedback` is part of the linearized equations and has none.
        outputs: names of coordinates `"theta"`, velocities `"theta'"`, quasi-velocities, states and
            multipliers, and functions of (t, q, v, params); or a dict from names to these.
        independent: names of the independent coordinates and, with a prime, of the independent
            velocities. Without names with a prime these are chosen.
        drop: names of states to leave out, on which nothing else depends: cyclic coordinates. The
            name of an array of coordinates stands for all of its states.

    Returns:
        `Linearization`.

    Raises:
        ValueError: a state off the constraints; an unknown name; independent coordinates that do
            not determine the others; a dropped state that others read; a singular point; a kink or
            jump of a declared function.

    Source: Meijaard, Papadopoulos, Ruina, Schwab, Proc. R. Soc. A 463 (2007) 1955, app. A;
    Peterson, Gede, Hubbard, Multibody Syst. Dyn. 33 (2015) 143 (symbolic linearization).

    Example:
        A pendulum of length 1 in Cartesian coordinates, about its lower equilibrium:

        >>> import jax, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> pendulum = jl.System(
        ...     lambda t, q, v, params: 0.5 * v @ v - 9.81 * q[1],
        ...     ("x", "y"),
        ...     constraints=(jl.Holonomic(lambda t, q, params: q @ q - 1.0, "rod"),),
        ... )
        >>> linear = jl.linearize(pendulum, [0.0, -1.0], [0.0, 0.0])
        >>> print(linear.states, linear.A.tolist())
        ('x', "x'") [[0.0, 1.0], [-9.81, 0.0]]
    """
    point = declared_point("linearize", system, q, v, params, t, inputs)
    system, sample, params, signals, t, q, v, known = point
    rows = system._rows(params, q.dtype)
    A = rows_at(system, sample, params, t, q, v) if rows.size and known else None
    states = minimal_states(system, rows, A, independent)
    wanted = outputs_of(system, outputs, rows.labels, (t, q, v, params))
    scene, checked = scene_of(system, sample, wanted, signals), A is not None and concrete(v)
    found = _linear((scene, states, checked), params, signals, t, q, v)
    if concrete(found):
        _check_finite(found, system, params, t, q)
    if known and concrete(found, v):
        _check_derivatives(scene, params, signals, t, q, v, found.basis)
    drop = name_sequence("linearize: drop", drop)
    return found.dropped(entries(system.coordinates, drop, found.states)) if drop else found


def _check_finite(found: Linearization, system: System, params: Any, t: Array, q: Array) -> None:
    """Refuse a singular point, and outputs that have no value or derivative."""
    if all(np.all(np.isfinite(x)) for x in (found.f0, found.A, found.B)):
        y = np.concatenate([found.y0[:, None], found.C, found.D], axis=1)
        bad = np.flatnonzero(~np.all(np.isfinite(y), axis=1))
        if bad.size:
            must, was = "have finite values and derivatives", f"{found.outputs[bad[0]]!r} had none"
            raise invalid("linearize: outputs", must, was)
        return
    must, was = "be a regular point", "the linearized equations were not finite"
    fix = advice_on_rows(system, params, t, q) or "Check M and the declared functions there."
    raise invalid("linearize: q and v", must, was, fix)


def _check_derivatives(
    scene: Scene,
    params: Any,
    signals: dict[str, Any],
    t: Array,
    q: Array,
    v: Array,
    basis: Array,
) -> None:
    """Refuse a kink or jump of declared functions that is one of the equations, too."""
    around = equations_around(scene, params, signals, t, q, v)
    bent = kinks(around, examined(around, basis))
    if bent and np.any(np.asarray(_bends((scene,), params, signals, t, q, v, basis))):
        must, was = "be a state where the equations have derivatives", "there is a kink or jump"
        fix = "Move the state to one side of it, or make it smooth."
        raise invalid("linearize: q and v", must, f"{was} of {', '.join(bent)}", fix)


@Compiled
def _bends(
    scene: Scene,
    params: Any,
    signals: dict[str, Any],
    t: Array,
    q: Array,
    v: Array,
    basis: Array,
) -> Bool[Array, " k"]:
    around = equations_around(scene, params, signals, t, q, v)
    both = lambda z: jnp.concatenate(around.rates(z))  # noqa: E731
    return bends(both, around.z, examined(around, basis))


@Compiled
def _linear(
    scene: Scene,
    states: MinimalStates,
    checked: bool,
    params: Any,
    signals: dict[str, Any],
    t: Array,
    q: Array,
    v: Array,
) -> Linearization:
    """A is NaN off the constraints, unless checked, and if `states` do not determine the others."""
    system = scene.system
    around = equations_around(scene, params, signals, t, q, v)
    terms = system._program.terms(q, params, scene.sample)
    basis = tangent_basis(system, scene.sample, states, checked, params, t, q, v)
    (f, y0), slopes = jax.linearize(around.rates, around.z)
    slope, of_outputs = jax.vmap(slopes, 1, 1)(around.directions(basis))
    n, k = system.size, basis.shape[1]
    others = range(n + around.speeds, around.size)
    places = np.array([*states.coordinates, *(n + i for i in states.velocities), *others], int)
    return Linearization(
        slope[places, :k],
        slope[places, k:],
        of_outputs[:, :k],
        of_outputs[:, k:],
        f[places],
        y0,
        basis,
        terms.mass(t, q, v, params),
        None,
        states.names,
        around.labels,
        scene.outputs.labels,
        system.coordinates.labels,
        _layout(system),
    )


def _layout(system: System) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Names and shapes of (q, w, x)."""
    shapes, found = system.coordinates.shapes, list(system.coordinates.shapes.items())
    if system.quasi is None:
        found += [(f"{name}'", shape) for name, shape in shapes.items()]
    else:
        found += [(system.quasi.names[i], ()) for i in system.quasi.free]
    if system.states is not None:
        found += system.states.layout.shapes.items()
    return tuple((name, tuple(shape)) for name, shape in found)
