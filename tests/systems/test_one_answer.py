"""One motion by all formulations: multipliers, null space and quasi-velocities.

Every system of the catalogue with constraints and quasi-velocities, from the start of its example;
deviations are relative to 1 + |value|.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxlag as jl
from systems.catalogue import ENTRIES

TIGHT = {"method": "tsit5", "rtol": 1e-12, "atol": 1e-12}
FEW_STAGES = TIGHT | {"method": "bosh3", "max_steps": 32768}
"""Of low order: less is compiled, especially with derivatives; the steps are many."""

STATE, REACTION, GRADIENT = 1e-10, 1e-9, 1e-8
"""Largest deviation of q, v and u, of lambda, and of derivatives."""

NAMES = [name for name, entry in ENTRIES.items() if entry.quasi_velocities and entry.constraints]
FEW = ["tricycle", "rolling_ball_turntable", "suslov"]


def times(entry):
    return np.linspace(0.0, min(1.0, entry.example.duration), 5)


def simulate(entry, formulation, q0, params, **options):
    options = {"v0": None, "ts": times(entry)} | TIGHT | options
    return jl.simulate(entry.system, q0, params=params, formulation=formulation, **options)


def free_start(entry):
    """(q0, u0 without those that vanish) of the example."""
    q0, v0 = entry.start()
    u0 = entry.system.quasi_velocities(q0, v0, entry.example.params)
    vanish = [entry.quasi_velocities.index(name) for name in entry.constraints]
    return q0, jnp.delete(u0, np.array(vanish, int))


def by_name(entry, u0):
    return dict(zip(entry.free_quasi_velocities, u0, strict=True))


def close(found, expected, tolerance):
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    worst = np.max(np.abs(found - expected) / (1 + np.abs(expected)))
    assert worst <= tolerance, f"{worst:.1e}"


def same_motion(entry, one, other):
    assert one.status == other.status == jl.Status.ok
    for x, y in ((one.q, other.q), (one.v, other.v), (one.u, other.u)):
        close(x, y, STATE)
    for row in entry.constraints:
        close(one.lam[row], other.lam[row], REACTION)


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_quasi_velocities_give_the_motion_of_multipliers(name):
    """From u0 or from v0; multipliers of the omitted rows equal those of the bordered equations."""
    entry = ENTRIES[name]
    params, (q0, v0) = dict(entry.example.params), entry.start()
    by_v = simulate(entry, "multipliers", q0, params, v0=v0)
    by_u = simulate(entry, "auto", q0, params, u0=by_name(entry, free_start(entry)[1]))
    same_motion(entry, by_u, by_v)
    for row in entry.constraints:  # by construction, not by projection
        close(by_u[row], np.zeros(5), 1e-14)


@pytest.mark.full
@pytest.mark.parametrize("name", FEW)
def test_quasi_velocities_give_the_motion_of_the_null_space(name):
    entry = ENTRIES[name]
    params, (q0, v0) = dict(entry.example.params), entry.start()
    by_null_space = simulate(entry, "null_space", q0, params, v0=v0)
    same_motion(entry, simulate(entry, "quasi", q0, params, v0=v0), by_null_space)


@pytest.mark.full
@pytest.mark.parametrize("name", FEW)
def test_explicit_rows_give_the_motion_of_quasi_velocities(name):
    """The same system declared without them, its constraints by `jl.Pfaffian`."""
    entry = ENTRIES[name]
    system, (q0, v0) = entry.system, entry.start()
    indices = np.array([entry.quasi_velocities.index(row) for row in entry.constraints])

    def vanishing(t, q, v, params):
        return system.quasi.U(t, q, v, params)[indices]

    plain = jl.System(
        system.lagrangian,
        system.coordinates.shapes,
        forces=system.forces,
        constraints=(jl.Pfaffian(vanishing, entry.constraints),),
    )
    params = dict(entry.example.params)
    other = jl.simulate(plain, q0, v0, times(entry), params, **TIGHT)
    found = simulate(entry, "quasi", q0, params, v0=v0)
    close(found.q, other.q, STATE)
    close(found.v, other.v, STATE)
    for row in entry.constraints:
        close(found.lam[row], other.lam[row], REACTION)


@pytest.mark.full
@pytest.mark.parametrize("name", [*FEW, "chaplygin_ball", "rolling_disk"])
def test_derivatives_are_equal_in_both_formulations(name):
    """Of an end quantity, by start and parameters, along starts that satisfy the constraints.

    Three systems in reverse mode, every component; two in forward mode, in a random direction.
    """
    entry = ENTRIES[name]
    (q0, u0), system = free_start(entry), entry.system
    n, free = len(entry.coordinates), entry.free_quasi_velocities
    columns = np.array([entry.quasi_velocities.index(name) for name in free])
    weights = np.linspace(1.0, 2.0, 2 * n)

    def end(values, formulation):
        params, q0, u0 = values
        u0 = jnp.zeros(n).at[columns].set(u0)
        start = {"v0": None, "u0": u0}
        if formulation == "multipliers":
            start = {"v0": system.velocities(q0, u0, params)}
        motion = simulate(entry, formulation, q0, params, **start, **FEW_STAGES)
        return jnp.concatenate([motion.q[-1], motion.v[-1]]) @ weights

    params = {key: jnp.asarray(value, float) for key, value in entry.example.params.items()}
    values = params, q0, u0
    flat, unravel = ravel_pytree(values)
    direction = unravel(jnp.asarray(np.random.default_rng(3).normal(size=flat.size)))

    def derivative(form):
        if name in FEW:
            return ravel_pytree(jax.grad(end)(values, form))[0]
        return jax.jvp(lambda values: end(values, form), (values,), (direction,))[1]

    found, expected = derivative("quasi"), derivative("multipliers")
    scale = np.max(np.abs(expected))
    assert scale > 0.1
    close(found, expected, GRADIENT)
