"""The fixed cost of a compiled solve: short motions, beyond JAX's own call of a program.

`fixed_us` is the time of a solve of no steps: the intercept of the shortest time over attempted
steps, for motions of several lengths with 2 save times. `beyond_us` is the same without the time
of a trivial program with the same arguments and results. "one function" is a solve as it compiles
inside `jax.jit`, "tasks" the same without XLA's attributes for native functions. Programs are not
handed to another thread (`jax_cpu_enable_async_dispatch=False`).
"""

from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench._harness.timing import Call, Reference, Report, Target, build
from bench._harness.workers import Worker
from bench._problems.motions import MOTIONS, Motion
from jaxlag._core import _xla

BOUNDS = {"double pendulum, regular": 2.0, "rigid aircraft": 6.0, "Cartesian double pendulum": 8.0}
"""Largest `beyond_us` of one function."""
NAMES = (*BOUNDS, "rolling disk")
LENGTHS = (0.01, 0.05, 0.2)  # of the motions, over that of the whole motion
FORMS = {"one function": "1", "tasks": "0"}
TRIVIAL = "trivial"
OPTIONS = {"method": "dopri8", "rtol": 1e-9, "atol": 1e-9, "throw": False}


class End(NamedTuple):
    """Results of a solve."""

    q: Array
    v: Array
    ok: Array
    steps: Array


def prepare(quick: bool) -> tuple[dict[str, Call], dict[str, Any]]:
    """Compile every case in this process: the calls to time, and the columns known before."""
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    calls: dict[str, Call] = {}
    facts: dict[str, Any] = {}
    for name in NAMES[:1] if quick else NAMES:
        motion = MOTIONS[name]()
        start = jnp.asarray(motion.q0), jnp.asarray(motion.v0)
        params = jax.tree.map(jnp.asarray, {k: float(x) for k, x in motion.params.items()})

        def times(length: float, motion: Motion = motion) -> Array:
            return jnp.array([0.0, length * motion.t1])

        program = build(_solve(motion), *start, times(LENGTHS[0]), params)
        trivial = build(_trivial, *start, times(LENGTHS[0]), params)
        steps = []
        for length in LENGTHS:
            args = *start, times(length), params
            ended = program.call(*args)
            if not bool(ended.ok):
                raise RuntimeError(f"{name}: the motion did not get to its end")
            steps.append(int(ended.steps))
            calls[f"{name} {length}"] = lambda call=program.call, args=args: call(*args)
        args = *start, times(LENGTHS[0]), params
        calls[f"{name} {TRIVIAL}"] = lambda call=trivial.call, args=args: call(*args)
        facts[name] = {"steps": steps, **program.cost()}
    return calls, facts


def _solve(motion: Motion) -> Callable[..., End]:
    def solve(q0: Array, v0: Array, ts: Array, params: Any) -> End:
        end = jl.simulate(motion.system, q0, v0, ts, params, **OPTIONS)
        return End(end.q, end.v, end.ok, end.stats["accepted"] + end.stats["rejected"])

    return solve


def _trivial(q0: Array, v0: Array, ts: Array, params: Any) -> End:
    some = jnp.asarray(sum(jax.tree.leaves(params)))
    return End(q0[None] * ts[:, None], v0[None] + ts[:, None], some > 0, jnp.int32(0))


def run(quick: bool) -> Report:
    """Both forms in turn."""
    samples: dict[tuple[str, str], list[float]] = defaultdict(list)
    with ExitStack() as stack:
        workers = {
            form: stack.enter_context(Worker("calls", quick, {_xla.ATTRIBUTE_SWITCH: switch}))
            for form, switch in FORMS.items()
        }
        for _ in range(20 if quick else 200):
            for form, worker in workers.items():
                for case, seconds in worker.seconds().items():
                    samples[form, case] += seconds
    known = {form: worker.facts for form, worker in workers.items()}
    rows = [
        _row(form, name, facts, samples) for form in FORMS for name, facts in known[form].items()
    ]
    return Report(rows, *_judged(rows))


def _row(form: str, name: str, facts: Any, samples: Any) -> dict[str, Any]:
    shortest = [1e6 * min(samples[form, f"{name} {length}"]) for length in LENGTHS]
    trivial = 1e6 * min(samples[form, f"{name} {TRIVIAL}"])
    slope, fixed = np.polyfit(facts["steps"], shortest, 1)
    times = {"min_us": shortest[0], "step_us": float(slope), "fixed_us": float(fixed)}
    beyond = {"trivial_us": trivial, "beyond_us": float(fixed) - trivial}
    cost = {key: facts[key] for key in ("trace_s", "compile_s")}
    return {"motion": name, "form": form, "steps": facts["steps"][0], **times, **beyond, **cost}


def _judged(rows: list[dict[str, Any]]) -> tuple[list[Target], list[Reference]]:
    found = {(row["motion"], row["form"]): row for row in rows}
    names = [row["motion"] for row in rows if row["form"] == "one function"]
    targets = [
        Target(
            f"us beyond JAX's call of a trivial program, {name}",
            found[name, "one function"]["beyond_us"],
            "<=",
            BOUNDS[name],
        )
        for name in names
        if name in BOUNDS
    ]
    references = [
        Reference(
            f"{found[name, 'one function']['fixed_us'] / found[name, 'tasks']['fixed_us']:.3g}",
            f"times as long, without steps: one function as tasks, {name}",
        )
        for name in names
    ]
    return targets, references
