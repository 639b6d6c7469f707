"""The scalar program of a system, without compiling it."""

from dataclasses import replace

import jax.numpy as jnp

from jaxlag._lowering import ScalarTerms


def lowered(system, params=None):
    """For a state of its quasi-velocities, where it has any."""
    terms = system._terms
    assert isinstance(terms, ScalarTerms)
    if system.quasi is not None:
        array = replace(terms.array, quasi=system.quasi, in_u=system._in_u)
        terms = replace(terms, array=array)
    return terms.lowered(jnp.zeros(system.size), params, {})
