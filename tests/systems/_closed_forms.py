"""Motions against closed forms.

Tolerances are relative to 1 + |value|. Local errors of 1e-12 add up over some hundred steps.
"""

from itertools import pairwise

import numpy as np
from numpy import cos, sin

import jaxlag as jl
from systems.catalogue import ENTRIES

TIGHT = {"rtol": 1e-12, "atol": 1e-12}
CLOSE = 1e-11
"""Worst measured: 2e-12, of the angular momentum of the free top."""


def move(name, params, q0, u0, times, **options):
    """The motion from coordinates q0 and quasi-velocities u0, those that vanish left out."""
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


def integral(function, times, pieces=8):
    """Integrals of function(t) from times[0] to each of times, by Gauss-Legendre of 20 points."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    parts = [0.0]
    for start, end in pairwise(times):
        edges = np.linspace(start, end, pieces + 1)
        half = np.diff(edges)[:, None] / 2
        parts.append(np.sum(half * weights * function(edges[:-1, None] + half * (1 + nodes))))
    return np.cumsum(parts)


def space_axes(angles):
    """T_I/B of roll, pitch and yaw."""
    (c_ph, c_th, c_ps), (s_ph, s_th, s_ps) = cos(angles), sin(angles)
    roll = np.array([[1, 0, 0], [0, c_ph, -s_ph], [0, s_ph, c_ph]])
    pitch = np.array([[c_th, 0, s_th], [0, 1, 0], [-s_th, 0, c_th]])
    yaw = np.array([[c_ps, -s_ps, 0], [s_ps, c_ps, 0], [0, 0, 1]])
    return yaw @ pitch @ roll
