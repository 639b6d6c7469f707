"""Samples of rotations in all parametrizations, and comparisons of results."""

import itertools

import jax
import numpy as np
import pytest

from jaxlag import rotation
from jaxlag.rotation import quaternion, yaw_pitch_roll, zxz

EPS = np.finfo(float).eps
ALL = {"yaw_pitch_roll": yaw_pitch_roll, "zxz": zxz, "quaternion": quaternion}
ANGLES = {name: ALL[name] for name in ("yaw_pitch_roll", "zxz")}
LOCK = {"yaw_pitch_roll": np.cos, "zxz": np.sin}  # |det W|
COUNT = 500

every = pytest.mark.parametrize("kind", ALL)
every_angles = pytest.mark.parametrize("kind", ANGLES)


def anywhere(kind, rng, count=COUNT):
    """Coordinates of any size: angles of several revolutions, quaternions of norms 0.1 to 10."""
    if kind != "quaternion":
        return rng.uniform(-10.0, 10.0, (count, 3))
    x = rng.normal(size=(count, 4))
    return x / np.linalg.norm(x, axis=1)[:, None] * 10 ** rng.uniform(-1.0, 1.0, (count, 1))


def principal(kind, rng, count=COUNT):
    """Coordinates in their principal ranges, 0.2 rad or more from gimbal lock."""
    if kind == "quaternion":
        x = rng.normal(size=(count, 4))
        x /= np.linalg.norm(x, axis=1)[:, None]
        return x * np.where(x[:, :1] < 0, -1, 1)
    x = rng.uniform(-np.pi, np.pi, (count, 3))
    low, high = (0.2, np.pi - 0.2) if kind == "zxz" else (0.2 - np.pi / 2, np.pi / 2 - 0.2)
    x[:, 1] = rng.uniform(low, high, count)
    return x


def batch(function, *arguments):
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(function))(*arguments))


def worst(found, expected):
    return float(np.max(np.abs(np.asarray(found) - np.asarray(expected))))


def crosses(a):
    return batch(rotation.skew, a)


def cube():
    """The 24 proper rotations that map axes to axes; half and quarter turns among them."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.eye(3)[list(order)] * np.array(signs)
            if np.linalg.det(R) > 0:
                yield R
