"""Derivatives of one solve and of 16: what they cost beside the solve, and how exact they are.

The loss is |y(10)|^2 of the double pendulum. Inputs are the start (2 angles, 2 rates) and four
parameters (2 masses, 2 lengths); the Hessian is in the start alone. `ratio` is to the plain
solve of as many lanes. `error` is the largest over the components, relative to the largest of
them, against the same program at tolerance 1e-13; that of the solve is of its end state.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from bench import _double_pendulum as pendulum
from bench._harness import Reference, Report, Target, build, interleaved, spread

LANES = 16
INPUTS = ("m1", "m2", "h1", "h2")
SOLVE, REVERSE, FORWARD, HESSIAN = "solve", "grad", "jacfwd, 8 inputs", "hessian, 4 x 4"


class Case(NamedTuple):
    """A function of (x, tolerance), batched where x has several lanes."""

    name: str
    lanes: int
    function: Callable[[Array, Array], Array]


def end(x: Array, tolerance: Array) -> Array:
    """State at the last time, from x = (q0, v0, masses and lengths)."""
    params = pendulum.params() | dict(zip(INPUTS, x[4:], strict=True))
    return pendulum.with_jaxlag(pendulum.times(2))(x[:4], params, tolerance).states[-1]


def loss(x: Array, tolerance: Array) -> Array:
    """|y(10)|^2."""
    return jnp.sum(end(x, tolerance) ** 2)


def hessian(x: Array, tolerance: Array) -> Array:
    """Second derivatives of the loss in (q0, v0)."""
    return jax.hessian(lambda y0: loss(jnp.concatenate([y0, x[4:]]), tolerance))(x[:4])


def run(quick: bool) -> Report:
    """All derivatives in turn."""
    cases = [
        Case(SOLVE, 1, end),
        Case(REVERSE, 1, jax.grad(loss)),
        Case(FORWARD, 1, jax.jacfwd(loss)),
        Case(SOLVE, LANES, jax.vmap(end, (0, None))),
        Case(REVERSE, LANES, jax.vmap(jax.grad(loss), (0, None))),
    ]
    if not quick:
        cases.insert(3, Case(HESSIAN, 1, hessian))
    tolerance, tight = jnp.asarray(pendulum.TOLERANCE), jnp.asarray(pendulum.TIGHT)
    calls, rows, values = {}, {}, {}
    for case in cases:
        x = _inputs(case.lanes)
        program = build(case.function, x, tolerance)
        key = (case.name, case.lanes)
        calls[key] = lambda call=program.call, x=x: call(x, tolerance)
        values[key] = calls[key]()
        error = _difference(values[key], program.call(x, tight), case.lanes)
        rows[key] = {"case": case.name, "lanes": case.lanes, "error": error, **program.cost()}
    samples = interleaved(calls, 3 if quick else 10)
    for key, row in rows.items():
        row |= spread(samples[key], "ms")
        row["ratio"] = row["min_ms"] / rows[SOLVE, row["lanes"]]["min_ms"]
    between = _difference(values[FORWARD, 1], values[REVERSE, 1], 1)
    return Report(list(rows.values()), *_judged(rows, between))


def _inputs(lanes: int) -> Array:
    """The start and four parameters; of several lanes, each within 10 %."""
    x = jnp.concatenate([pendulum.start(), jnp.ones(len(INPUTS))])
    if lanes == 1:
        return x
    return x + jax.random.uniform(jax.random.key(0), (lanes, x.size), minval=-0.1, maxval=0.1)


def _difference(a: Array, b: Array, lanes: int) -> float:
    """Largest difference relative to the largest component, in the worst lane."""
    a, b = (x.reshape(lanes, -1) for x in (a, b))
    return float(jnp.max(jnp.max(jnp.abs(a - b), axis=1) / jnp.max(jnp.abs(b), axis=1)))


def _judged(rows: dict[Any, Any], between: float) -> tuple[list[Target], list[Reference]]:
    solve, reverse = rows[SOLVE, 1], rows[REVERSE, 1]
    targets = [
        Target("relative difference of forward and reverse gradient", between, "<=", 1e-10),
        Target(
            "times the error of the solve: error of the gradient",
            reverse["error"] / solve["error"],
            "<=",
            10.0,
        ),
    ]
    per_lane = rows[REVERSE, LANES]["min_ms"] / LANES / reverse["min_ms"]
    references = [
        Reference(f"{per_lane:.3g}", f"times as long per gradient: {LANES} lanes at once as one"),
        Reference("2.7 to 4.3", "times the solve: hand-written adjoint, any number of inputs"),
        Reference("4.4", "times the solve: hand-written forward sensitivities, 8 inputs"),
        Reference("2.4 to 3", "times the solve: hand-written adjoint in native lanes"),
    ]
    return targets, references
