"""Kinks and jumps: declared functions that have no derivative at a state."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array, Bool, Float

from jaxlag._analysis._equations import Equations
from jaxlag._core._jaxprs import equations
from jaxlag._lowering import ArrayTerms
from jaxlag._model._inputs import evaluate
from jaxlag._system._closure_tracers import declared
from jaxlag._tracing._nonsmooth_points import outcomes

DISTANCES = (0.3, 0.45, 0.625)
"""Distances of both sides, over 1 + |z| of each entry, as powers of eps: 2e-5, 1e-7, 2e-10."""
LEAST = 1e-6
"""Least difference over the size of the slope: series that replace a function are closer."""
LIKE = 0.5, 10.0
"""Change at the smaller of two distances over that at the larger one. Of a smooth function it is
the ratio of the distances, 0.005 or 0.002, of rounding the inverse, or its square."""
ROUNDINGS = 64
COMPARISONS = frozenset(
    (
        *("abs", "and", "argmax", "argmin", "ceil", "clamp", "cond", "cummax", "cummin", "eq"),
        *("floor", "ge", "gt", "is_finite", "largest", "le", "lt", "max", "min", "ne", "not", "or"),
        *("reduce_max", "reduce_min", "rem", "round", "select_n", "sign", "smallest", "sort"),
        *("while", "xor"),
    )
)
"""Operations whose results may have kinks or jumps."""


class _Declared(NamedTuple):
    """A declared function of z, with its name in messages."""

    name: str
    function: Callable


def compares(around: Equations) -> bool:
    """Whether declared functions compare values, so that they may have kinks."""
    system, t, params = around.scene.system, around.t, around.params

    def everything(z: Array) -> Any:
        q, _, v, _, values = around.point(z)
        functions = [x.function for x in around.scene.outputs.each if x.kind == "function"]
        of_outputs = [function(t, q, v, params) for function in functions]
        return declared(system, t, q, v, params, values, None), dict(values), of_outputs

    return _has_comparisons(jax.make_jaxpr(everything)(around.z))


def kinks(around: Equations, directions: Float[Array, "m k"]) -> list[str]:
    """The functions without a derivative along some direction, with their lines.

    Args:
        around: the equations around a state.
        directions: of z, as columns.
    """
    z, found = around.z, []
    for name, function in _declared(around):
        program = jax.make_jaxpr(function)(z)
        if not _has_comparisons(program):
            continue
        bent = np.asarray(jax.jit(partial(bends, function))(z, directions))
        if np.any(bent):
            line = _line(program, z, directions[:, int(np.argmax(bent))])
            found.append(f"{name} ({line})" if line else name)
            if name == QUASI:
                break  # All others read them.
    return found


QUASI = "the quasi-velocities"


def _line(program: ClosedJaxpr, z: Array, d: Array) -> str:
    """The line of a comparison whose outcome changes along d; "" if it is unknown."""
    h = float(jnp.finfo(z.dtype).eps) ** DISTANCES[-1] * (1.0 + jnp.abs(z))
    step = d / jnp.max(jnp.abs(d) / h)
    for eqn in equations(program):
        ends = [outcomes(program, [z + s * step], [True], eqn) for s in (1.0, -1.0)]
        if ends[0] is not None and np.any(np.asarray(ends[0]) != np.asarray(ends[1])):
            return source_info_util.summarize(eqn.source_info)
    return ""


def _declared(around: Equations) -> Iterator[_Declared]:
    """Whatever the linearized equations take derivatives of, as functions of z."""
    system, t, params = around.scene.system, around.t, around.params
    point, n = around.point, system.size

    def of(function: Callable) -> Callable:
        return lambda z: jnp.ravel(jnp.asarray(function(point(z))))

    if system.quasi is not None:
        yield _Declared(QUASI, of(lambda at: at.v))

    def gradient(z: Array) -> Array:
        """(dL/dq, p), and the derivatives of p, which are M."""
        q, _, v, _, _ = point(z)
        terms = ArrayTerms(system.lagrangian, (), ())
        L = jax.grad(lambda y: jnp.asarray(system.lagrangian(t, y[:n], y[n:], params)))
        return jnp.concatenate([L(jnp.concatenate([q, v])), terms.mass(t, q, v, params).ravel()])

    yield _Declared("the Lagrangian", gradient)
    for force in system.forces:
        alone = ArrayTerms(system.lagrangian, (force,), system.constraints)

        def effort(at: Any, alone: ArrayTerms = alone) -> Array:
            rows = jnp.zeros((system._rows(params, at.q.dtype).size,), at.q.dtype)
            return alone.force(t, at.q, at.v, params, at.values, rows)

        yield _Declared(f"force {force.name!r}", of(effort))
    for constraint in system.constraints:
        rows = ArrayTerms(system.lagrangian, (), (constraint,))

        def residuals(at: Any, rows: ArrayTerms = rows) -> Array:
            A, b = rows.rows(t, at.q, at.v, params)
            return jnp.concatenate([A @ at.v + b, A.ravel()])

        names = ", ".join(map(repr, constraint.all_names))
        yield _Declared(f"constraint {names}", of(residuals))
    if system.states is not None:
        states = system.states
        yield _Declared(
            "the rates of the states",
            of(lambda at: states.rates_at(t, at.q, at.v, at.x, params, at.values)),
        )
    for name, signal in around.feedback.items():

        def value(at: Any, name: str = name, signal: Any = signal) -> Array:
            return evaluate({name: signal}, t, at.q, at.v, params)[name]

        yield _Declared(f"input {name!r}", of(value))
    for output in around.scene.outputs.each:
        if output.kind == "function":
            yield _Declared(
                f"output {output.name!r}",
                of(lambda at, f=output.function: f(t, at.q, at.v, params)),
            )


def _has_comparisons(program: ClosedJaxpr) -> bool:
    """Whether its results may have kinks or jumps."""
    return any(eqn.primitive.name in COMPARISONS for eqn in equations(program))


def bends(
    function: Callable[[Array], Array], z: Float[Array, " m"], directions: Float[Array, "m k"]
) -> Bool[Array, " k"]:
    """Whether derivatives along directions differ on both sides of z, or from those at z.

    A difference counts if it stays as the sides come closer: one of a smooth function falls with
    the distance, one by rounding grows. Differences below the rounding of the largest slope do not
    count. Values that jump do. If both sides agree, z may be a single point with another
    derivative, as the code of a guard often has: then larger distances are compared, in which
    rounding is small.

    Args:
        function: of z, with one array as result.
        z: the state.
        directions: as columns.
    """
    eps = float(jnp.finfo(z.dtype).eps)
    distances = jnp.asarray([eps**power for power in DISTANCES], z.dtype)

    def along(d: Array) -> tuple[Array, ...]:
        d = d / jnp.max(jnp.abs(d) / (1.0 + jnp.abs(z)))
        _, here = jax.jvp(function, (z,), (d,))

        def around(h: Array) -> tuple[Array, ...]:
            (f, slope), (g, tangent) = (
                jax.jvp(function, (z + s * h * d,), (d,)) for s in (1.0, -1.0)
            )
            steep = jnp.maximum(jnp.maximum(jnp.abs(slope), jnp.abs(tangent)), jnp.abs(here))
            turn, away = slope - tangent, slope + tangent - 2.0 * here
            leap = f - g - h * (slope + tangent)
            return turn, away, leap, steep, jnp.maximum(jnp.abs(f), jnp.abs(g))

        return jax.vmap(around)(distances)

    turn, away, leap, steep, size = (jnp.abs(x) for x in jax.vmap(along, 1)(directions))
    rounding = ROUNDINGS * eps * jnp.max(steep)
    of_slopes = jnp.maximum(LEAST * steep, rounding)
    of_values = jnp.maximum(LEAST * size, rounding + ROUNDINGS * eps * jnp.max(size))

    def stays(change: Array, floor: Array, larger: int) -> Array:
        """Whether changes at a distance and at the next smaller one are alike."""
        first, second = change[:, larger], change[:, larger + 1]
        alike = (LIKE[0] * first < second) & (second < LIKE[1] * first)
        return jnp.any(alike & (second > floor[:, larger + 1]), axis=-1)

    single = jnp.where(turn < of_slopes, away, 0.0)
    return stays(turn, of_slopes, 1) | stays(leap, of_values, 1) | stays(single, of_slopes, 0)


def examined(around: Equations, basis: Float[Array, "s k"]) -> Float[Array, "m j"]:
    """Directions of z: those of all states and inputs, and two random combinations of these."""
    directions = around.directions(basis)
    weights = np.random.default_rng(0).uniform(-1.0, 1.0, (directions.shape[1], 2))
    size = jnp.max(jnp.abs(directions) / (1.0 + jnp.abs(around.z))[:, None], axis=0)
    mixed = directions / size @ jnp.asarray(weights, basis.dtype)
    return jnp.concatenate([directions, mixed], axis=1)
