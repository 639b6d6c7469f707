"""A double pendulum on video (Asseman, Kornuta, Ozcan, Learning beyond simulated physics, 2018).

Angles are absolute, 0 hanging, from tracked points of the axis, the joint and the tip. With the
inertia of the first arm 1,

    L = 1/2 w1^2 + 1/2 B w2^2 + C w1 w2 cos(th1 - th2) + P cos th1 + Q cos th2,

with viscous friction at both joints. Time is based on 400 frames per second. This is inconsistent
with the lengths of the arms, so P, Q and friction are in units of that clock.
"""

import gzip
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.fits._data import windows
from bench.fits._report import Part, errors, estimates, missed, timed

RATE = 400.0  # 1/s
WINDOW = 0.3  # s: longer ones are chaotic
TRAIN, TEST = ("2", "13"), ("17",)
OPTIONS = {"simulate_options": {"method": "tsit5", "rtol": 1e-7, "atol": 1e-7}}
START = {"B": 0.1, "C": 0.15, "P": 100.0, "Q": 10.0, "k1": 0.02, "k2": 0.02}
# Centers of the ranges over seven runs, each fitted alone.
OTHERS = {"B": 0.076, "C": 0.1034, "P": 69.2, "Q": 7.06, "k2": 0.008}


def lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """L of the module docstring."""
    T = 0.5 * v[0] ** 2 + 0.5 * p["B"] * v[1] ** 2 + p["C"] * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return T + p["P"] * jnp.cos(q[0]) + p["Q"] * jnp.cos(q[1])


def friction(t: Any, q: Array, v: Array, p: Any) -> Array:
    """R = 1/2 k1 w1^2 + 1/2 k2 (w2 - w1)^2."""
    return 0.5 * p["k1"] * v[0] ** 2 + 0.5 * p["k2"] * (v[1] - v[0]) ** 2


PENDULUM = jl.System(lagrangian, {"theta": (2,)}, forces=(jl.Rayleigh(friction, "friction"),))


def angles(path: Path, run: str) -> jl.Experiment:
    """One whole run; gravity points along the first of each pair of columns."""
    with gzip.open(path / "ibm_double_pendulum" / f"{run}.csv.gz", "rt") as file:
        points = np.loadtxt(file, delimiter=",").reshape(-1, 3, 2)
    along, across = np.moveaxis(np.diff(points, axis=1), 2, 0)
    theta = np.unwrap(np.arctan2(across, along), axis=0)
    return jl.Experiment(np.arange(len(theta)) / RATE, {"theta": theta}, name=f"run {run}")


def measured(path: Path) -> Part:
    """Fit two runs, test on a third."""
    name, model = "double pendulum on video", "viscous"
    train, test = (windows([angles(path, run) for run in runs], WINDOW) for runs in (TRAIN, TEST))

    def fit() -> jl.FitResult:
        transforms = dict.fromkeys(("k1", "k2"), jl.transforms.Bounded(0.0, np.inf))
        return jl.fit(PENDULUM, train, START, free=tuple(START), transforms=transforms, **OPTIONS)

    found, figures = timed(name, model, fit)
    figures += estimates(name, model, found, OTHERS, "seven runs, each alone")
    figures += errors(name, model, "rms of training, 0.3 s", found.rms("theta"))
    figures += errors(name, model, "rms of test, 0.3 s", missed(found.predict(test), "theta"))
    return Part(figures, [], [])
