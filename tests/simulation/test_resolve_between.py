"""States between the saves of a motion, as accurate as the saves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl


def spring(t, q, v, params):
    return 0.5 * v[0] ** 2 - 0.5 * params * q[0] ** 2


SYSTEM = jl.System(spring, ("x",))


@pytest.mark.full
@pytest.mark.parametrize("time_direction", [1.0, -1.0])
def test_states_between_saves_are_as_accurate_as_saves(time_direction):
    """cos(2 t), in any order, including saves and repeated times."""
    ts = time_direction * np.array([0.0, 1.0, 4.0])
    motion = jl.simulate(SYSTEM, [1.0], [0.0], ts, 4.0, rtol=1e-10, atol=1e-10, method="tsit5")
    times = time_direction * np.array([3.3, 1.0, 2.5, 3.3, 4.0])
    found = motion.at(times)
    np.testing.assert_array_equal(found.ts, times)
    np.testing.assert_allclose(found["x"], np.cos(2 * times), atol=1e-8)
    np.testing.assert_allclose(found.rate("x"), -2 * np.sin(2 * times), atol=2e-8)
    np.testing.assert_array_equal(motion.at(ts[1])["x"], motion["x"][1:2])


@pytest.mark.full
def test_constrained_motions_stay_on_their_constraints():
    rod = jl.Holonomic(lambda t, q, params: q @ q - 1.0, "rod")
    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v - 9.81 * q[1], ("x", "y"), constraints=(rod,)
    )
    motion = jl.simulate(system, [1.0, 0.0], [0.0, 0.0], [0.0, 1.0], rtol=1e-6, atol=1e-6)
    found = motion.at(0.3)
    np.testing.assert_allclose(jnp.sum(found.q**2), 1.0, atol=1e-14)
    saved = jl.simulate(system, [1.0, 0.0], [0.0, 0.0], [0.0, 0.3, 1.0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.q[0], saved.q[1], atol=1e-5)


def test_saved_quantities_are_available_between_saves():
    """Work counts from the start of the motion: all that of the damper, as the energy shows."""
    damper = jl.Rayleigh(lambda t, q, v, params: 0.05 * v @ v, "damper")
    system = SYSTEM.with_forces(damper)
    motion = jl.simulate(system, [1.0], [0.0], [0.0, 1.0, 4.0], 4.0, save=("work", "energy"))
    found = motion.at([2.5, 1.0, 3.3])
    assert set(found.saved) == {"work", "energy"}
    lost = found.energy - motion.energy[0]
    assert max(lost) < -0.1
    np.testing.assert_allclose(found.work["damper"], lost, atol=1e-8)
    np.testing.assert_array_equal(found.work["damper"][1], motion.work["damper"][1])


def fixed():
    return jl.simulate(SYSTEM, [1.0], [0.0], [0.0, 1.0], 4.0, dt=0.5, method="heun")


def adaptive():
    return jl.simulate(SYSTEM, [1.0], [0.0], [0.0, 1.0], 4.0, method="bosh3", rtol=1e-3)


@pytest.mark.parametrize(
    ("make", "t", "message"),
    [
        (fixed, 0.3, "^`at` of a motion with fixed steps is not supported"),
        (adaptive, 1.5, r"lie within the motion, from 0.0 to 1.0 s, but one was 1.5"),
        (adaptive, [[0.1]], r"be a number or a sequence of numbers, but its shape was \(1, 1\)"),
        (
            lambda: jax.vmap(lambda k: adaptive())(jnp.ones(2)),
            0.3,
            r"^`at` of a batch is not supported: its shape is \(2,\)\. Take one of them",
        ),
    ],
)
def test_unsupported_times_are_refused(make, t, message):
    with pytest.raises(ValueError, match=message):
        make().at(t)
