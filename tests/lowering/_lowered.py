"""The scalar program of a system, without compiling it."""

from dataclasses import replace

import jax.numpy as jnp

from jaxlag._lowering import ScalarProgram


def lowered(system, params=None):
    """With quasi-velocities as the state, if the system has any."""
    program = system._program
    assert isinstance(program, ScalarProgram)
    if system.quasi is not None:
        array = replace(program.array, quasi=system.quasi, in_u=system._in_u)
        program = replace(program, array=array)
    return program.lowered(jnp.zeros(system.size), params, {})
