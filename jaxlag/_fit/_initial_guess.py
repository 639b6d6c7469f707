"""Initial guesses of the states, from the measurements."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlag._core._errors import invalid
from jaxlag._fit._experiment import Experiment
from jaxlag._simulation._simulate import simulate
from jaxlag._system._system import System

FEWEST = 5
"""Least number of samples for a parabola that gives a value and a slope."""
SHARE = 50
"""Number of parts of a recording, one of which a parabola spans."""


def initial_states(
    system: System,
    experiment: Experiment,
    samples: Sequence[int],
    params: Any,
    options: dict[str, Any],
) -> np.ndarray:
    """(q, v), or (q, u) of the free quasi-velocities, at some samples, (r, d).

    Coordinates and rates are taken from q0 and v0 along the recording, or else from measurements,
    rates from slopes. Unmeasured ones follow from a simulation from q0 and v0 with the initial
    params.

    Raises:
        ValueError: q0 or v0 of another length than the system's; an unmeasured coordinate
            without q0 or v0 for a simulation.
    """
    _check(system, experiment)
    q, v = (_along(system, experiment, samples, kind) for kind in ("q0", "v0"))
    if np.isnan(q).any() or np.isnan(v).any():
        motion = _simulated(system, experiment, params, options, q, v)
        q = np.where(np.isnan(q), np.asarray(motion.q)[samples], q)
        v = np.where(np.isnan(v), np.asarray(motion.v)[samples], v)
    if system.quasi is None:
        return np.concatenate([q, v], axis=1)
    given = experiment.v0
    if given is not None and given.ndim == 2:
        u = given[list(samples)]
    else:
        times = jnp.asarray(experiment.ts[list(samples)])
        of = jax.vmap(lambda q, v, t: system.quasi_velocities(q, v, params, t=t))
        u = np.array(of(jnp.asarray(q), jnp.asarray(v), times))
        if given is not None and samples[0] == 0:
            u[0] = given
    return np.concatenate([q, u[:, list(system.quasi.free)]], axis=1)


def start_size(system: System) -> int:
    """Numbers in a state (q, v), or (q, u) of the free quasi-velocities."""
    return system.size + (system.size if system.quasi is None else len(system.quasi.free))


def start_freedom(system: System, params: Any) -> int:
    """Free numbers of a state with constraints, if all their rows are independent."""
    rows = system._rows(params, jnp.dtype(float)).holonomic if system.constraints else ()
    return max(0, start_size(system) - sum(2 if holonomic else 1 for holonomic in rows))


def _check(system: System, experiment: Experiment) -> None:
    """Raise if q0, v0 or start_sigma do not have the length that the system requires."""
    name, n = experiment.name, system.size
    rates = n if system.quasi is None else len(system.quasi.names)
    what = "velocities" if system.quasi is None else "quasi-velocities"
    for kind, given, want, of in (
        ("q0", experiment.q0, n, "coordinates"),
        ("v0", experiment.v0, rates, what),
    ):
        if given is not None and given.shape[-1] != want:
            must = f"hold {want} numbers at each time, one for each of the {of}"
            raise invalid(f"{name}: {kind}", must, f"its shape was {given.shape}")
    sigma, size = experiment.start_sigma, start_size(system)
    if sigma is not None and sigma.ndim and sigma.shape != (size,):
        must = f"be one number or {size}, one for each coordinate and each of the free {what}"
        raise invalid(f"{name}: start_sigma", must, f"its shape was {sigma.shape}")


def _along(system: System, experiment: Experiment, samples: Sequence[int], kind: str) -> np.ndarray:
    """Coordinates ("q0") or velocities ("v0") at the samples; NaN if they are unknown."""
    given = experiment.q0 if kind == "q0" else experiment.v0
    if kind == "v0" and system.quasi is not None:
        given = None  # those are quasi-velocities
    n = system.size
    if given is not None and given.ndim == 2:
        return given[list(samples)]
    found = np.full((len(samples), n), np.nan)
    place = 0
    for name, shape in system.coordinates.shapes.items():
        width = int(np.prod(shape))
        part = slice(place, place + width)
        place += width
        rate = experiment.channels.get(f"{name}'")
        value = experiment.channels.get(name)
        if kind == "v0" and rate is not None:
            found[:, part] = [_parabola(experiment.ts, rate, sample)[0] for sample in samples]
        elif value is not None:
            which = 0 if kind == "q0" else 1
            found[:, part] = [_parabola(experiment.ts, value, sample)[which] for sample in samples]
    if given is not None and samples and samples[0] == 0:
        found[0] = given
    return found


def _parabola(ts: np.ndarray, x: np.ndarray, sample: int) -> tuple[np.ndarray, np.ndarray]:
    """Value and slope at a sample, from parabolas through the nearest measured samples.

    NaN in columns without any.
    """
    found = np.full((2, x.shape[1]), np.nan)
    for column, own in enumerate(x.T):
        known = np.flatnonzero(np.isfinite(own))
        if len(known):
            count = min(len(known), max(FEWEST, len(ts) // SHARE))
            near = known[np.argsort(np.abs(known - sample), kind="stable")[:count]]
            degree = min(2, len(near) - 1)
            coefficients = np.polyfit(ts[near] - ts[sample], own[near], degree)
            found[:, column] = coefficients[-1], coefficients[-2] if degree else 0.0
    return found[0], found[1]


def _simulated(
    system: System,
    experiment: Experiment,
    params: Any,
    options: dict[str, Any],
    q: np.ndarray,
    v: np.ndarray,
) -> Any:
    labels = np.array(system.coordinates.labels)
    given = experiment.v0
    q0 = experiment.q0 if experiment.q0 is not None else q[0]
    v0 = given if given is not None else v[0]
    q0, v0 = (x if x.ndim == 1 else x[0] for x in (q0, v0))
    missing = np.isnan(q0)
    if missing.any():
        fix = f"Pass q0= and v0= to {experiment.name}: the search starts from these."
        must = "be among the channels or in q0"
        raise invalid("coordinates", must, f"{labels[missing].tolist()} were not", fix)
    start: dict[str, Any] = {"v0": v0}
    if system.quasi is not None and given is not None:
        start = {"v0": None, "u0": v0}
    elif np.isnan(v0).any():
        fix = f"Pass v0= to {experiment.name}."
        raise invalid("velocities", "follow from the channels or v0", "some did not", fix)
    ts, inputs = experiment.ts, experiment.inputs_at(params)
    return simulate(
        system, q0, ts=ts, params=params, inputs=inputs, throw=False, **start, **options
    )


def typical(states: np.ndarray) -> np.ndarray:
    """Range of the states, (d,): their standard deviations, or 1 if these are zero."""
    found = np.where(np.isfinite(states), states, 0.0).std(axis=0)
    return np.where(found > 1e-6 * np.max(np.abs(states), axis=0, initial=0.0), found, 1.0)
