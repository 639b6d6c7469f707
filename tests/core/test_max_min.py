"""Derivatives of maximum and minimum where XLA computes an operand twice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import jaxpr_as_fun

import jaxlag as jl
from jaxlag._core._max_min import with_sound_extremes


def larger(x):
    """The hypotenuse is the larger side times the root of 1 + ratio^2: one division less."""
    return jnp.hypot(x, 1.0 + x**2)


def smaller(x):
    return jnp.minimum(1.0 + x**2, 3.0 + x) * x


@pytest.mark.parametrize("lowering", ["scalar", "array"])
@pytest.mark.parametrize("of", [larger, smaller])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev, "jvp"])
def test_operand_that_is_computed_again_has_its_derivative(of, mode, lowering):
    """XLA rounds it differently in two places. No operand is then equal to the maximum."""

    def push(t, q, v, p):
        x = q / 0.741
        return 0.3705 * of(x) + (1.6 + 0.4 * jnp.sin(jnp.sqrt(p**2 + x**2 + 1.0))) * v

    force = jl.GeneralizedForce(push, "push")
    free = lambda t, q, v, p: 0.5 * v @ v  # noqa: E731
    system = jl.System(free, ("x",), forces=[force], lowering=lowering)

    def a(x):
        return system.acceleration(x[None], jnp.array([-0.9]), 90.6)[0]

    along = (
        (lambda a: lambda x: jax.jvp(a, (x,), (jnp.ones_like(x),))[1]) if mode == "jvp" else mode
    )
    slope, h = jax.jit(along(a)), 1e-6
    for x in jnp.linspace(0.3, 1.5, 41):
        expected = (a(x + h) - a(x - h)) / (2.0 * h)
        np.testing.assert_allclose(slope(x), expected, rtol=1e-8)


def sound(function):
    """The function by its program, with the other primitives."""
    program = jax.make_jaxpr(function)(jnp.zeros(3))
    return lambda x: jaxpr_as_fun(with_sound_extremes(program))(x)[0]


@pytest.mark.parametrize("of", [jnp.maximum, jnp.minimum])
def test_values_derivatives_and_ties_are_those_of_jax(of):
    """In every mode, to second order, under vmap; NaN in a branch not taken has derivative zero."""

    def function(x):
        y = jnp.array([0.5, 2.0, jnp.nan])
        return jnp.sum(jnp.where(jnp.isnan(y), x**3, of(x**2, y * x)))

    for x in (jnp.array([0.5, 1.3, 0.7]), jnp.array([0.2, 2.5, -1.0])):  # the first: a tie
        for f in (lambda f: f, jax.grad, jax.jacfwd, jax.hessian):
            np.testing.assert_allclose(f(sound(function))(x), f(function)(x), rtol=1e-14)
        xs = x + jnp.arange(4.0)[:, None]
        each = jax.vmap(jax.grad(sound(function)))(xs)
        np.testing.assert_allclose(each, jax.vmap(jax.grad(function))(xs), rtol=1e-14)


def test_operands_with_axes_of_size_one_are_broadcast():
    """As `lax.max` takes them: `jax.random.uniform` uses this."""

    def function(x):
        return jnp.sum(lax.max(x[:1], x[1:]) ** 2)

    x = jnp.array([0.4, 0.7, 0.1])
    for f in (lambda f: f, jax.grad, jax.jacfwd):
        np.testing.assert_allclose(f(sound(function))(x), f(function)(x), rtol=1e-14)
    each = jax.vmap(sound(function))(x + jnp.arange(2.0)[:, None])
    np.testing.assert_allclose(each, jax.vmap(function)(x + jnp.arange(2.0)[:, None]), rtol=1e-14)


def test_integers_are_unchanged():
    program = jax.make_jaxpr(lambda x: jnp.maximum(x, 2))(jnp.arange(3))
    assert with_sound_extremes(program) is program
