"""Batches of double pendulums by `jax.vmap`: time per trajectory, and utilization of the lanes.

The lanes start at rest from angles drawn from (-2, 2) rad, so that some swing and some tumble.
A vmapped solve runs until its slowest lane is finished. `lane_use` is the mean number of attempted
steps divided by the largest. The driven case also draws parameters, rates and a zero-order-hold
torque. For comparison: the same solves one after another (`lax.map`), and diffrax vmapped on
equations written by hand and on naive autodiff.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench._harness.timing import Reference, Report, Target, build, interleaved, spread
from bench._problems import double_pendulum as pendulum
from bench._problems.double_pendulum import Ended

COMPARED = 256
KNOTS = 21
TIMES = pendulum.times(2)


class Case(NamedTuple):
    """A batched solve."""

    name: str
    lanes: int
    solve: Callable[..., Ended]
    args: tuple[Any, ...]


def run(quick: bool) -> Report:
    """All batches in turn."""
    sizes = (1, 16, COMPARED) if quick else (1, 16, COMPARED, 4096)
    cases = _cases(sizes)
    calls, rows = {}, {}
    for case in cases:
        program = build(case.solve, *case.args)
        ended = program.call(*case.args)
        if not bool(jnp.all(jnp.isfinite(ended.states))):
            raise RuntimeError(f"{case.name}, {case.lanes} lanes: a lane did not get to the end")
        key = (case.name, case.lanes)
        calls[key] = lambda call=program.call, args=case.args: call(*args)
        rows[key] = {"case": case.name, "lanes": case.lanes, **_use(ended), **program.cost()}
    samples = interleaved(calls, 2 if quick else 6, budget_s=1.0 if quick else 15.0)
    for key, row in rows.items():
        row |= spread(samples[key], "us", lanes=row["lanes"])
    return Report(list(rows.values()), *_judged(rows, sizes[-1]))


def _cases(sizes: tuple[int, ...]) -> list[Case]:
    one = pendulum.with_jaxlag(TIMES)
    by_hand, naive = (
        pendulum.with_diffrax(field, TIMES) for field in (pendulum.by_hand, pendulum.naive)
    )
    common = (pendulum.params(), jnp.asarray(pendulum.TOLERANCE))
    starts = {lanes: (_starts(lanes), *common) for lanes in sizes}
    axes = (0, None, None)

    def sequential(y0: Array, params: Any, tolerance: Array) -> Ended:
        return jax.lax.map(lambda y0: one(y0, params, tolerance), y0)

    return [
        *(Case("vmap", lanes, jax.vmap(one, axes), starts[lanes]) for lanes in sizes),
        Case("vmap, driven", COMPARED, jax.vmap(_driven), _driven_lanes(COMPARED)),
        Case("lax.map", COMPARED, sequential, starts[COMPARED]),
        Case("by hand", COMPARED, jax.vmap(by_hand, axes), starts[COMPARED]),
        Case("naive", COMPARED, jax.vmap(naive, axes), starts[COMPARED]),
    ]


def _starts(lanes: int) -> Array:
    q0 = jax.random.uniform(jax.random.key(0), (lanes, 2), minval=-2.0, maxval=2.0)
    return jnp.concatenate([q0, jnp.zeros_like(q0)], axis=1)


def _driven(q0: Array, v0: Array, params: Any, torque: jl.ZeroOrderHold) -> Ended:
    motion = jl.simulate(
        pendulum.driven, q0, v0, TIMES, params, inputs={"torque": torque}, throw=False
    )
    return pendulum.ended(motion)


def _driven_lanes(lanes: int) -> tuple[Any, ...]:
    """Angles, rates, parameters within 10 % and a torque of up to 1 N m, held for 0.5 s."""
    keys = jax.random.split(jax.random.key(1), 4)

    def draw(key: Array, size: int, bound: float) -> Array:
        return jax.random.uniform(key, (lanes, size), minval=-bound, maxval=bound)

    names = list(pendulum.PARAMS)
    factors = 1.0 + draw(keys[2], len(names), 0.1)
    params = {
        name: value * factors[:, i] for i, (name, value) in enumerate(pendulum.PARAMS.items())
    }
    knots = jnp.asarray(pendulum.times(KNOTS))
    torque = jax.vmap(lambda values: jl.ZeroOrderHold(knots, values))(draw(keys[3], KNOTS, 1.0))
    return draw(keys[0], 2, 2.0), draw(keys[1], 2, 1.0), params, torque


def _use(ended: Ended) -> dict[str, Any]:
    steps = np.asarray(ended.accepted + ended.rejected)
    return {
        "steps_min": int(steps.min()),
        "steps_mean": float(steps.mean()),
        "steps_max": int(steps.max()),
        "lane_use": float(steps.mean() / steps.max()),
    }


def _judged(rows: dict[Any, Any], largest: int) -> tuple[list[Target], list[Reference]]:
    us = {key: row["min_us"] for key, row in rows.items()}
    batch = us["vmap", COMPARED]
    targets = [
        Target(
            f"times faster: jaxlag than naive autodiff, {COMPARED} lanes",
            us["naive", COMPARED] / batch,
            ">=",
            2.0,
        ),
        Target(
            "times as long: everything drawn and driven by a torque as the angles drawn alone",
            us["vmap, driven", COMPARED] / batch,
            "<=",
            1.5,
        ),
    ]
    references = [
        Reference(
            f"{batch / us['by hand', COMPARED]:.3g}",
            f"times as long: jaxlag as the hand-written equations, {COMPARED} lanes",
        ),
        Reference(
            f"{batch / us['lax.map', COMPARED]:.3g}",
            f"times as long: {COMPARED} lanes at once as one after another",
        ),
        Reference("15 us", "16 lanes in one native loop, on two cores, where jaxlag is to get"),
        Reference("14.4 us", "heyoka on two cores"),
    ]
    if largest > COMPARED:
        figure = f"{us['vmap', largest] / batch:.3g}"
        what = f"times as long per trajectory: {largest} lanes as {COMPARED}"
        references.insert(2, Reference(figure, what))
    return targets, references
