"""Growth of perturbations under constraints, in every formulation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _growths import TIGHT, product, states
from _systems.mechanisms import (
    NAMES,
    SKATE,
    G,
    bobs,
    cartesian,
    double_pendulum,
    rods,
    skate,
)
from _systems.quasi_systems import sleighs
from _user import unchecked  # noqa: F401

import jaxlag as jl

# ---- Constraints ---------------------------------------------------------------------------------


def pin(t, params):
    return params["X"] * jnp.sin(params["Omega"] * t)


def bob(t, q, v, params):
    return 0.5 * v @ v - G * q[1]


def rod(t, q, params):
    return (q[0] - pin(t, params)) ** 2 + q[1] ** 2 - 1.0


def bob_by_angle(t, q, v, params):
    """The same L at the states that the rod allows."""
    q, v = jnp.split(on_rod(jnp.concatenate([q, v]), t, params), 2)
    return bob(t, q, v, params)


def on_rod(z, t, params):
    """(q, v) of the bob from (theta, omega)."""
    x, rate = jax.jvp(lambda t: pin(t, params), (t,), (jnp.ones_like(t),))
    s, c = jnp.sin(z[0]), jnp.cos(z[0])
    return jnp.stack([x + s, -c, rate + c * z[1], s * z[1]])


held = jl.System(bob, ("x", "y"), constraints=(jl.Holonomic(rod, "rod"),))
angle = jl.System(bob_by_angle, ("theta",))


@pytest.mark.full
@pytest.mark.parametrize("X", [0.0, 0.3])
def test_constrained_growth_is_that_of_the_angle(X):
    """Phi d(q, v)/d(theta, omega) = d(q, v)/d(theta, omega) Phi_angle; a fixed and a moving pin."""
    ts, params, z0 = jnp.linspace(0.0, 10.0, 41), {"X": X, "Omega": 2.0}, jnp.array([0.7, 0.4])
    q, v = jnp.split(on_rod(z0, ts[0], params), 2)
    # Not the default method of all other tests, which takes longer to compile.
    options = TIGHT | {"method": "tsit5"}
    motion = jl.simulate(held, q, v, ts, params, **options)
    reduced = jl.simulate(angle, z0[:1], z0[1:], ts, params, **options)
    growth, expected = jl.lyapunov(motion), jl.lyapunov(reduced)

    z, y = states(reduced), states(motion)
    np.testing.assert_allclose(jax.vmap(lambda *at: on_rod(*at, params))(z, ts), y, atol=1e-9)
    chart = np.asarray(jax.vmap(jax.jacfwd(lambda z, t: on_rod(z, t, params)))(z, ts))
    Phi, of_angle = np.asarray(growth.transition), np.asarray(expected.transition)
    np.testing.assert_allclose(Phi @ chart[:-1], chart[1:] @ of_angle, rtol=0, atol=1e-8)
    # Perturbations off the constraints do not count.
    assert (np.linalg.matrix_rank(Phi, tol=1e-6) == 2).all()
    error = np.hypot(growth.exponent_error, expected.exponent_error)
    assert abs(growth.exponent - expected.exponent) < error

    # Scaled growth of (theta, omega): the largest |after z| / |before z|.
    scaled = chart / (1e-9 * (1 + np.abs(y)))[..., None]
    largest, through = [], []
    for j in range(len(ts)):
        through = [of_angle[j - 1] @ P for P in through] + [np.eye(2)]
        pairs = zip(scaled, through, strict=False)
        roots = [scaled[j] @ P @ np.linalg.inv(np.linalg.qr(s)[1]) for s, P in pairs]
        largest.append(max(np.linalg.norm(x, 2) for x in roots))
    np.testing.assert_allclose(growth.kappa, largest, rtol=1e-7)


@pytest.mark.full
def test_growth_on_a_knife_edge_has_its_closed_form():
    """Pfaffian rows restrict only velocities: closed form in (x, y, theta, speed, turning rate)."""
    ts = np.linspace(0.0, 6.0, 41)
    z0 = jnp.array([0.1, 0.2, 0.3, 0.8, 1.3])

    def flow(z, t):
        x, y, theta, u, w = z
        end = theta + w * t
        x, y = (
            x + u / w * (jnp.sin(end) - jnp.sin(theta)),
            y - u / w * (jnp.cos(end) - jnp.cos(theta)),
        )
        return jnp.stack([x, y, end, u, w])

    def state(z):
        return jnp.stack([*z[:3], z[3] * jnp.cos(z[2]), z[3] * jnp.sin(z[2]), z[4]])

    y0 = state(z0)
    growth = jl.lyapunov(jl.simulate(skate, y0[:3], y0[3:], ts, SKATE, method="tsit5", **TIGHT))
    start, end = jax.jacfwd(state)(z0), jax.jacfwd(lambda z: state(flow(z, 6.0)))(z0)
    np.testing.assert_allclose(product(growth) @ start, end, atol=1e-8)
    assert np.linalg.matrix_rank(growth.transition[0], tol=1e-6) == 5
    assert not growth.exponential


@pytest.mark.full
def test_quasi_velocities_do_not_change_growth():
    """(q, v) and (q, u) describe one motion; the growth is that of (q, v)."""
    ts, q0 = np.linspace(0.0, 6.0, 21), jnp.array([0.1, 0.2, 0.3])
    v0 = jnp.array([0.8 * np.cos(0.3), 0.8 * np.sin(0.3), 1.3])
    _, system = sleighs()
    parts = [
        jl.lyapunov(jl.simulate(system, q0, v0, ts, formulation=name, **TIGHT)).transition
        for name in ("multipliers", "quasi")
    ]
    # Measured 2026-11-22: 3e-14.
    np.testing.assert_allclose(*parts, rtol=0, atol=1e-11)


@pytest.mark.full
def test_dependent_rows_do_not_change_growth():
    def twice(t, q, params):
        rows = rods(t, q, params)
        return jnp.concatenate([rows, 2 * rows[:1]])

    more = jl.System(bobs, NAMES, constraints=(jl.Holonomic(twice, ("a", "b", "c")),))
    _, q0, v0, params = double_pendulum()
    ts = np.linspace(0.0, 1.5, 21)
    parts = [
        jl.lyapunov(jl.simulate(system, q0, v0, ts, params, **TIGHT)).transition
        for system in (cartesian, more)
    ]
    assert (np.linalg.matrix_rank(parts[1], tol=1e-6) == 4).all()
    np.testing.assert_allclose(*parts, rtol=0, atol=1e-10)
