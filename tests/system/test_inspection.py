"""Inspection of a declaration: the mass matrix of a learned Lagrangian."""

import jax.numpy as jnp
import pytest

import jaxlag as jl

FORM = r"L = v\^T \(F F\^T \+ eps I\) v / 2 - V"


def network(t, q, v, weights):
    hidden = jnp.tanh(weights["in"] @ jnp.concatenate([q, v]))
    return weights["out"] @ hidden


def structured(t, q, v, weights):
    F = jnp.diag(network(t, q, jnp.zeros_like(v), weights) * jnp.ones(2))
    w = F.T @ v
    return 0.5 * (w @ w + 0.1 * v @ v)


def weights(size):
    """With a mass matrix that is negative at v = 1."""
    return {"in": jnp.ones((size, 4)) / size, "out": jnp.ones(size)}


def test_a_learned_lagrangian_without_inertia_is_told_its_form():
    system = jl.System(network, ("a", "b"))
    with pytest.raises(ValueError, match=f"`?coordinate 'a'`? must have inertia.*{FORM}"):
        system.check([0.1, 0.2], [1.0, 1.0], weights(20))
    motion = jl.simulate(
        system, [0.1, 0.2], [1.0, 1.0], [0.0, 0.1], weights(20), throw=False, method="tsit5"
    )
    assert motion.status == jl.Status.mass_singular
    assert "write L = v^T (F F^T + eps I) v / 2 - V" in motion.message()


def test_that_form_is_accepted_and_few_params_are_no_network():
    jl.System(structured, ("a", "b")).check([0.1, 0.2], [1.0, 1.0], weights(20))
    with pytest.raises(ValueError, match=r"must have inertia.*Add its kinetic energy to L"):
        jl.System(network, ("a", "b")).check([0.1, 0.2], [1.0, 1.0], weights(4))
