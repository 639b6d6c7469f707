"""A function and its derivatives to third order, by all mixes of modes, and comparisons."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxlag import math

EPS = np.finfo(float).eps


# Sequences of forward and reverse mode: all up to second order, three of third order.
F, R = jax.jacfwd, jax.jacrev
MIXES = ((),), ((F,), (R,)), ((F, F), (F, R), (R, R), (R, F)), ((F, F, F), (R, R, R), (R, F, R))
ONE_EACH = tuple(order[-1:] for order in MIXES)


@cache
def ladder(function, mixes=MIXES):
    """x -> [value, 1st, ...]: arrays with the mixes of one order along their first axis."""

    def derivative(modes):
        out = function
        for mode in modes:
            out = mode(out)
        return out

    orders = [[derivative(modes) for modes in order] for order in mixes]
    out = jax.jit(lambda x: [jnp.stack([f(x) for f in order]) for order in orders])
    return lambda x: out(jnp.asarray(x, None if isinstance(x, np.ndarray | jax.Array) else float))


def each(function, points):
    """The ladder at every point: the mixes of one order along the first axis, then the points."""
    results = [ladder(function)(point) for point in np.asarray(points)]
    return [np.stack(order, axis=1) for order in zip(*results, strict=True)]


def of_pair(name):
    """A function of two arguments as a function of their pair."""
    return PAIRS.setdefault(name, lambda x: getattr(math, name)(x[0], x[1]))


PAIRS = {}


def close(actual, expected, eps, scale=0.0):
    """All mixes within eps EPS of the expected value, or of a scale where that is larger."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    bound = eps * np.finfo(actual.dtype).eps * np.maximum(np.abs(expected), scale)
    assert np.all(np.isfinite(actual))
    assert np.all(np.abs(actual - expected) <= bound), (np.abs(actual - expected) / bound).max()
