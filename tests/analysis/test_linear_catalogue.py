"""Rates of every system of the catalog near a state, against their linearization there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from systems.catalogue import ENTRIES, Entry

PLAIN = ("double_pendulum",)
NAMES = [name for name in ENTRIES if isinstance(ENTRIES[name], Entry)]
KICKS = np.array([4e-3, 2e-3, 1e-3])


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in PLAIN else pytest.mark.full) for n in NAMES]
)
def test_rates_of_small_kicks_are_linear_to_second_order(name):
    """What is left of the rates after kicks of all states falls with the square of the kick."""
    entry = ENTRIES[name]
    system, example, quasi = entry.system, entry.example, entry.system.quasi
    params, t = dict(example.params), jnp.array(0.2)
    start = jl.assemble(system, example.q0, example.v0, params, t=t)
    linear = jl.linearize(system, start.q, start.v, params, t=t)
    n, labels = system.size, system.coordinates.labels
    names = [*labels, *(f"{label}'" for label in labels)]
    if quasi is not None:
        names[n:] = [quasi.names[i] for i in quasi.free]
    places = np.array([names.index(state) for state in linear.states])
    hold = [state for state in linear.states if state.rstrip("'") in labels]
    draw = np.random.default_rng(sum(map(ord, name)))
    direction = draw.uniform(-1.0, 1.0, len(places))

    def rates(kick):
        shift = kick * (linear.basis @ direction)
        q, w = start.q + shift[:n], start.v
        if quasi is None:
            v = w + shift[n:]
        else:
            u = quasi.of(t, start.q, start.v, params).at[quasi.free].add(shift[n:])
            v = quasi.velocities(t, q, u, params)
        at = start
        if system.constraints:
            at = jl.assemble(system, q, v, params, t=t, hold=hold)
            q, v = at.q, at.v
        if quasi is not None:  # at the corrected coordinates
            v = quasi.velocities(t, q, u, params)
        a = system.acceleration(q, v, params, t=t)
        if quasi is not None:
            along = lambda *state: quasi.of(*state, params)  # noqa: E731
            a = jax.jvp(along, (t, q, v), (jnp.ones_like(t), v, a))[1][quasi.free]
        return jnp.concatenate([v, a])[places]

    left = []
    for kick in KICKS:
        expected = linear.f0 + kick * (linear.A @ direction)
        left.append(float(jnp.max(jnp.abs(rates(kick) - expected))))
    size = float(jnp.max(jnp.abs(linear.f0)) + jnp.max(jnp.abs(linear.A)))
    np.testing.assert_allclose(rates(0.0), linear.f0, atol=1e-12 * size)
    if left[-1] > 1e-11 * size:  # else the equations are linear
        order = np.polyfit(np.log(KICKS), np.log(left), 1)[0]
        assert order == pytest.approx(2.0, abs=0.1) or order > 2.0
