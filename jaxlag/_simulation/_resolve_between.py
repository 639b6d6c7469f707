"""States between save times: a new solve from the last save time before."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlag._core._arrays import concrete, real
from jaxlag._core._errors import invalid, unsupported
from jaxlag._simulation._abstract_solution import AbstractSolution

_ASK = "Make it a save time: ts=jnp.linspace(0, 10, 501)."


def states_at(motion: AbstractSolution, t: Any, solve: Callable) -> Any:
    """See `Solution.at`.

    Args:
        motion: a Solution.
        t: times.
        solve: `simulate`.
    """
    motion.require_single("at")
    if not concrete(motion.ts, motion.q, t):
        raise unsupported("`at` inside jit, vmap or a derivative", "it needs concrete values", _ASK)
    if motion.tolerances is None:
        raise unsupported("`at` of a motion with fixed steps", "the steps do not end at t", _ASK)
    if motion._solver:
        raise unsupported(
            f"`at` of a motion by {motion._solver}", "its method was not given by name", _ASK
        )
    asked = np.atleast_1d(np.asarray(real("at: t", t)))
    if asked.ndim != 1:
        raise invalid(
            "at: t", "be a number or a sequence of numbers", f"its shape was {asked.shape}"
        )
    ts = np.asarray(motion.ts)
    time_direction = 1.0 if ts[-1] >= ts[0] else -1.0
    last = float(motion.last_time)
    outside = ~((time_direction * (asked - ts[0]) >= 0) & (time_direction * (last - asked) >= 0))
    if np.any(outside):
        was = f"one was {asked[outside][0]}"
        raise invalid("at: t", f"lie within the motion, from {ts[0]} to {last} s", was)
    times = np.unique(time_direction * asked)
    before = int(np.searchsorted(time_direction * ts, times[0], side="right")) - 1
    times = time_direction * times[times > time_direction * ts[before]]
    if not len(times):
        return motion._at_saves([before] * len(asked))
    plain = not motion.system.constraints and motion.system.quasi is None
    further = solve(
        motion.system,
        motion.q[before],
        motion.v[before],
        np.concatenate([ts[before : before + 1], times]),
        motion.params,
        inputs=motion.inputs,
        x0=None if motion.x is None else motion.x[before],
        method=motion.method,
        formulation="auto" if plain else motion.formulation,
        rtol=motion.tolerances[0],
        atol=motion.tolerances[1],
        save=tuple(motion.saved),
        stabilization=motion.stabilization,
        change_points=motion.change_points,
        dt_max=motion.dt_max,
        throw=False,
    )
    if "work" in motion.saved:
        done = {name: work[before] for name, work in motion.saved["work"].items()}
        since = jax.tree.map(jnp.add, further.saved["work"], done)
        further = eqx.tree_at(lambda x: x.saved["work"], further, since)
    places = np.searchsorted(time_direction * np.asarray(further.ts), time_direction * asked)
    return further._at_saves(places.tolist())
