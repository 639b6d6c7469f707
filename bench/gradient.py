"""Derivatives of one solve, of 16 and of 1,024: their cost relative to the solve, and their errors.

The loss is |y(10)|^2 of the double pendulum. Inputs are the start (2 angles, 2 rates) and four
parameters (2 masses, 2 lengths). `ratio` is the time divided by that of the plain solve with the
same system and number of lanes. `error` is the largest error of a component divided by the largest
component, against the same program at tolerance 1e-13. For the solve it is that of the end state.
Other systems are differentiated with respect to initial velocities and all params. `temp_mb` is
the temporary memory of the compiled program. For a reverse derivative this is mostly the memory
of the stored steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

import jaxlag as jl
from bench._harness.timing import Reference, Report, Target, build, interleaved, spread
from bench._problems import double_pendulum as pendulum
from bench._problems import mechanisms, scenes
from systems import rigid_aircraft

LANES = 16
MANY = 1024  # in the lanes of a vectorized loop
INPUTS = ("m1", "m2", "h1", "h2")
PENDULUM = "double pendulum"
SOLVE, REVERSE, FORWARD, HESSIAN = "solve", "grad", "jacfwd, 8 inputs", "hessian, 8 x 8"
SLOPE = "jacfwd of the end, 4 x 8"
MODES = ("recorded", "checkpoints", "forward")
MAX_STEPS = (1024, 16384, 262144)  # bounds whose memory is compared


class Case(NamedTuple):
    """A function of (x, tolerance), batched if x has several lanes."""

    name: str
    lanes: int
    function: Callable[[Array, Array], Array]
    x: Array
    system: str = PENDULUM
    max_steps: int = pendulum.MAX_STEPS


def end(
    x: Array, tolerance: Array, mode: str = "auto", max_steps: int = pendulum.MAX_STEPS
) -> Array:
    """State at the last time, from x = (q0, v0, masses and lengths)."""
    params = pendulum.params() | dict(zip(INPUTS, x[4:], strict=True))
    ts = pendulum.times(2)
    options = {"rtol": tolerance, "atol": tolerance, "gradient": mode, "max_steps": max_steps}
    motion = jl.simulate(pendulum.system, x[:2], x[2:4], ts, params, throw=False, **options)
    return jnp.concatenate([motion.q[-1], motion.v[-1]])


def loss(x: Array, tolerance: Array, *options: Any) -> Array:
    """|y(10)|^2."""
    return jnp.sum(end(x, tolerance, *options) ** 2)


def _cases(quick: bool) -> list[Case]:
    one, several = _inputs(1), _inputs(LANES)
    cases = [
        Case(SOLVE, 1, end, one),
        Case(REVERSE, 1, jax.grad(loss), one),
        Case(FORWARD, 1, jax.jacfwd(loss), one),
        Case(SOLVE, LANES, jax.vmap(end, (0, None)), several),
        Case(REVERSE, LANES, jax.vmap(jax.grad(loss), (0, None)), several),
    ]
    if quick:
        return cases
    many = _inputs(MANY)
    cases.append(Case(SOLVE, MANY, jax.vmap(end, (0, None)), many))
    cases.append(Case(REVERSE, MANY, jax.vmap(jax.grad(loss), (0, None)), many))
    cases.append(Case(HESSIAN, 1, jax.hessian(loss), one))
    cases.append(Case(SLOPE, 1, jax.jacfwd(end), one))
    for steps in MAX_STEPS:
        for mode in MODES:
            gradient = jax.grad(lambda x, tol, m=mode, n=steps: loss(x, tol, m, n))
            cases.append(Case(f"{REVERSE}, {mode}", 1, gradient, one, max_steps=steps))
    return cases + _others()


def _others() -> list[Case]:
    """Solve and gradient: quasi-velocities of a rigid body, rods as constraints, a long chain."""
    entry, bobs, chain = rigid_aircraft.entry, mechanisms.double_pendulum(), scenes.links(8)
    links = jl.System(chain.lagrangian, tuple(f"theta{i}" for i in range(8)))
    masses = {name: bobs.params[name] for name in ("m1", "m2")}
    found = []
    for name, solve, moving in (
        ("rigid aircraft", *_short(entry.system, *entry.start(), entry.example.params)),
        # Velocities and lengths are fixed: if changed, they could violate the rods' constraints.
        ("Cartesian double pendulum", *_short(bobs.system, bobs.q0, bobs.v0, bobs.params, masses)),
        ("chain of 8 links", *_short(links, chain.q0, chain.v0, chain.params)),
    ):

        def squared(x: Array, tolerance: Array, solve: Any = solve) -> Array:
            return jnp.sum(solve(x, tolerance) ** 2)

        found.append(Case(SOLVE, 1, solve, moving, name))
        found.append(Case(REVERSE, 1, jax.grad(squared), moving, name))
    return found


def _short(
    system: jl.System, q0: Any, v0: Any, params: Any, masses: Any = None
) -> tuple[Callable[[Array, Array], Array], Array]:
    """(state after 2 s as a function of x, x), where x is v0 and all params, or only `masses`."""
    q0 = jnp.asarray(q0, float)
    given = {"v0": v0, "params": dict(params)} if masses is None else {"params": masses}
    moving, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.asarray(x, float), given))

    def solve(x: Array, tolerance: Array) -> Array:
        parts = unravel(x)
        start = parts.get("v0", jnp.asarray(v0, float))
        options = {"rtol": tolerance, "atol": tolerance, "throw": False}
        given = dict(params) | parts["params"]
        motion = jl.simulate(system, q0, start, [0.0, 2.0], given, **options)
        return jnp.concatenate([motion.q[-1], motion.v[-1]])

    return solve, moving


def run(quick: bool) -> Report:
    """All derivatives in turn."""
    tolerance, tight = jnp.asarray(pendulum.TOLERANCE), jnp.asarray(pendulum.TIGHT)
    calls, rows, values, errors = {}, {}, {}, {}
    for case in _cases(quick):
        x = case.x
        program = build(case.function, x, tolerance)
        key = (case.system, case.name, case.lanes, case.max_steps)
        calls[key] = lambda call=program.call, x=x: call(x, tolerance)
        values[key] = calls[key]()
        errors[key] = _differences(values[key], program.call(x, tight), case.lanes)
        memory = program.call.memory_analysis()
        rows[key] = {
            "system": case.system,
            "case": case.name,
            "lanes": case.lanes,
            "max_steps": case.max_steps,
            "error": float(jnp.max(errors[key])),
            "temp_mb": memory.temp_size_in_bytes / 1e6,
            **program.cost(),
        }
    samples = interleaved(calls, 3 if quick else 10)
    for key, row in rows.items():
        row |= spread(samples[key], "ms")
        plain = rows[row["system"], SOLVE, row["lanes"], pendulum.MAX_STEPS]
        row["ratio"] = row["min_ms"] / plain["min_ms"]
    return Report(list(rows.values()), *_judged(rows, values, errors))


def _inputs(lanes: int) -> Array:
    """The start and four parameters; for several lanes, each changed by up to 0.1."""
    x = jnp.concatenate([pendulum.start(), jnp.ones(len(INPUTS))])
    if lanes == 1:
        return x
    return x + jax.random.uniform(jax.random.key(0), (lanes, x.size), minval=-0.1, maxval=0.1)


def _differences(a: Array, b: Array, lanes: int) -> Array:
    """Largest difference relative to the largest component, in each lane."""
    a, b = (x.reshape(lanes, -1) for x in (a, b))
    return jnp.max(jnp.abs(a - b), axis=1) / jnp.max(jnp.abs(b), axis=1)


def _sensitivity(derivative: Array, value: Array) -> float:
    """Largest relative change of a value over that of the inputs, which are about 1."""
    return float(jnp.max(jnp.sum(jnp.abs(derivative), axis=1)) / jnp.max(jnp.abs(value)))


def _judged(
    rows: dict[Any, Any], values: dict[Any, Array], errors: dict[Any, Array]
) -> tuple[list[Target], list[Reference]]:
    def of(table: dict[Any, Any], name: str, lanes: int = 1) -> Any:
        return table[PENDULUM, name, lanes, pendulum.MAX_STEPS]

    solve, reverse, lanes = of(rows, SOLVE), of(rows, REVERSE), of(rows, REVERSE, LANES)
    gradient = of(values, REVERSE)
    others = [of(values, FORWARD)]
    others += [x for key, x in values.items() if key[1].removeprefix(f"{REVERSE}, ") in MODES]
    between = max(float(_differences(x, gradient, 1)[0]) for x in others)
    targets = [
        Target("largest relative difference of gradients by any mode", between, "<=", 1e-10),
        Target(
            "times the error of the solve: error of the gradient",
            reverse["error"] / solve["error"],
            "<=",
            10.0,
        ),
        Target("times the solve: gradient", reverse["ratio"], "<=", 4.0),
        Target("ms for a gradient", reverse["min_ms"], "<=", 0.5),
        Target(f"times the solve, {LANES} lanes: gradient", lanes["ratio"], "<=", 3.0),
        Target("times the solve: forward, 8 inputs", of(rows, FORWARD)["ratio"], "<=", 4.5),
        Target("s to compile a gradient", reverse["trace_s"] + reverse["compile_s"], "<=", 5.0),
    ]
    more = []
    if (PENDULUM, HESSIAN, 1, pendulum.MAX_STEPS) in rows:
        hessian = of(rows, HESSIAN)
        many = of(rows, REVERSE, MANY)
        targets += [
            Target(f"us for a gradient, {MANY} at once", 1e3 * many["min_ms"] / MANY, "<=", 150.0),
            Target(f"times the solve, {MANY} lanes: gradient", many["ratio"], "<=", 4.0),
            Target("error of the hessian", hessian["error"], "<=", 1e-6),
            Target("times the solve: hessian, 8 x 8", hessian["ratio"], "<=", 25.0),
            Target("s to compile a hessian", hessian["trace_s"] + hessian["compile_s"], "<=", 10.0),
        ]
        more_sensitive = _sensitivity(of(values, HESSIAN), gradient)
        more_sensitive /= _sensitivity(of(values, SLOPE), of(values, SOLVE))
        claim = "times as sensitive to the inputs as the state: the gradient, whatever computes it"
        more.append(Reference(f"{more_sensitive:.3g}", claim))
    per_lane = lanes["min_ms"] / LANES / reverse["min_ms"]
    ratios = of(errors, REVERSE, LANES) / of(errors, SOLVE, LANES)
    typical = jnp.exp(jnp.mean(jnp.log(ratios)))
    references = [
        Reference(
            f"{typical:.3g}, {jnp.max(ratios):.3g}",
            f"times the error of the solve: that of the gradient in {LANES} starts, mean and worst",
        ),
        Reference(f"{per_lane:.3g}", f"times as long per gradient: {LANES} lanes at once as one"),
        *more,
        Reference("2.7 to 4.3", "times the solve: hand-written adjoint, any number of inputs"),
        Reference("4.4", "times the solve: hand-written forward sensitivities, 8 inputs"),
        Reference("2.4 to 3", "times the solve: hand-written adjoint in native lanes"),
    ]
    return targets, references
