"""Random states of a system on its constraints."""

from functools import partial

import jax
import numpy as np
from _consistent import onto_constraints

STATES = 8


def random_states(entry):
    """(t, q, v, params) around the example: q within 0.4 m or rad, v within 3 per s.

    Under constraints (q, v) are projected onto them.
    """
    rng = np.random.default_rng(sum(map(ord, entry.name)))
    n = len(entry.coordinates)
    moved = jax.jit(partial(onto_constraints, entry.system)) if entry.constraints else None
    for _ in range(STATES):
        params = {
            name: value * rng.uniform(0.7, 1.4) for name, value in entry.example.params.items()
        }
        q = np.asarray(entry.example.q0) + rng.uniform(-0.4, 0.4, n)
        t, v = rng.uniform(0.0, 5.0), rng.uniform(-3.0, 3.0, n)
        if moved is not None:
            q, v = moved(params, t, q, v)
        yield t, np.asarray(q), np.asarray(v), params
