"""Motions compared with closed forms.

Tolerances are relative to 1 + |value|. Local errors of 1e-12 accumulate over some hundred steps.
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy import cos, sin

import jaxlag as jl
from systems.catalogue import ENTRIES

TIGHT = {"rtol": 1e-12, "atol": 1e-12}
CLOSE = 1e-11
"""Largest error measured: 2e-12, of the angular momentum of the free top."""


def move(name, params, q0, u0, times, **options):
    """The motion from coordinates q0 and quasi-velocities u0 without those that vanish."""
    return jl.simulate(
        ENTRIES[name].system,
        q0,
        None,
        ts=np.asarray(times),
        params=params,
        u0=u0,
        **(TIGHT | options),
    )


def close(found, expected, tolerance=CLOSE):
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    worst = np.max(np.abs(found - expected) / (1 + np.abs(expected)))
    assert worst <= tolerance, f"{worst:.1e}"


def exact_motion(name, times, q0, v0, params):
    """(q, v) of the system's closed form at `times`, each (S, n)."""
    q0, v0 = (jnp.asarray(x, float) for x in (q0, v0))
    params = {key: jnp.asarray(value, float) for key, value in params.items()}
    exact = jax.jit(jax.vmap(lambda t: ENTRIES[name].exact(t, q0, v0, params)))
    return tuple(map(np.asarray, exact(jnp.asarray(times))))


def close_to_exact(name, motion, params, tolerance=CLOSE):
    """Compare with the closed form from the same start; returns the closed form."""
    q, v = exact_motion(name, motion.ts, motion.q[0], motion.v[0], params)
    close(motion.q, q, tolerance)
    close(motion.v, v, tolerance)
    return q, v


def space_axes(angles):
    """T_I/B of roll, pitch and yaw."""
    (c_ph, c_th, c_ps), (s_ph, s_th, s_ps) = cos(angles), sin(angles)
    roll = np.array([[1, 0, 0], [0, c_ph, -s_ph], [0, s_ph, c_ph]])
    pitch = np.array([[c_th, 0, s_th], [0, 1, 0], [-s_th, 0, c_th]])
    yaw = np.array([[c_ps, -s_ps, 0], [s_ps, c_ps, 0], [0, 0, 1]])
    return yaw @ pitch @ roll
