"""At ties of max and min, derivatives are divided as in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxlag as jl
from jaxlag._core._max_min import largest_p, smallest_p

W = jnp.array([1.0, 2.0, 3.0, 5.0])
POINTS = np.array(
    [[1, 1, 1, 1], [1, 1, 0, 1], [0, 1, 1, 2], [-1, 1, -1, 1], [1, 2, 3, 0]], dtype=float
)
REDUCED = {
    "max": lambda q: jnp.max(q) ** 2,
    "min": lambda q: jnp.min(q) ** 2,
    "of three": lambda q: jnp.max(q[:3]) * jnp.min(q[1:]),
    "axis 0": lambda q: jnp.max(jnp.outer(W, q) / W[:, None], axis=0) @ W,
    "axis 1": lambda q: jnp.min(jnp.outer(q, W[1:]) / W[1:], axis=1) @ W,
    "all axes": lambda q: jnp.max(jnp.outer(q, q)),
    "nested": lambda q: jnp.max(jnp.stack([jnp.max(q[:3]), q[3], q[0]])) ** 2,
    "the same twice": lambda q: jnp.max(jnp.stack([q[0], q[0], q[1]]) ** 2),
    "constants": lambda q: jnp.max(jnp.stack([q[0], jnp.ones(()), q[1], jnp.ones(())])) ** 2,
    "initial": lambda q: jnp.max(q, initial=1.0) ** 2,
    "max-norm": lambda q: jnp.linalg.norm(q, jnp.inf) ** 2,
    "pairs": lambda q: jnp.maximum(jnp.maximum(q[0], q[1]), q[2]) ** 2,
    "argmax": lambda q: q[jnp.argmax(q)] ** 2,
    "sort": lambda q: jnp.sort(q) ** 2 @ W,
    "cummax": lambda q: lax.cummax(q) ** 2 @ W,
    "cummin": lambda q: lax.cummin(q, reverse=True) ** 2 @ W,
    "cummax of three": lambda q: lax.cummax(jnp.outer(W, q[:3]), axis=1) @ q[:3] @ W,
    "scatter": lambda q: jnp.sum(q.at[jnp.array([0, 0])].max(q[1:3]) ** 2),
    "segments": lambda q: jnp.sum(jax.ops.segment_min(q**2, jnp.array([0, 0, 0, 1]), 2)),
}


def accelerations(reduced, lowering):
    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - reduced(q)

    system = jl.System(lagrangian, ("a", "b", "c", "d"), lowering=lowering)
    return lambda q: system.acceleration(q, jnp.zeros(4))


PLAIN = {"max", "axis 0", "nested", "the same twice", "constants", "cummin", "scatter"}


@pytest.mark.full
@pytest.mark.parametrize(
    "name",
    [name if name in PLAIN else pytest.param(name, marks=pytest.mark.full) for name in REDUCED],
)
def test_derivatives_at_ties_equal_those_of_jax_to_second_order(name):
    """Forces are derived on the graph, stiffness is derived by JAX from the program."""
    reduced = REDUCED[name]
    force = accelerations(reduced, "auto")
    both = jax.jit(jax.vmap(lambda q: (force(q), jax.jacfwd(force)(q))))
    expected = jax.vmap(lambda q: (-jax.grad(reduced)(q), -jax.hessian(reduced)(q)))(POINTS)
    for found, right in zip(both(POINTS), expected, strict=True):
        np.testing.assert_allclose(found, right, rtol=1e-14, atol=1e-14)


@pytest.mark.full
@pytest.mark.parametrize("name", ["max", "cummax"])
def test_reverse_derivatives_of_both_programs_agree_at_ties(name):
    reduced = REDUCED[name]
    expected = -jax.vmap(jax.hessian(reduced))(POINTS)
    for lowering in ("scalar", "array"):
        found = jax.jit(jax.vmap(jax.jacrev(accelerations(reduced, lowering))))(POINTS)
        np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14)


@pytest.mark.full
@pytest.mark.parametrize(("primitive", "whole"), [(largest_p, jnp.max), (smallest_p, jnp.min)])
def test_primitive_equals_the_reduction(primitive, whole):
    """Under transforms, in a loop whose derivatives JAX splits, and with a partly batched input."""

    def of_vector(q):
        return primitive.bind(*q)

    def in_loop(extreme):
        def total(q):
            return jnp.sum(lax.map(lambda x: extreme(x * q) ** 2, W))

        return jax.vmap(jax.jvp(jax.grad(total), (POINTS[0],), (W,))[1].dot)(jnp.eye(4))

    for derive in (lambda f: f, jax.grad, jax.jacfwd, jax.hessian):
        found, right = (jax.vmap(derive(f))(POINTS) for f in (of_vector, whole))
        np.testing.assert_allclose(found, right, rtol=1e-15)
    np.testing.assert_allclose(in_loop(of_vector), in_loop(whole), rtol=1e-15)
    some = jax.vmap(lambda x: primitive.bind(x, jnp.ones(()), jnp.zeros(())))(W)
    right = jax.vmap(lambda x: whole(jnp.stack([x, jnp.ones(()), jnp.zeros(())])))(W)
    np.testing.assert_array_equal(some, right)
    assert primitive.bind(jnp.ones(()), jnp.zeros(())) == whole(jnp.array([1.0, 0.0]))
