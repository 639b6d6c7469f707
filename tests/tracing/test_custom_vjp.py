"""Functions with a rule by `jax.custom_vjp`: all derivatives follow the rule."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl


def plainly(x, k):
    return jnp.stack([jnp.sin(x[0]) * k, x[1] ** 2 * x[0]])


@jax.custom_vjp
def ruled(x, k):
    return plainly(x, k)


def backward(residuals, y):
    x, k = residuals
    first = jnp.cos(x[0]) * k * y[0] + x[1] ** 2 * y[1]
    return jnp.stack([first, 2 * x[0] * x[1] * y[1]]), jnp.sin(x[0]) * y[0]


ruled.defvjp(lambda x, k: (plainly(x, k), (x, k)), backward)


def system(f):
    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - jnp.sum(f(q, params)) - 0.1 * jnp.sum(f(v, params))

    push = jl.GeneralizedForce(lambda t, q, v, params: -f(q * v, params), "push")
    return jl.System(lagrangian, ("x", "y"), forces=(push,))


def everything(function):
    """By all pairs of modes, and through `jax.lax.map`, which splits derivatives."""
    first = jax.jacfwd(function), jax.jacrev(function)
    second = [outer(inner) for inner in first for outer in (jax.jacfwd, jax.jacrev)]
    mapped = jax.jacfwd(jax.jacrev(lambda x: jax.lax.map(function, x[None])))

    def of(x):
        return [function(x), *(way(x) for way in (*first, *second)), mapped(x)]

    return jax.jit(of)


def test_functions_have_derivatives_of_every_mode():
    x = jnp.array([1.0, 0.4, 0.7])

    def of(f):
        force = system(f).forces[0].Q
        return everything(lambda x: force(0.0, x[1:], x[:2], x[0]))(x)

    for found, expected in zip(of(ruled), of(plainly), strict=True):
        # Rounding of a few products of order one.
        np.testing.assert_allclose(found.ravel(), expected.ravel(), rtol=0, atol=1e-14)


def ended(f, method):
    """End of a motion and its forward derivative; implicit steps differentiate the equations."""

    def at(k):
        start = [1.0, 0.0], [0.3, 0.1], jnp.array([0.0, 0.4])
        return jl.simulate(system(f), *start, k, method=method, dt=0.2).q[-1]

    return jax.jit(lambda k: [at(k), jax.jacfwd(at)(k)])(1.0)


@pytest.mark.full
@pytest.mark.parametrize("method", ["bosh3", pytest.param("gauss2", marks=pytest.mark.full)])
def test_motions_have_forward_derivatives(method):
    # Rounding of some hundred operations on numbers of order one.
    np.testing.assert_allclose(ended(ruled, method), ended(plainly, method), rtol=0, atol=1e-12)


def test_derivatives_follow_the_rule_not_the_body():
    """In forward and reverse derivatives; here the rule gives twice the derivative of the body."""

    @jax.custom_vjp
    def double(x):
        return x**2

    double.defvjp(lambda x: (x**2, x), lambda x, y: (4.0 * x * y,))
    push = jl.GeneralizedForce(lambda t, q, v, params: double(q), "push")
    lone = jl.System(lambda t, q, v, params: 0.5 * v @ v, ("x",), forces=(push,))

    def a(q):
        return lone.acceleration(q, jnp.zeros(1))

    q = jnp.array([3.0])
    for way in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(way(a)(q), [[12.0]], rtol=1e-15)
