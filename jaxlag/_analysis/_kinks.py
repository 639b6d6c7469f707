"""Kinks and jumps: declared functions that have no derivative at a state."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array, Bool, Float

from jaxlag._analysis._equations import Equations, Point
from jaxlag._core._jaxprs import equations, within
from jaxlag._lowering import ArrayTerms
from jaxlag._model._forces import reads_lam
from jaxlag._model._inputs import evaluate
from jaxlag._tracing._nonsmooth_points import outcomes

DISTANCES = (0.3, 0.45, 0.625)
"""Distances of both sides, over 1 + |z| of each entry, as powers of eps: 2e-5, 1e-7, 2e-10."""
LEAST, LEAST_JUMP = 1e-6, 1e-9
"""Least differences of slopes and of values over their sizes: series that replace a function are
usually closer."""
LIKE = 0.5, 10.0
"""Change at the smaller of two distances over that at the larger one. Of a smooth function it is
the ratio of the distances, 0.005 or 0.002, of a series that cancels the inverse, or its square."""
ROUNDINGS = 64
ORDERS = frozenset(("eq", "ge", "gt", "is_finite", "le", "lt", "ne", "and", "not", "or", "xor"))
BRANCHES = frozenset(("clamp", "cond", "max", "min", "select_n", "while"))
PARTS = frozenset(("abs", "atan2", "ceil", "floor", "rem", "round", "sign"))
EXTREMES = frozenset(("argmax", "argmin", "cummax", "cummin", "reduce_max", "reduce_min"))
COMPARISONS = ORDERS | BRANCHES | PARTS | EXTREMES | {"sort", "top_k"}
"""Operations whose results may have kinks or jumps."""


class _Declared(NamedTuple):
    """A declared function, with its name in messages.

    Attributes:
        name: in messages.
        derived: what the linearized equations take derivatives of, as a function of (z, lam).
        value: the declared function itself, if it is shorter.
    """

    name: str
    derived: Callable
    value: Callable | None = None


def kinks(around: Equations, directions: Float[Array, "m k"]) -> list[str]:
    """The functions without a derivative along some direction, with their lines.

    Args:
        around: the equations around a state.
        directions: of z, as columns.
    """
    lam = around.multipliers()
    z, found = jnp.concatenate([around.z, lam]), []
    directions = jax.scipy.linalg.block_diag(directions, jnp.eye(lam.shape[0], dtype=z.dtype))
    for name, derived, value in _declared(around):
        program = jax.make_jaxpr(value or derived)(z)
        if not _may_bend(program, z, directions):
            continue
        bent = np.asarray(jax.jit(partial(bends, derived))(z, directions))
        if np.any(bent):
            line = _line(program, z, directions[:, int(np.argmax(bent))])
            found.append(f"{name} ({line})" if line else name)
            if name == QUASI:
                break  # All others read them.
    return found


def _may_bend(program: ClosedJaxpr, z: Array, directions: Array) -> bool:
    """Whether a comparison has another outcome near z, or is inside of a loop."""
    compared = [eqn for eqn in equations(program) if _compares(eqn)]
    if not compared:
        return False
    looped = (x for eqn in equations(program) if eqn.primitive.name in LOOPS for x in within(eqn))
    if any(map(_compares, looped)):
        return True
    eps = float(jnp.finfo(z.dtype).eps)
    size = jnp.max(jnp.abs(directions) / (1.0 + jnp.abs(z))[:, None], axis=0)
    steps = [sign * eps**power * (directions / size).T for power in DISTANCES for sign in (1, -1)]
    places = z + jnp.concatenate([jnp.zeros((1, z.shape[0]), z.dtype), *steps])
    of = jax.vmap(lambda z: outcomes(program, [z], [True], guards=True))
    found = jax.jit(of)(places)  # compiled: one operation after the other takes seconds
    return found is not None and bool(jnp.any(found[1:] != found[:1]))


LOOPS = "scan", "while"
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
    """Whatever the linearized equations take derivatives of, as functions of (z, multipliers)."""
    system, t, params = around.scene.system, around.t, around.params
    n, count = system.size, around.z.shape[0]

    def point(z: Array) -> Point:
        return around.point(z[:count])

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

    def value(z: Array) -> Array:
        q, _, v, _, _ = point(z)
        return jnp.asarray(system.lagrangian(t, q, v, params))

    yield _Declared("the Lagrangian", gradient, value)
    for force in system.forces:
        alone = replace(system._terms, forces=(force,))

        def effort(z: Array, alone: ArrayTerms = alone) -> Array:
            at, lam = point(z), z[count:] if any(map(reads_lam, alone.forces)) else None
            return alone.force(t, at.q, at.v, params, at.values, lam)

        yield _Declared(f"force {force.name!r}", effort)
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

        def signal_value(at: Any, name: str = name, signal: Any = signal) -> Array:
            return evaluate({name: signal}, t, at.q, at.v, params)[name]

        yield _Declared(f"input {name!r}", of(signal_value))
    for output in around.scene.outputs.each:
        if output.kind == "function":
            yield _Declared(
                f"output {output.name!r}",
                of(lambda at, f=output.function: f(t, at.q, at.v, params)),
            )


def _compares(eqn: Any) -> bool:
    """Whether results of an operation may have kinks or jumps."""
    if eqn.primitive.name == "convert_element_type":  # from numbers to their integral parts
        given, made = eqn.invars[0].aval.dtype, eqn.params["new_dtype"]
        return jnp.issubdtype(given, jnp.floating) and not jnp.issubdtype(made, jnp.inexact)
    return eqn.primitive.name in COMPARISONS


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
    steepest, largest = (jnp.max(x, initial=0.0, where=jnp.isfinite(x)) for x in (steep, size))
    of_slopes = jnp.maximum(LEAST * steep, ROUNDINGS * eps * steepest)
    of_values = jnp.maximum(LEAST_JUMP * size, ROUNDINGS * eps * (steepest + largest))

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
