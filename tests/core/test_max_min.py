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


@pytest.mark.full
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


@pytest.mark.full
@pytest.mark.parametrize("lanes", [2, 3])
@pytest.mark.parametrize("axes", [(None, 0), (0, 0), (0, None), (1, 0)])
@pytest.mark.parametrize("of", [jnp.maximum, jnp.minimum])
def test_lanes_of_a_scalar_are_no_components(of, axes, lanes):
    """JAX takes a scalar beside an array. Its lanes are as many as components, or not."""

    def function(x, p):
        return of(x, p) * p

    program = jax.make_jaxpr(function)(jnp.zeros(3), 0.0)
    assert {x.aval.shape for eqn in program.eqns for x in eqn.invars} == {(3,), ()}

    def other(x, p):
        return jaxpr_as_fun(with_sound_extremes(program))(x, p)[0]

    rng = np.random.default_rng(2)
    x = rng.normal(size=(lanes, 3) if axes[0] == 0 else (3, lanes) if axes[0] else 3)
    given = jnp.asarray(x), jnp.asarray(rng.normal(size=() if axes[1] is None else lanes))
    for f in (lambda f: f, lambda f: jax.jacrev(f, (0, 1)), lambda f: jax.jacfwd(f, (0, 1))):
        found, expected = (jax.vmap(f(g), axes)(*given) for g in (other, function))
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("of", [lambda x: jnp.maximum(x, 0.5), lambda x: jnp.minimum(0.5, x)])
def test_lanes_beside_a_number(of, dtype):
    """An interpreted program passes numbers that are no arrays."""
    x = jnp.linspace(0.0, 1.0, 3).astype(dtype)
    program = with_sound_extremes(jax.make_jaxpr(of)(x[0]))
    np.testing.assert_allclose(jax.vmap(jaxpr_as_fun(program))(x)[0], of(x), rtol=0.0)


@pytest.mark.parametrize("lowering", ["scalar", "array"])
def test_batches_of_a_param_beside_the_coordinates(lowering):
    force = jl.GeneralizedForce(lambda t, q, v, p: -jnp.maximum(q, p), "push")
    free = lambda t, q, v, p: 0.5 * v @ v  # noqa: E731
    system = jl.System(free, ("x", "y", "z"), forces=[force], lowering=lowering)
    q, ps = jnp.array([0.1, 0.5, -0.3]), jnp.array([0.0, 0.2, 0.7])
    a = lambda p: system.acceleration(q, jnp.zeros(3), p)  # noqa: E731
    np.testing.assert_allclose(jax.vmap(a)(ps), -jnp.maximum(q, ps[:, None]))


def test_integers_are_unchanged():
    program = jax.make_jaxpr(lambda x: jnp.maximum(x, 2))(jnp.arange(3))
    assert with_sound_extremes(program) is program
