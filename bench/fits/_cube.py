"""A cube in free flight, tracked by cameras (Pfrommer, Halm, Posa, ContactNets, CoRL 2020).

State: center (m), unit quaternion from the cube to space, velocity (m/s, space), angular velocity
(rad/s, cube). The fit estimates g, in the length unit of the tracking, and the ratios of the
moments of inertia, which are 1 for a cube.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.fits._data import pieces, table
from bench.fits._report import Figure, Part, estimates, timed
from jaxlag import rotation

HALF = 0.0524  # m, half an edge
CLEAR = 8e-3  # m, between the lowest corner and the board
FEWEST = 6  # samples
TRAINING = 90  # tosses
OPTIONS = {"simulate_options": {"method": "tsit5", "rtol": 1e-8, "atol": 1e-8}}
START = {"g": 9.81, "I2": 1.0, "I3": 1.0}
# g from parabolas through the heights; the ratios of a cube.
OTHERS = {"g": 9.61, "I2": 1.0, "I3": 1.0}


def lagrangian(t: Any, q: Array, u: Array, p: Any) -> Array:
    """L = 1/2 v^2 - g z + 1/2 w I w per mass, with I divided by its first moment of inertia."""
    w = u[3:]
    return (
        0.5 * u[:3] @ u[:3]
        - p["g"] * q[2]
        + 0.5 * (w[0] ** 2 + p["I2"] * w[1] ** 2 + p["I3"] * w[2] ** 2)
    )


def rates(t: Any, q: Array, u: Array, p: Any) -> Array:
    """q' from u."""
    return jnp.concatenate([u[:3], rotation.quaternion.from_body_rates(q[3:], u[3:])])


def unit(t: Any, q: Array, p: Any) -> Array:
    """e e - 1."""
    return q[3:] @ q[3:] - 1.0


SPEEDS = ("vx", "vy", "vz", "wx", "wy", "wz")
CUBE = jl.System(
    lagrangian,
    {"center": (3,), "e": (4,)},
    constraints=(jl.Holonomic(unit, "unit"),),
    quasi=jl.QuasiVelocities(kinematics=rates, names=SPEEDS),
    written_in="u",
)


def flight(samples: dict[str, np.ndarray]) -> int:
    """Number of samples of a toss before a corner is close to the board."""
    e = np.stack([samples[x] for x in ("qw", "qx", "qy", "qz")], axis=1)
    w, x, y, z = e.T
    third = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    lowest = samples["z"] - HALF * np.sum(np.abs(third), axis=0)
    return int(np.argmax(np.append(lowest, 0.0) < CLEAR))


def tosses(path: Path) -> list[jl.Experiment]:
    """Flights of all tosses, in the order of their numbers."""
    found = []
    for number, toss in pieces(table(path / "contactnets_cube" / "tosses.csv.gz"), "toss").items():
        n = flight(toss)
        if n < FEWEST:
            continue
        own = {name: x[:n] for name, x in toss.items()}
        e = np.stack([own[x] for x in ("qw", "qx", "qy", "qz")], axis=1)
        # e and -e are the same attitude: choose the signs without jumps.
        e = (
            e
            * np.cumprod(np.append(1.0, np.where(np.sum(e[1:] * e[:-1], axis=1) < 0, -1.0, 1.0)))[
                :, None
            ]
        )
        center = np.stack([own[x] for x in "xyz"], axis=1)
        start = np.array([own[x][0] for x in SPEEDS])
        q0 = np.concatenate([center[0], e[0]])
        found.append(
            jl.Experiment(
                own["t"], {"center": center, "e": e}, q0=q0, v0=start, name=f"toss {number}"
            )
        )
    return found


def measured(path: Path) -> Part:
    """g and the ratios, and the errors of predicted flights."""
    name, model = "cube in flight", "free body"
    all_of_them = tosses(path)
    train, test = all_of_them[:TRAINING], all_of_them[TRAINING:]

    def fit() -> jl.FitResult:
        return jl.fit(CUBE, train, START, free=tuple(START), **OPTIONS)

    found, figures = timed(name, model, fit)
    figures += estimates(name, model, found, OTHERS, "parabolas of z; a cube")
    predicted = found.predict(test)
    for what, residuals in (("training", found), ("test", predicted)):
        center, e = residuals.rms("center"), residuals.rms("e")
        figures.append(
            Figure(name, model, f"rms of {what}, centre", "mm", 1e3 * np.sqrt(center @ center))
        )
        # A small rotation is twice the vector part of its quaternion.
        figures.append(
            Figure(name, model, f"rms of {what}, attitude", "mrad", 2e3 * np.sqrt(e @ e))
        )
    return Part(figures, [], [])
