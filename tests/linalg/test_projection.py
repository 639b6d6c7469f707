"""Projection preserves the order of a solver and satisfies constraints to rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.mechanisms import (
    BOBS,
    OMEGA,
    THETA,
    cartesian,
    double_pendulum,
    minimal,
    to_cartesian,
)

import jaxlag as jl
from jaxlag._linalg import _projection
from jaxlag._linalg._projection import ConstraintProjector, project


@pytest.mark.full
@pytest.mark.parametrize(
    ("method", "order", "steps"),
    [("tsit5", 5, (60, 120)), ("bosh3", 3, (200, 400)), ("heun", 2, (400, 800))],
)
def test_projection_preserves_the_order(method, order, steps):
    """Order from the errors at several saves; the reference is the motion in angles."""
    ts = [0.0, 0.5, 1.0, 1.5, 2.0]
    exact = jl.simulate(minimal, THETA, OMEGA, ts, BOBS, rtol=1e-13, atol=1e-13)
    q_exact, _ = jax.vmap(to_cartesian)(exact.q, exact.v)
    system, q0, v0, params = double_pendulum()

    @jax.jit
    def error(dt):
        found = jl.simulate(system, q0, v0, ts, params, dt=dt, method=method, throw=False)
        return jnp.linalg.norm(found.q - q_exact)

    coarse, fine = (float(error(1.0 / n)) for n in steps)
    np.testing.assert_allclose(np.log2(coarse / fine), order, atol=0.1)


def circle(q):
    """The unit circle near q, with A = 2 q and M = 1."""

    def correct(c):
        return 2 * q * c[0] / (4 * q @ q)

    def position(x):
        return jnp.stack([x @ x - 1.0])

    return ConstraintProjector(position, lambda q, v: jnp.stack([2 * q @ v]), correct, correct)


@pytest.mark.parametrize("off", [1e-12, 1e-6, 1e-3, 0.1])
def test_projection_satisfies_the_constraints(off):
    """From near and far: phi and its rate are rounding; corrections follow the initial normals."""
    q, v = (1 + off) * jnp.array([0.6, 0.8]), jnp.array([0.3, 0.1])
    surface = circle(q)
    on, rate, found = project(surface, q, v)
    assert found
    # From far off, 12 iterations that gain one digit each do not quite reach rounding.
    allowed = 1e-13 if off == 0.1 else 2e-15
    assert abs(on @ on - 1) <= allowed
    assert abs(on @ rate) <= allowed
    np.testing.assert_allclose(on, [0.6, 0.8], atol=allowed)


def test_projection_without_solution_is_not_found():
    """No point satisfies the residual: `found` is False after a bounded number of iterations."""
    q = jnp.array([0.6, 0.8])
    shifted = circle(q)._replace(position=lambda x: jnp.stack([x @ x + 1.0]))
    _, _, found = project(shifted, q, jnp.zeros(2))
    assert not found


@pytest.mark.parametrize("off", [1e-9, 1e-3, 0.03])
def test_derivative_equals_that_of_the_solved_equations(off):
    """For any number of iterations, compared with differences; the next test mutates it."""

    def projected(q, differentiable=True):
        surface = circle(q)
        frozen = circle(jax.lax.stop_gradient(q)) if differentiable else None
        return project(surface, q, jnp.array([0.3, 0.1]), frozen)[1]

    q = (1 + off) * jnp.array([0.6, 0.8])
    d, h = jnp.array([0.7, -0.2]), 1e-6
    slope = (projected(q + h * d, False) - projected(q - h * d, False)) / (2 * h)
    _, forward = jax.jvp(projected, (q,), (d,))
    np.testing.assert_allclose(forward, slope, atol=1e-9 + off**3)
    back = jax.vjp(projected, q)[1](jnp.array([1.0, 2.0]))[0]
    np.testing.assert_allclose(back @ d, jnp.array([1.0, 2.0]) @ forward, rtol=1e-12)


def test_derivative_without_sweeps_is_wrong(monkeypatch):
    """A mutation: mu is constant, as if the path to the surface did not depend on the start."""
    monkeypatch.setattr(_projection, "SWEEPS", 0)
    q = jnp.array([0.66, 0.88])

    def projected(q):
        frozen = circle(jax.lax.stop_gradient(q))
        return project(circle(q), q, jnp.array([0.3, 0.1]), frozen)[0]

    d, h = jnp.array([0.7, -0.2]), 1e-6
    slope = (projected(q + h * d) - projected(q - h * d)) / (2 * h)
    _, forward = jax.jvp(projected, (q,), (d,))
    assert np.abs(forward - slope).max() > 1e-3


@pytest.mark.full
def test_saved_states_are_projected():
    """Also saves inside a step."""
    system, q0, v0, params = double_pendulum()
    ts = jnp.array([0.0, 0.13, 0.37, 0.7])
    found = jl.simulate(system, q0, v0, ts, params, dt=0.1, method="heun")
    residuals = jax.vmap(lambda q, v: cartesian.residuals(q, v, params))(found.q, found.v)
    assert max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(residuals)) <= 1e-14
