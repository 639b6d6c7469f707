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


def rows(p):
    motion = jl.simulate(central, [1.0], [0.0], TS, p, method="tsit5", throw=False)
    return motion.q[:, 0], motion.ok


def last(p):
    return rows(p)[0][-1]


def energy(p):
    return jl.simulate(central, [1.0], [0.0], TS, p, method="tsit5", throw=False).energy[-1]


def masked(p):
    """Of one motion that reaches the end, and one that does not."""
    found, ok = jax.vmap(rows)(jnp.stack([p, -p]))
    return jnp.sum(jnp.where(ok, found[:, -1], 0.0))


@pytest.fixture(scope="module")
def found():
    def everything(p):
        return {
            "lost": [d(last)(-p) for d in (jax.grad, jax.jacfwd, jax.hessian)],
            "second, forwards": jax.jacfwd(jax.jacfwd(last))(-p),
            "kept": [d(lambda p: rows(p)[0][1])(-p) for d in (jax.grad, jax.jacfwd)],
            "energy": [d(energy)(-p) for d in (jax.grad, jax.jacfwd)],
            "masked": [d(masked)(p) for d in (jax.grad, jax.jacfwd)],
            "alone": jax.jacfwd(last)(p),
            "all": jax.grad(lambda p: jnp.sum(jax.vmap(last)(jnp.stack([p, -p]))))(p),
        }

    return jax.tree.map(np.asarray, jax.jit(everything)(P))


def test_what_is_not_reached_has_no_derivative(found):
    assert np.all(np.isnan(found["lost"])), found["lost"]
    assert np.isnan(found["second, forwards"])
    assert np.isnan(found["all"])
    assert np.all(np.isnan(found["energy"]))


def test_rows_before_the_failure_have_theirs(found):
    """x'' = p/x^2, so that dx(t)/dp = t^2/2 to first order in t^2."""
    np.testing.assert_allclose(found["kept"], 0.1**2 / 2, rtol=0.05)
    np.testing.assert_allclose(*found["kept"], rtol=1e-12)


def test_a_loss_may_leave_failed_motions_out(found):
    np.testing.assert_allclose(found["masked"], found["alone"], rtol=1e-12)


def test_backwards_only_what_is_asked_for_is_lost():
    reached, given = jnp.array([True, False]), jnp.array([1.0, 2.0])
    change, dots = jnp.ones(2), jnp.ones((2, 3))

    def along(change, dots):
        return unreached(reached, given, change, dots)

    np.testing.assert_array_equal(along(change, dots), [[1.0] * 3, [np.nan] * 3])
    back = jax.vjp(along, change, dots)[1]
    for row, lost in ((0, 0.0), (1, np.nan)):
        by_change, by_dots = back(jnp.zeros((2, 3)).at[row].set(1.0))
        np.testing.assert_array_equal(by_change, [lost, lost])
        np.testing.assert_array_equal(by_dots, [[1.0 - row] * 3, [0.0] * 3])
