"""Tests repeated under both lowerings use both programs, compiled ones included."""

import jax
import jax.numpy as jnp
import pytest
from _jaxprs import loop, names, operations

import jaxlag as jl
from jaxlag._lowering import ArrayProgram, ScalarProgram
from systems.catalogue import ENTRIES

DOUBLE = ENTRIES["double_pendulum"]
PARAMS = dict(DOUBLE.example.params)


@jax.jit
def acceleration(q, v):
    """Compiled at module level, as other tests may do."""
    return DOUBLE.system.acceleration(q, v, PARAMS)


@pytest.mark.parametrize("call", [1, 2])
def test_accelerations_are_compiled_from_the_lowering_in_use(lowering, call):
    """Read from the cache of jit: a program left over from the other lowering would show."""
    q, v = jnp.array([1.0, 0.5]), jnp.array([0.2, -0.3])
    acceleration(q, v)
    on_arrays = lowering == "array"
    assert ("custom_linear_solve" in names(operations(acceleration, q, v))) == on_arrays
    assert ("tensor<2x2xf64>" in acceleration.lower(q, v).as_text()) == on_arrays  # the whole M


def test_solves_are_compiled_from_the_lowering_in_use(lowering):
    def solve(q0):
        return jl.simulate(DOUBLE.system, q0, [0.0, 0.0], [0.0, 0.1], PARAMS, throw=False).q

    inside = loop(operations(solve, jnp.array([1.0, 0.5]), iterations=1))
    assert ("custom_linear_solve" in names(inside)) == (lowering == "array")


def test_only_systems_at_auto_follow_the_lowering(lowering):
    kinds = {"auto": ArrayProgram if lowering == "array" else ScalarProgram}
    for chosen, kind in (kinds | {"scalar": ScalarProgram, "array": ArrayProgram}).items():
        system = jl.System(DOUBLE.system.lagrangian, ("a", "b"), lowering=chosen)
        assert type(system._program) is kind
