"""Fitted friction that adds energy is named."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

TS = np.linspace(0.0, 3.0, 61)
NOISE = 1e-3 * np.random.default_rng(0).normal(size=61)


def fitted(force, growth, c0=0.1):
    """An oscillation that grows as exp(growth t), fitted with a force that depends on c."""
    system = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - 2 * q[0] ** 2, ("x",), forces=(force,))
    x = 0.3 * np.exp(growth * TS) * np.cos(2 * TS) + NOISE
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        found = jl.fit(system, jl.Experiment(TS, {"x": x}), {"c": c0}, free=("c",))
    return found, [str(x.message) for x in warned]


RAYLEIGH = jl.Rayleigh(lambda t, q, v, p: 0.5 * p["c"] * v[0] ** 2, "friction")
DRAG = jl.GeneralizedForce(lambda t, q, v, p: -p["c"] * v, "drag")


@pytest.mark.full
@pytest.mark.parametrize(("force", "c0"), [(RAYLEIGH, -0.01), (DRAG, 0.1), (DRAG, 0.0)])
def test_negative_friction_is_named(force, c0):
    found, texts = fitted(force, 0.05, c0)
    # x'' + c x' + 4 x = 0: the amplitude grows by -c/2.
    assert abs(found.params["c"] + 0.1) < 4 * found.std["c"]
    assert found.feeding == {force.name: ("c",)}
    assert any(f"{force.name!r} adds energy instead of dissipating it" in x for x in texts)
    assert f"adds energy: {force.name}" in str(found)


@pytest.mark.full
def test_positive_friction_and_driving_forces_are_not_named():
    assert fitted(RAYLEIGH, -0.05)[0].feeding == {}
    drive = jl.GeneralizedForce(lambda t, q, v, p: -p["c"] * (q**2 - 0.01) * v, "drive")
    assert fitted(drive, 0.05)[0].feeding == {}


@pytest.mark.full
def test_insignificant_friction_and_powerless_forces_are_not_named():
    """Zero within two standard deviations; normal to the velocity, with a power of rounding."""
    undamped, texts = fitted(DRAG, 0.0)
    assert abs(undamped.params["c"]) < 2 * undamped.std["c"]
    assert undamped.feeding == {}
    assert not any("adds energy" in text for text in texts)
    gyroscopic = jl.GeneralizedForce(
        lambda t, q, v, p: jnp.cross(p["w"] * jnp.array([0.3, -0.7, 1.0]), v), "turn"
    )
    spatial = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - 2 * q @ q, {"x": (3,)}, forces=(gyroscopic,)
    )
    ts = TS[::3]
    motion = jl.simulate(spatial, [0.3, 0.1, 0.0], [0.0, 0.2, 0.5], ts, {"w": 0.4})
    data = jl.Experiment(ts, {"x": np.asarray(motion.q)}, sigma={"x": 1e-3})
    assert jl.fit(spatial, data, {"w": 0.0}, free=("w",)).feeding == {}
