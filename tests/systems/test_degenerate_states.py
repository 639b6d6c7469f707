"""Rest, zero and equal coordinates: derivatives are right, or a status names the singularity."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from systems.catalogue import ENTRIES, Entry

HALF = np.pi / 2

# States at which the coordinates of a system are singular: the reason, and the status of a motion
# that starts there. Everywhere else the equations are regular.
SINGULAR = {
    ("central_motion", "r = 0: phi has no inertia"): ([0.0, 0.3], [0.2, 0.1], "mass_singular"),
    ("spherical_pendulum_fixed", "vertical string: theta has no inertia"): (
        [0.3, 0.0],
        [0.1, 0.2],
        "mass_singular",
    ),
    ("spherical_pendulum_elastic", "zero length: both angles have no inertia"): (
        [0.0, 0.4, 0.3],
        [0.1, 0.2, 0.1],
        "mass_singular",
    ),
    ("spherical_pendulum_elastic", "vertical string: theta has no inertia"): (
        [1.0, 0.3, 0.0],
        [0.1, 0.2, 0.1],
        "mass_singular",
    ),
    ("heavy_symmetric_top", "upright: phi and psi turn about one axis"): (
        [0.1, 0.0, 0.3],
        [0.1, 0.2, 0.1],
        "kinematics_singular",
    ),
    ("rigid_aircraft", "pitch of 90 degrees: gimbal lock"): (
        [0.0, 0.0, 0.0, 0.1, HALF, 0.2],
        [1.0, 0.0, 0.0, 0.1, 0.2, 0.3],
        "kinematics_singular",
    ),
    ("quadcopter", "pitch of 90 degrees: gimbal lock"): (
        [0.0, 0.0, 0.0, 0.1, HALF, 0.2],
        [0.0, 0.0, 0.0, 0.1, 0.2, 0.3],
        "mass_singular",
    ),
}
SYSTEMS = [name for name, entry in ENTRIES.items() if isinstance(entry, Entry)]


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "place"),
    [
        pytest.param(*key, marks=pytest.mark.full)
        if key[0] in ("rigid_aircraft", "quadcopter")
        else key
        for key in SINGULAR
    ],
)
def test_a_singular_start_is_named(name, place):
    q0, v0, status = SINGULAR[name, place]
    entry = ENTRIES[name]
    params = entry.example.params
    motion = jl.simulate(entry.system, q0, v0, [0.0, 0.5], params, throw=False)
    assert jl.Status(int(motion.status)).name == status
    assert motion.last_time == 0.0
    assert np.isnan(motion.q[-1]).all()


def singular(name, q):
    """Whether the coordinates are at a state of the table."""
    at_zero = {
        "central_motion": [0],
        "spherical_pendulum_fixed": [1],
        "spherical_pendulum_elastic": [0, 2],
        "heavy_symmetric_top": [1],
    }
    return any(q[i] == 0.0 for i in at_zero.get(name, []))


def states(name):
    """Degenerate (q, v), on the constraints if there are any."""
    q0, v0 = (jnp.asarray(x, float) for x in ENTRIES[name].start())
    zero = jnp.zeros_like(q0)
    found = {"rest": (q0, zero)}
    if not ENTRIES[name].system.constraints:
        found |= {"zero": (zero, zero), "aligned": (zero, v0), "equal": (zero + 0.5, zero)}
    return {place: (q, v) for place, (q, v) in found.items() if not singular(name, q)}


@cache
def derivatives(name):
    """(weighted accelerations, gradient, Hessian) as a function of (q, v), compiled."""
    entry = ENTRIES[name]
    params = {key: jnp.asarray(x, float) for key, x in entry.example.params.items()}
    n = entry.system.size
    weights = jnp.cos(jnp.arange(1.0, 1.0 + n))

    def weighted(y):
        return weights @ entry.system.acceleration(y[:n], y[n:], params, t=0.3)

    @jax.jit
    def all_of(y):
        gradient = jax.grad(weighted)
        return weighted(y), gradient(y), jax.jacfwd(weighted)(y), jax.jacfwd(gradient)(y)

    return all_of


@pytest.mark.full
@pytest.mark.parametrize("name", SYSTEMS)
def test_derivatives_at_degenerate_states_are_right(name):
    """Gradient and Hessian of the accelerations: both modes, and differences."""
    of = derivatives(name)
    for place, (q, v) in states(name).items():
        y = jnp.concatenate([q, v])
        value, gradient, forward, hessian = of(y)
        for x in (value, gradient, hessian):
            assert np.isfinite(x).all(), place
        size = 1.0 + np.abs(gradient).max()
        np.testing.assert_allclose(forward, gradient, rtol=0, atol=1e-11 * size)
        size = 1.0 + np.abs(hessian).max()
        np.testing.assert_allclose(hessian, hessian.T, rtol=0, atol=1e-11 * size)
        d = jnp.sin(jnp.arange(1.0, 1.0 + y.size))

        def difference(h, k, y=y, d=d):
            return (of(y + h * d)[k] - of(y - h * d)[k]) / (2 * h)

        h = 1e-3
        for k, expected in ((0, gradient @ d), (1, hessian @ d)):
            once, twice = difference(h, k), difference(h / 2, k)
            # Error h^2: that of the extrapolation is below its last correction; rounding eps / h.
            allowed = np.abs(twice - once).max() + 1e-9 * (1.0 + np.abs(expected).max())
            np.testing.assert_allclose((4 * twice - once) / 3, expected, rtol=0, atol=allowed)
