"""Initial guesses of states, by measurements and given starts."""

import jax.numpy as jnp
import numpy as np
import pytest
from _measured import TRUE, TS, angles, experiment, pendulum

import jaxlag as jl
from jaxlag._fit._initial_guess import initial_states, start_freedom, start_size

TURN = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
turned = jl.System(
    lambda t, q, v, p: 0.5 * v @ v - 0.5 * p["k"] * q @ q,
    {"q": (2,)},
    quasi=jl.QuasiVelocities(lambda t, q, v, p: jnp.asarray(TURN) @ v, ("a", "b")),
)
MOVED = np.outer(np.cos(TS), [0.3, 0.1]) + np.outer(np.sin(TS), [0.2, -0.4])


def states(data, indices=(0, 40), system=turned, params=None):
    return initial_states(system, data, list(indices), {"k": 1.0} if params is None else params, {})


def test_guess_has_values_and_slopes_of_measurements():
    """Parabolas of 5 samples: slopes to h^2 times the third derivative, 4e-4."""
    found = states(jl.Experiment(TS, {"q": MOVED}))
    rates = np.outer(-np.sin(TS), [0.3, 0.1]) + np.outer(np.cos(TS), [0.2, -0.4])
    np.testing.assert_allclose(found[:, :2], MOVED[[0, 40]], atol=1e-5)
    np.testing.assert_allclose(found[:, 2:], rates[[0, 40]] @ TURN.T, atol=1e-3)


def test_v0_holds_quasi_velocities():
    """The first state for one vector, all states for one vector per time."""
    found = states(jl.Experiment(TS, {"q": MOVED}, v0=[1.0, 2.0]))
    np.testing.assert_array_equal(found[0, 2:], [1.0, 2.0])
    assert np.all(np.abs(found[1, 2:]) < 0.6)
    series = np.arange(302.0).reshape(151, 2)
    found = states(jl.Experiment(TS, {"q": MOVED}, v0=series))
    np.testing.assert_array_equal(found[:, 2:], series[[0, 40]])


def test_v0_holds_the_velocities_of_kinematics():
    ring = jl.System(
        lambda t, q, v, p: 0.5 * v @ v,
        {"r": (2,)},
        constraints=(jl.Holonomic(lambda t, q, p: q @ q - 1.0, "ring"),),
        quasi=jl.QuasiVelocities(
            kinematics=lambda t, q, u, p: u[0] * jnp.stack([-q[1], q[0]]), names=("w",)
        ),
    )
    r = np.stack([np.cos(2 * TS), np.sin(2 * TS)], axis=1)
    found = states(jl.Experiment(TS, {"r": r}, v0=[1.5]), system=ring)
    np.testing.assert_array_equal(found[0, 2:], [1.5])
    np.testing.assert_allclose(found[1, 2:], [2.0], atol=5e-3)
    assert (start_size(ring), start_freedom(ring, {})) == (3, 1)


def test_columns_have_separate_parabolas():
    q = MOVED.copy()
    q[::2, 0] = q[1::2, 1] = np.nan
    found = states(jl.Experiment(TS, {"q": q}), (0, 1, 150))
    np.testing.assert_allclose(found[:, :2], MOVED[[0, 1, 150]], atol=1e-4)


def test_column_without_measurements_is_simulated():
    q = MOVED.copy()
    q[:, 1] = np.nan
    data = jl.Experiment(TS, {"q": q}, q0=MOVED[0], v0=TURN @ [0.2, -0.4])
    found = states(data, (0, 100))
    np.testing.assert_allclose(found[:, 1], MOVED[[0, 100], 1], atol=1e-5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"q0": [0.3]}, r"`q0` must hold 2 numbers at each time, one for each of the coordinates,"),
        ({"v0": [0.3]}, r"`v0` must hold 2 numbers .* of the quasi-velocities, but its shape was"),
        ({"q0": np.ones((151, 3))}, r"`q0` must hold 2 numbers .* shape was \(151, 3\)"),
    ],
)
def test_starts_of_another_length_are_named(given, message):
    with pytest.raises(ValueError, match=message):
        states(jl.Experiment(TS, {"q": MOVED}, **given))


def test_start_of_a_pendulum_has_two_freedoms():
    assert (start_size(pendulum), start_freedom(pendulum, TRUE)) == (2, 2)
    found = states(experiment(), (0,), pendulum, TRUE)
    np.testing.assert_allclose(found[0, 0], angles()[0], atol=1e-2)
