"""Search for steady motions: relative equilibria and trimmed states."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._analysis._consistent_state import rows_near
from jaxlag._analysis._declared_point import DeclaredPoint, declared_point
from jaxlag._analysis._equations import Equations, Scene, equations_around, scene_of
from jaxlag._analysis._minimal_states import MinimalStates, minimal_states
from jaxlag._analysis._outputs import Outputs
from jaxlag._analysis._steady_equations import SteadyEquations
from jaxlag._analysis._steady_motion import STEADY, SteadyMotion
from jaxlag._analysis._transport import (
    Transported,
    consistent,
    most_constant,
    transported,
    without_influence,
)
from jaxlag._core._arguments import name_sequence, positive_integer, state_first
from jaxlag._core._arrays import concrete, number, stop_gradient
from jaxlag._core._custom_jvp import CustomJVP
from jaxlag._core._errors import EquilibriumError, invalid
from jaxlag._core._status import Status
from jaxlag._model._inputs import evaluate
from jaxlag._statics._least_squares import End, Root, Scale, assessed, least_squares
from jaxlag._statics._root_search import differentiable_if, solve_regular
from jaxlag._system._row_advice import advice_on_rows
from jaxlag._system._system import System
from jaxlag._tracing._compiled import Compiled
from jaxlag._tracing._params import Static, arrays_apart, join, split

TRIED = 8
"""Most coordinates without influence whose velocities are tried as dependent ones."""


@state_first
def steady(
    system: System,
    q: Any,
    v: Any,
    params: Any = None,
    *,
    free: Sequence[str],
    t: Any = 0.0,
    inputs: Mapping[str, Any] | Sequence[str] | None = (),
    independent: Sequence[str] | None = None,
    rtol: Any = None,
    max_steps: int = 256,
    throw: bool = True,
) -> SteadyMotion:
    """A steady motion near (q, v): all independent velocities and all states are constant.

    It is a relative equilibrium (a precessing top, a disk or bicycle on a circle, a governor at
    speed), or with free inputs a trimmed state. The unknowns are the coordinates, velocities,
    quasi-velocities, states and inputs named in `free`, and those that depend on the others by
    constraints. All others keep their values. It solves

        w' = 0,  states' = 0,  phi(t, q) = 0,  A v + b = 0

    with w the independent velocities, or the free quasi-velocities. Levenberg-Marquardt on these
    equations, of which more may hold than there are unknowns. Then the equations are evaluated
    along the motion that follows with constant w: they must remain satisfied. So every coordinate
    that moves must be one on which they do not depend.

    Velocities of coordinates without influence, such as the place of a rolling wheel, may vary in a
    steady motion. They are taken as dependent ones if L is then constant along such a motion from
    the guess; `independent` names others.

    The derivative follows from the implicit function theorem, in every mode and order. Where roots
    lie beside each other, root and derivative are those of least norm, in units in which unknowns
    have equal influence. Where there is a root for these params alone, as of two equations in one
    unknown, the derivative is that of the nearest point. It is NaN if the status is not ok.

    Under `jax.jit`, `jax.grad` or `jax.vmap` of t, q or params, give `independent` if there are
    constraints. Equations in quasi-velocities need those that satisfy all rows.

    Args:
        system: the mechanical system with n coordinates.
        q: guess of the coordinates, (n,) or a dict by name; m or rad.
        v: guess of the velocities in the same form; m/s or rad/s.
        params: as the Lagrangian takes them.
        free: names of what may change: coordinates `"theta"`, velocities `"theta'"`, with
            quasi-velocities these in place of velocities, states, inputs. The name of an array
            stands for all of its entries.
        t: instant, s.
        inputs: dict from names to input objects or arrays, as for `jl.linearize`, with guesses for
            the states of the system; or names, of numbers that are 0.
        independent: names of the independent coordinates and, with a prime, of the independent
            velocities, as for `jl.linearize`.
        rtol: Newton steps must be below rtol (|x| + |x - x0|) for every unknown, or below rounding;
            less than 1, by default 1e-10 in float64, 1e-4 in float32.
        max_steps: bound on the steps of the search.
        throw: outside `jit` and `vmap`, raise for a status other than ok. Inside them nothing is
            raised: read `status`.

    Returns:
        `SteadyMotion`.

    Raises:
        ValueError: an argument that is not what it must be; an unknown name; independent
            coordinates that do not determine the others.
        EquilibriumError: none was found, or the motion is not steady; what does not hold is named.
            With `throw=True` and concrete values.

    Source: Marsden, Lectures on Mechanics, ch. 4 (relative equilibria); Nocedal, Wright, Numerical
    Optimization, sec. 10.3 (Levenberg-Marquardt).

    Example:
        A conical pendulum of length 1 at 60 degrees turns with phi'^2 = g / cos(theta):

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     kinetic = 0.5 * (v[0] ** 2 + (jnp.sin(q[0]) * v[1]) ** 2)
        ...     return kinetic + 9.81 * jnp.cos(q[0])
        >>> cone = jl.System(lagrangian, ("theta", "phi"))
        >>> motion = jl.steady(cone, [jnp.pi / 3, 0.0], [0.0, 4.0], free=["phi'"])
        >>> print(f"{motion.v[1]:.6f} {jnp.sqrt(9.81 / 0.5):.6f}")
        4.429447 4.429447
    """
    max_steps = positive_integer("max_steps", max_steps)
    point = declared_point("steady", system, q, v, params, t, inputs)
    q = point.q
    rtol = _tolerance(rtol, q.dtype)
    scene = scene_of(point.system, point.sample, Outputs(()), point.signals)
    around = equations_around(scene, point.params, point.signals, point.t, q, point.v)
    unknowns = _unknowns(around, free)
    states = _states(scene, point, unknowns, independent)
    moving = _moving(around, states, unknowns)
    key = scene, states, max_steps
    found = _search(key, point.params, point.signals, point.t, q, point.v, rtol, moving)
    if throw and concrete(found.status) and int(found.status) != int(Status.ok):
        found = stop_gradient(found)
        more = ""
        if found.q.ndim == 1 and concrete(point.t, point.params, found.q):
            more = f" {advice_on_rows(point.system, point.params, point.t, found.q)}".rstrip()
        raise EquilibriumError(f"Search ended with status {found.message()}{more}", found)
    return found


def _tolerance(rtol: Any, dtype: Any) -> Array:
    """The tolerance of the unknowns."""
    if rtol is None:
        rtol = 1e-10 if dtype == jnp.float64 else 1e-4
    rtol = number("steady: rtol", "be a positive number", rtol, dtype)
    if concrete(rtol) and not 0 < rtol < 1:
        raise invalid("steady: rtol", "be a positive number, less than 1", f"it was {rtol}")
    return rtol


def _unknowns(around: Equations, free: Any) -> tuple[int, ...]:
    """Places of the free names in z = (q, w, x, inputs)."""
    places, found = around.places, set()
    for name in name_sequence("steady: free", free):
        if name not in places:
            raise invalid("steady: free", f"be names among {[*places]}", f"one was {name!r}")
        if len(places[name]) > 1:
            must, fix = "name one quantity each", "Rename the input or the state."
            raise invalid("steady: free", must, f"{name!r} was the name of two", fix)
        found |= {*places[name][0]}
    return tuple(sorted(found))


def _states(
    scene: Scene, point: DeclaredPoint, unknowns: tuple[int, ...], independent: Any
) -> MinimalStates:
    """The independent states: as named, or so that free ones are among them."""
    system, sample, params, signals, t, q, v, known = point
    rows, n = system._rows(params, q.dtype), system.size
    if not rows.size or not known:
        return minimal_states(system, rows, None, independent, "steady")
    with jax.ensure_compile_time_eval():
        rest = jnp.zeros_like(q)
    A = rows_near(system, sample, params, t, q, rest)[1]
    last = [i for i in unknowns if i < n], [i - n for i in unknowns if n <= i < 2 * n]

    def chosen(first: Sequence[int]) -> MinimalStates:
        return minimal_states(system, rows, A, independent, "steady", first, last)

    if independent is not None or system.quasi is not None or not concrete(v):
        return chosen(())
    idle = without_influence((scene, params, signals, t, q, v), last[1])
    tried = [chosen(x) for count in range(4) for x in combinations(idle[:TRIED], count)]
    candidates = [*dict.fromkeys(tried)]
    if len(candidates) == 1:
        return candidates[0]
    # A guess on which nothing turns would not tell them apart.
    moved = np.random.default_rng(0).uniform(0.1, 0.2, (2, n))
    for k, varied in enumerate((last[0], [*last[1], *idle])):
        moved[k, [i for i in range(n) if i not in varied]] = 0.0
    near = q + moved[0] * (1.0 + np.abs(q)), v + moved[1] * (1.0 + np.abs(v))
    q, v = (jnp.asarray(x, q.dtype) for x in near)
    dependent = [[i not in x.velocities for i in range(n)] for x in candidates]
    return candidates[most_constant((scene, params, signals, t, q, v), dependent)]


def _moving(around: Equations, states: MinimalStates, unknowns: tuple[int, ...]) -> Array:
    """Which entries of z are unknowns: the free ones, and those that depend on others."""
    n = around.scene.system.size
    found = np.isin(np.arange(around.z.shape[0]), unknowns)
    found[[i for i in range(n) if i not in states.coordinates]] = True
    if around.scene.system.quasi is None:
        found[[n + i for i in range(n) if i not in states.velocities]] = True
    return jnp.asarray(found)


@Compiled
def _search(
    scene: Scene,
    states: MinimalStates,
    max_steps: int,
    params: Any,
    signals: dict[str, Any],
    t: Array,
    q: Array,
    v: Array,
    rtol: Array,
    free: Array,
) -> SteadyMotion:
    given = params, signals, t, q, v
    fixed = SteadyEquations(equations_around(scene, *stop_gradient(given)), states)
    dependent = jnp.asarray(~np.isin(np.arange(fixed.around.speeds), states.velocities))
    z0 = consistent(fixed.around, dependent)
    sizes = partial(fixed.scale, fixed.units())
    end = least_squares(jax.jit(fixed.residuals), sizes, z0, free, max_steps)
    there = fixed._replace(around=fixed.around._replace(z=end.z))
    sizes = partial(fixed.scale, there.units())
    motion = transported(there.around, dependent)
    motion = _with_inputs(motion, fixed.around, stop_gradient(signals), free)
    root, later = _examined(fixed, sizes, end, motion, free, z0, rtol)
    failure = jnp.where(root.finite, int(Status.implicit_solve_failed), int(Status.nonfinite))
    status = jnp.where(root.found & later.small, int(Status.ok), failure).astype(jnp.int32)

    near = root.near
    (traced, params_static), (arrays, inputs_static) = split(params), arrays_apart(signals)
    differentiable = _root(scene, states, Static(params_static), Static(inputs_static))
    z = differentiable(end.z, free, near.c, near.inverse, (traced, arrays, t, q, v))
    z = differentiable_if(status == int(Status.ok), z)
    problem = SteadyEquations(equations_around(scene, *given), states)
    at = problem.around.point(z)
    return SteadyMotion(
        scene.system,
        at.q,
        at.v,
        problem.around.given(z),
        residual=end.F,
        scale=later.scale,
        drift=later.drift,
        _causes=later.causes.astype(jnp.int32),
        status=status,
        iterations=end.steps,
        equations=problem.labels(),
        independent=states.names,
    )


def _with_inputs(
    motion: Transported, around: Equations, signals: dict[str, Any], free: Array
) -> Transported:
    """The same with inputs that depend on time, except the free ones."""
    if not around.opened:
        return motion
    at = around.point(around.z)

    def given(t: Array) -> Array:
        values = evaluate(signals, t.astype(around.t.dtype), at.q, at.v, around.params).peek()
        return jnp.concatenate([jnp.ravel(values[name]) for name in around.opened])

    now = given(around.t)
    change = jnp.where(free[around.size :], 0.0, jax.vmap(given)(motion.t) - now)
    return motion._replace(z=motion.z.at[:, around.size :].add(change.astype(motion.z.dtype)))


class _Later(NamedTuple):
    """The equations during the motion, as in `SteadyMotion`.

    Attributes:
        small: whether the drift is small.
        drift: largest residuals.
        causes: coordinates of their largest parts; -1 for time.
        scale: sizes of the terms of the residuals, and what is rounding over the tolerance.
    """

    small: Array
    drift: Float[Array, " e"]
    causes: Array
    scale: Float[Array, " e"]


def _examined(
    problem: SteadyEquations,
    sizes: Scale,
    end: End,
    motion: Transported,
    free: Array,
    z0: Float[Array, " m"],
    rtol: Float[Array, ""],
) -> tuple[Root, _Later]:
    """Whether the end point is a root, and whether the equations hold during its motion.

    All values of the residuals are those of one loop, as their program is long.
    """
    z, F, J, _ = end
    k, n, eps = problem.around.size, problem.around.scene.system.size, float(jnp.finfo(z.dtype).eps)
    slack, now = jnp.asarray(4 * eps * (-1.0) ** np.arange(z.shape[0]), z.dtype), problem.around.t
    halted = motion.z.at[:, :k].set(z[:k])  # what time alone changes
    beside = jnp.stack([z * (1 + slack), z * (1 - slack)])
    times = jnp.concatenate([jnp.stack([now, now]), *[motion.t.astype(now.dtype)] * 2])
    values = jax.lax.map(problem.at, (times, jnp.concatenate([beside, halted, motion.z])))
    rounding = 4 * jnp.max(jnp.abs(values[:2] - F[None]), axis=0)
    root = assessed(end, free, z0, sizes, rounding, rtol)

    by_time, later = jnp.split(values[2:], 2)
    drift = jnp.take_along_axis(later, jnp.argmax(jnp.abs(later), 0)[None], axis=0)[0]
    displacement = jnp.max(jnp.abs(motion.z - z), axis=0)
    parts = jnp.abs(J[:, :n]) * displacement[:n]
    parts = jnp.where(jnp.any(parts > 0, axis=1)[:, None], parts, displacement[:n])
    moved = jnp.max(jnp.abs(by_time - F), axis=0) <= 0.5 * jnp.abs(drift)
    causes = jnp.where(moved, jnp.argmax(parts, axis=1), -1)
    least, reach = STEADY[z.dtype.name], jnp.abs(z) + jnp.abs(z - z0) + displacement
    scale = problem.terms(reach, F, J) + root.slack / least
    return root, _Later(jnp.all(jnp.abs(drift) <= least * scale), drift, causes, scale)


def _root(
    scene: Scene, states: MinimalStates, params_static: Static, inputs_static: Static
) -> CustomJVP:
    """The root z with its derivatives by the implicit function theorem.

    Of more equations than unknowns J^+ F with a constant pseudo-inverse has the same root. The rule
    is traced only if derivatives are taken.
    """

    def problem(given: Any) -> SteadyEquations:
        traced, arrays, *state = given
        params = join(traced, params_static.tree)
        signals = eqx.combine(arrays, inputs_static.tree)
        return SteadyEquations(equations_around(scene, params, signals, *state), states)

    @CustomJVP
    def root(z: Array, free: Array, c: Array, inverse: Array, given: Any) -> Array:
        return jnp.where(free, z, problem(given).around.z)

    @root.defjvp
    def _(primals: Any, dots: Any) -> tuple[Array, Array]:
        _, free, c, inverse, given = primals
        z = root(*primals)

        def square(z: Array, given: Any) -> Array:
            there = problem(given)
            return inverse @ there.residuals(jnp.where(free, z, there.around.z)) / c

        along = jax.linearize(lambda z: square(z, given), z)[1]
        A = jax.vmap(lambda e: along(c * e), out_axes=1)(jnp.eye(z.shape[0], dtype=z.dtype))
        moved = jax.jvp(lambda given: square(z, given), (given,), (dots[4],))[1]
        of_others = jax.jvp(lambda given: problem(given).around.z, (given,), (dots[4],))[1]
        return z, jnp.where(free, -c * solve_regular(A, moved), of_others)

    return root
