"""Helpers for tests of structure-preserving methods."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl

EPS = np.finfo(float).eps


def end(system, q0, v0, ts, params, **options):
    """(q, v) at the last time, as one vector."""
    motion = jl.simulate(system, q0, v0, ts, params, **options)
    return jnp.concatenate([motion.q[-1], motion.v[-1]])


def slopes(system, q0, v0, span, params, method, steps, inputs=None):
    """Orders between consecutive numbers of steps."""
    exact = end(system, q0, v0, span, params, inputs=inputs, rtol=1e-13, atol=1e-14)

    def error(count):
        dt = (span[1] - span[0]) / count
        y = end(system, q0, v0, span, params, inputs=inputs, method=method, dt=abs(dt))
        return np.max(np.abs(y - exact))

    errors = [error(count) for count in steps]
    return [
        np.log(a / b) / np.log(n / m)
        for (m, a), (n, b) in pairwise(zip(steps, errors, strict=True))
    ]


def symplectic_defect(system, q0, v0, params, method, dt, count):
    """max |S^T J S - J| of the map of (q, p) over `count` steps, and its scale |S|^2."""
    n = len(q0)
    q0, v0 = jnp.asarray(q0), jnp.asarray(v0)

    def flow(y):
        return end(system, y[:n], y[n:], [0.0, count * dt], params, method=method, dt=dt)

    def momenta(y):
        t = jnp.array(0.0)
        return jnp.concatenate([y[:n], system._terms.momentum(t, y[:n], y[n:], params)])

    y0 = jnp.concatenate([q0, v0])
    y1, slope = flow(y0), jax.jacfwd(flow)(y0)
    S = jax.jacfwd(momenta)(y1) @ slope @ jnp.linalg.inv(jax.jacfwd(momenta)(y0))
    unit = np.eye(n)
    J = np.block([[0 * unit, unit], [-unit, 0 * unit]])
    return np.max(np.abs(S.T @ J @ S - J)), np.max(np.abs(S)) ** 2
