"""Systems for the benchmark of the lowering: each is a Lagrangian as a user would write it.

Angles in rad, lengths in m, masses in kg; params are dicts of numbers or vectors.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxlag import rotation

G = 9.81


class Scene(NamedTuple):
    """A Lagrangian with n coordinates and its parameters; it is evaluated near (q0, v0)."""

    lagrangian: Callable
    q0: tuple[float, ...]
    v0: tuple[float, ...]
    params: Mapping[str, Any]


def along(position: Callable, q: Array, v: Array) -> tuple[Array, Array]:
    """(r, r') of a position r(q)."""
    return jax.jvp(position, (q,), (v,))


def pendulum(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Plane pendulum from the position of its bob."""
    r, dr = along(lambda q: p["l"] * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])]), q, v)
    return 0.5 * p["m"] * dr @ dr - p["m"] * p["g"] * r[1]


def double_pendulum(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Double pendulum in absolute angles, in closed form."""
    m1, m2, l1, l2 = p["m1"], p["m2"], p["l1"], p["l2"]
    T = 0.5 * (m1 + m2) * (l1 * v[0]) ** 2 + 0.5 * m2 * (l2 * v[1]) ** 2
    T = T + m2 * l1 * l2 * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return T + p["g"] * ((m1 + m2) * l1 * jnp.cos(q[0]) + m2 * l2 * jnp.cos(q[1]))


def double_pendulum_positions(t: Any, q: Array, v: Array, p: Any) -> Array:
    """The same from the positions of its bobs."""

    def bobs(q: Array) -> Array:
        first = p["l1"] * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])
        return jnp.stack([first, first + p["l2"] * jnp.stack([jnp.sin(q[1]), -jnp.cos(q[1])])])

    r, dr = along(bobs, q, v)
    m = jnp.stack([p["m1"], p["m2"]])
    return 0.5 * m @ jnp.sum(dr**2, axis=1) - p["g"] * m @ r[:, 1]


def cart_pole(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Pole on a cart, from the position of its bob."""

    def bob(q: Array) -> Array:
        return jnp.stack([q[0] + p["l"] * jnp.sin(q[1]), p["l"] * jnp.cos(q[1])])

    r, dr = along(bob, q, v)
    return 0.5 * p["M"] * v[0] ** 2 + 0.5 * p["m"] * dr @ dr - p["m"] * p["g"] * r[1]


def spherical_pendulum(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Bob on a rod in space, from its position; q = (polar angle, azimuth)."""

    def bob(q: Array) -> Array:
        s, c = jnp.sin(q[0]), jnp.cos(q[0])
        return p["l"] * jnp.stack([s * jnp.cos(q[1]), s * jnp.sin(q[1]), -c])

    r, dr = along(bob, q, v)
    return 0.5 * p["m"] * dr @ dr - p["m"] * p["g"] * r[2]


def elastic_pendulum(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Bob on a spring in the plane, from its position; q = (length, angle)."""
    r, dr = along(lambda q: q[0] * jnp.stack([jnp.sin(q[1]), -jnp.cos(q[1])]), q, v)
    return 0.5 * p["m"] * dr @ dr - p["m"] * p["g"] * r[1] - 0.5 * p["k"] * (q[0] - p["l"]) ** 2


def kepler(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Motion about a center of attraction, in polar coordinates from the position."""
    r, dr = along(lambda q: q[0] * jnp.stack([jnp.cos(q[1]), jnp.sin(q[1])]), q, v)
    return 0.5 * p["m"] * dr @ dr + p["k"] / jnp.sqrt(r @ r)


def kepler_polar(t: Any, q: Array, v: Array, p: Any) -> Array:
    """The same in closed form."""
    return 0.5 * p["m"] * (v[0] ** 2 + (q[0] * v[1]) ** 2) + p["k"] / q[0]


def symmetric_top(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Heavy symmetric top in z-x-z angles, the textbook form."""
    T = 0.5 * p["A"] * (v[1] ** 2 + (v[0] * jnp.sin(q[1])) ** 2)
    T = T + 0.5 * p["C"] * (v[2] + v[0] * jnp.cos(q[1])) ** 2
    return T - p["m"] * p["g"] * p["l"] * jnp.cos(q[1])


def _rates(R: Callable, q: Array, v: Array) -> tuple[Array, Array]:
    """(R, body rates) from R^T dR/dt = [w]x."""
    value, rate = along(R, q, v)
    W = value.T @ rate
    return value, jnp.stack([W[2, 1], W[0, 2], W[1, 0]])


def top(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Heavy top with three moments of inertia, from its rotation matrix."""
    R, w = _rates(rotation.zxz.matrix, q, v)
    return 0.5 * w @ (p["I"] * w) - p["m"] * p["g"] * p["l"] * R[2, 2]


def rigid_body(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Rigid body in space, q = (x, y, z, yaw, pitch, roll), about its mass center."""
    _, w = _rates(lambda q: rotation.yaw_pitch_roll.matrix(q[3:]), q, v)
    T = 0.5 * p["m"] * v[:3] @ v[:3] + 0.5 * w @ (p["I"] * w)
    return T - p["m"] * p["g"] * q[2]


def aircraft(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Rigid body in space with a full inertia matrix and a mass center off the origin."""
    R, w = _rates(lambda q: rotation.yaw_pitch_roll.matrix(q[3:]), q, v)
    J = p["J"]
    J = jnp.stack([J[0], J[3], J[4], J[3], J[1], J[5], J[4], J[5], J[2]]).reshape(3, 3)
    center = R @ p["c"]
    T = 0.5 * p["m"] * v[:3] @ v[:3] + p["m"] * v[:3] @ (R @ jnp.cross(w, p["c"]))
    return T + 0.5 * w @ (J @ w) - p["m"] * p["g"] * (q[2] + center[2])


def chain(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Links with their masses at the ends, in absolute angles."""

    def ends(q: Array) -> Array:
        steps = jnp.stack([p["l"] * jnp.sin(q), -p["l"] * jnp.cos(q)])
        return jnp.cumsum(steps, axis=1)

    r, dr = along(ends, q, v)
    return 0.5 * p["m"] @ jnp.sum(dr**2, axis=0) - p["g"] * p["m"] @ r[1]


def links(n: int) -> Scene:
    """A chain of n links."""
    params = {"m": np.linspace(1.0, 0.5, n), "l": np.linspace(1.0, 0.7, n) / n, "g": G}
    angles = tuple(1.0 - 0.5 * np.arange(n) / n)
    return Scene(chain, angles, (0.0,) * n, params)


_PENDULUM = {"m": 1.0, "l": 0.8, "g": G}
_DOUBLE = {"m1": 1.0, "m2": 0.8, "l1": 1.0, "l2": 0.9, "g": G}
_BODY = {"m": 1.2, "I": np.array([0.02, 0.03, 0.05]), "g": G}
_ATTITUDE = (0.3, 0.4, -0.2), (0.5, -0.7, 0.9)

SCENES: dict[str, Scene] = {
    "pendulum": Scene(pendulum, (1.0,), (0.3,), _PENDULUM),
    "double_pendulum": Scene(double_pendulum, (1.0, 0.5), (0.2, -0.3), _DOUBLE),
    "double_pendulum_positions": Scene(
        double_pendulum_positions, (1.0, 0.5), (0.2, -0.3), _DOUBLE
    ),
    "cart_pole": Scene(cart_pole, (0.1, 0.4), (0.2, -0.3), {"M": 1.0, "m": 0.3, "l": 0.5, "g": G}),
    "spherical_pendulum": Scene(spherical_pendulum, (0.8, 0.2), (0.1, 1.5), _PENDULUM),
    "elastic_pendulum": Scene(
        elastic_pendulum, (1.1, 0.5), (0.2, 0.7), {"m": 1.0, "l": 1.0, "k": 40.0, "g": G}
    ),
    "kepler": Scene(kepler, (1.0, 0.0), (0.1, 1.1), {"m": 1.0, "k": 1.3}),
    "kepler_polar": Scene(kepler_polar, (1.0, 0.0), (0.1, 1.1), {"m": 1.0, "k": 1.3}),
    "symmetric_top": Scene(
        symmetric_top, (0.3, 0.5, 0.1), (0.4, 0.1, 30.0),
        {"A": 0.02, "C": 0.01, "m": 0.5, "l": 0.1, "g": G},
    ),
    "top": Scene(
        top, (0.3, 0.5, 0.1), (0.4, 0.1, 30.0),
        {"I": np.array([0.02, 0.03, 0.01]), "m": 0.5, "l": 0.1, "g": G},
    ),
    "rigid_body": Scene(
        rigid_body, (0.0, 0.0, 1.0, *_ATTITUDE[0]), (1.0, 0.5, -0.2, *_ATTITUDE[1]), _BODY
    ),
    "aircraft": Scene(
        aircraft, (0.0, 0.0, 1.0, *_ATTITUDE[0]), (1.0, 0.5, -0.2, *_ATTITUDE[1]),
        {"m": 1.2, "J": np.array([0.2, 0.3, 0.5, 0.01, 0.03, -0.02]),
         "c": np.array([0.1, 0.02, -0.05]), "g": G},
    ),
    "chain_3": links(3),
    "chain_4": links(4),
    "chain_6": links(6),
    "chain_8": links(8),
}  # fmt: skip
