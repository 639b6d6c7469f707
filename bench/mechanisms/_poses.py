"""Bodies by poses: what is seen of them, how they start, their weights."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bench.mechanisms import _bodies
from bench.mechanisms._bodies import Placed
from jaxlag import rotation as turn

G = 9.81
Pose = Callable[[Any, Array, Any], tuple[Array, Array]]


def vector(*parts: Any) -> Array:
    """Numbers as one array."""
    return jnp.stack([jnp.asarray(x, dtype=float) for x in parts])


def shown(poses: Sequence[Pose], params: Any) -> Callable[[Any], np.ndarray]:
    """Centers and rotations of all bodies, of q."""

    def read(q: Any) -> np.ndarray:
        placed = [pose(0.0, jnp.asarray(q), params) for pose in poses]
        return np.concatenate([np.concatenate([r, np.ravel(R)]) for R, r in placed])

    return read


def numbers(bodies: Sequence[Placed]) -> np.ndarray:
    return np.concatenate([np.concatenate([x.r, x.R.ravel()]) for x in bodies])


def started(poses: Sequence[Pose], q0: np.ndarray, v0: np.ndarray, params: Any) -> list[Placed]:
    """The bodies at the start."""
    found = []
    for pose in poses:
        (R, r), (R_rate, v) = jax.jvp(
            lambda q, pose=pose: pose(0.0, q, params), (jnp.asarray(q0),), (jnp.asarray(v0),)
        )
        w = turn.space_rates(R, R_rate)
        found.append(Placed(*(np.asarray(x, float) for x in (r, R, v, w))))
    return found


def falling(masses: Sequence[float], weight: np.ndarray) -> _bodies.Loads:
    """Weights as loads."""
    forces = np.asarray(masses)[:, None] * weight
    return lambda now: (forces, np.zeros_like(forces))
