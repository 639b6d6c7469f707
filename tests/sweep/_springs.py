"""A sweep of springs, in memory or in a store, and the files of a store."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl

TS = np.linspace(0.0, 1.0, 3)
N = 2500
KEEP = ("x", "energy")


def lagrangian(t, q, v, p):
    return 0.5 * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


SPRING = jl.System(lagrangian, ("x",))


def draw(key, index):
    return jl.Case([1.0], [0.0], {"k": jnp.exp(jax.random.normal(key))})


def swept(store=None, **changed):
    given = {"system": SPRING, "cases": draw, "n": N, "ts": TS, "keep": KEEP, "store": store}
    return jl.sweep(**(given | changed))


def files(folder):
    """Contents of all files."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in Path(folder).rglob("*")
        if path.is_file()
    }
