"""The scalar program of a system, without compiling it."""

import jax.numpy as jnp

from jaxlag._lowering import ScalarTerms


def lowered(system, params=None):
    terms = system.terms
    assert isinstance(terms, ScalarTerms)
    return terms.lowered(jnp.zeros(system.size), params, {})
