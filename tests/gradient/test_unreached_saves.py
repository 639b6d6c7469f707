"""Derivatives of saves that a motion does not reach are NaN; a loss may mask them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._gradient._unreached_saves import unreached

# V = p/x: repulsion for p > 0; for p < 0 attraction into the center, where motions fail.
central = jl.System(lambda t, q, v, p: 0.5 * v @ v - p / q[0], ("x",))
TS = jnp.array([0.0, 0.1, 2.0])
P = 3.0


def saves(p):
    motion = jl.simulate(central, [1.0], [0.0], TS, p, method="tsit5", throw=False)
    return motion.q[:, 0], motion.ok


def last(p):
    return saves(p)[0][-1]


def energy(p):
    return jl.simulate(central, [1.0], [0.0], TS, p, method="tsit5", throw=False).energy[-1]


def masked(p):
    """Of one motion that reaches the end, and one that does not."""
    found, ok = jax.vmap(saves)(jnp.stack([p, -p]))
    return jnp.sum(jnp.where(ok, found[:, -1], 0.0))


@pytest.fixture(scope="module")
def found():
    def everything(p):
        return {
            "reached": [d(lambda p: saves(p)[0][1])(-p) for d in (jax.grad, jax.jacfwd)],
            "masked": [d(masked)(p) for d in (jax.grad, jax.jacfwd)],
            "alone": jax.jacfwd(last)(p),
        }

    return jax.tree.map(np.asarray, jax.jit(everything)(P))


@pytest.mark.full
def test_saves_that_are_not_reached_have_nan_derivatives():
    def everything(p):
        return {
            "lost": [d(last)(-p) for d in (jax.grad, jax.jacfwd, jax.hessian)],
            "second, forwards": jax.jacfwd(jax.jacfwd(last))(-p),
            "energy": [d(energy)(-p) for d in (jax.grad, jax.jacfwd)],
            "all": jax.grad(lambda p: jnp.sum(jax.vmap(last)(jnp.stack([p, -p]))))(p),
        }

    found = jax.tree.map(np.asarray, jax.jit(everything)(P))
    assert np.all(np.isnan(found["lost"])), found["lost"]
    assert np.isnan(found["second, forwards"])
    assert np.isnan(found["all"])
    assert np.all(np.isnan(found["energy"]))


def test_saves_before_the_failure_have_derivatives(found):
    """x'' = p/x^2, so that dx(t)/dp = t^2/2 to first order in t^2."""
    np.testing.assert_allclose(found["reached"], 0.1**2 / 2, rtol=0.05)
    np.testing.assert_allclose(*found["reached"], rtol=1e-12)


def test_loss_may_mask_failed_motions(found):
    np.testing.assert_allclose(found["masked"], found["alone"], rtol=1e-12)


def test_reverse_mode_loses_only_the_requested_saves():
    reached, given = jnp.array([True, False]), jnp.array([1.0, 2.0])
    change, dots = jnp.ones(2), jnp.ones((2, 3))

    def tangent(change, dots):
        return unreached(reached, given, change, dots)

    np.testing.assert_array_equal(tangent(change, dots), [[1.0] * 3, [np.nan] * 3])
    back = jax.vjp(tangent, change, dots)[1]
    for save, lost in ((0, 0.0), (1, np.nan)):
        by_change, by_dots = back(jnp.zeros((2, 3)).at[save].set(1.0))
        np.testing.assert_array_equal(by_change, [lost, lost])
        np.testing.assert_array_equal(by_dots, [[1.0 - save] * 3, [0.0] * 3])
