"""Check of dissipative forces: whether they supply energy at the estimated params."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag._fit._experiment import Experiment
from jaxlag._fit._initial_guess import initial_states
from jaxlag._model._forces import AbstractForce, Rayleigh, reads_lam
from jaxlag._model._inputs import evaluate
from jaxlag._simulation._jump_times import names_of
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._compiled import Compiled
from jaxlag._tracing._dependence import outputs_depend_on

STATES = 32
"""States of each experiment at which powers are computed."""
NEGLIGIBLE = 1e-9
"""Smallest significant power, over |v| |Q|."""
DEVIATIONS = 2.0
"""Standard deviations of a power within which it is not significant."""


def feeding(
    system: System,
    experiments: Iterable[Experiment],
    before: Any,
    params: Any,
    moved: Sequence[Any],
    options: Mapping[str, Any],
) -> dict[str, frozenset[str]]:
    """Dissipative forces that supply energy somewhere along the measurements.

    By name, with the paths of the params that each reads.

    Dissipative are `Rayleigh` forces, and others that supply no energy at these states with the
    initial params and are zero at zero velocity.

    Args:
        system: the mechanical system.
        experiments: the measurements.
        before: initial params, for which the forces are as intended.
        params: estimated params.
        moved: the same, with one of the estimates each changed by its standard deviation.
        options: options of `simulate`.
    """
    found: dict[str, frozenset[str]] = {}
    for each in experiments:
        states = _states(system, each, params, options)
        for force in system.forces:
            if reads_lam(force):
                continue

            def powers(
                given: Any, force: Any = force, each: Any = each, states: Any = states
            ) -> _Powers:
                found = _POWERS((force,), given, each.inputs_at(given), *states)
                return _Powers(*(np.where(np.isfinite(x), x, 0.0) for x in map(np.asarray, found)))

            then, now = powers(before), powers(params)
            meant = isinstance(force, Rayleigh) or not (_gives(then) or np.any(now.resting))
            if meant and _gives(now):
                k = int(np.argmax(now.power))
                spread = np.linalg.norm([powers(x).power[k] - now.power[k] for x in moved])
                if now.power[k] > DEVIATIONS * spread:
                    found[force.name] = _read(force, each.inputs_at(params), states, params)
    return found


class _Powers(NamedTuple):
    """v . Q, |v| . |Q|, and Q at zero velocities, at some states."""

    power: np.ndarray
    size: np.ndarray
    resting: np.ndarray


def _gives(powers: _Powers) -> bool:
    return bool(np.any(powers.power > NEGLIGIBLE * np.max(powers.size, initial=0.0)))


class _States(NamedTuple):
    t: Array
    q: Array
    v: Array


def _states(
    system: System, experiment: Experiment, params: Any, options: Mapping[str, Any]
) -> _States:
    """Approximate states of the system along an experiment."""
    rows = np.unique(np.linspace(0, len(experiment.ts) - 1, STATES).astype(int)).tolist()
    state = jnp.asarray(initial_states(system, experiment, rows, params, dict(options)))
    t, n = jnp.asarray(experiment.ts[rows]), system.size
    q, w = state[:, :n], state[:, n:]
    if system.quasi is None:
        return _States(t, q, w)
    u = jnp.zeros((len(t), system.quasi.size)).at[:, np.asarray(system.quasi.free)].set(w)
    return _States(t, q, jax.vmap(lambda t, q, u: system.velocities(q, u, params, t=t))(t, q, u))


def _powers(
    force: AbstractForce, params: Any, inputs: Mapping[str, Any], t: Array, q: Array, v: Array
) -> tuple[Array, Array, Array]:
    def of(t: Array, q: Array, v: Array) -> tuple[Array, Array, Array]:
        moving, resting = (
            force(t, q, x, params, evaluate(inputs, t, q, x, params))
            for x in (v, jnp.zeros_like(v))
        )
        return v @ moving, jnp.abs(v) @ jnp.abs(moving), resting

    return jax.vmap(of)(t, q, v)


_POWERS = Compiled(_powers)


def _read(
    force: AbstractForce, inputs: Mapping[str, Any], states: _States, params: Any
) -> frozenset[str]:
    """Leaves of the params on which the force depends."""
    traced, static = _params.halves(params)

    def of(traced: Any) -> Array:
        params, (t, q, v) = _params.join(traced, static), (x[0] for x in states)
        return force(t, q, v, params, evaluate(inputs, t, q, v, params))

    names = [frozenset({name}) for name in names_of(traced)]
    program = jax.make_jaxpr(of)(traced)
    return frozenset().union(*outputs_depend_on(program.jaxpr, names))
