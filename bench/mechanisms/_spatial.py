"""Spatial mechanisms: bodies by poses."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.mechanisms import _bodies, _equations
from bench.mechanisms._bicycle import bicycle
from bench.mechanisms._bodies import GROUND, Body, Placed
from bench.mechanisms._poses import G, Pose, falling, numbers, shown, started, turn, vector
from bench.mechanisms._scene import Scene

# ---- Bricard's six-bar: five moving rods of length 1, all hinges at right angles -----------------

SIX_BAR = {"m": 1.0, "J": np.array([1.0 / 12.0, 0.002]), "g": G}  # J across a rod, along it
RODS = np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [-1, 0, 0], [0, 1, 0]], float)
HINGES = "yzxyz"
INDEPENDENT = (0, 1, 2, 4)  # rows
ABOUT = {"x": turn.about_x, "y": turn.about_y, "z": turn.about_z}


def _along(i: int) -> np.ndarray:
    return np.abs(RODS[i])


def _heads(q: Array) -> list[tuple[Array, Array]]:
    """Rotation and head of every rod."""
    R, r, found = jnp.eye(3), jnp.zeros(3), []
    for i, axis in enumerate(HINGES):
        R = R @ ABOUT[axis](q[i])
        r = r + R @ RODS[i]
        found.append((R, r))
    return found


def rod(i: int) -> Pose:
    """The pose of a rod by its center."""

    def pose(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
        R, head = _heads(q)[i]
        return R, head - 0.5 * (R @ RODS[i])

    return pose


def six_bar_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Weight along -y."""
    total, up = jnp.zeros(()), vector(0.0, -p["g"], 0.0)
    for i in range(5):
        moments = p["J"][0] + _along(i) * (p["J"][1] - p["J"][0])
        body = jl.energy.RigidBody(p["m"], moments)
        total = total + body.kinetic(rod(i), t, q, v, p) - body.gravity(rod(i), t, q, p, up)
    return total


def six_bar_closed(t: Any, q: Array, p: Any) -> Array:
    """The last head and its hinge along x are fixed; one row depends on the others."""
    R, r = _heads(q)[-1]
    return jnp.concatenate([r - np.array([0.0, 0.0, 1.0]), R[1:, 0]])


def six_bar() -> Scene:
    """It falls from rest."""
    q0, v0, t1, p = np.zeros(5), np.zeros(5), 2.0, SIX_BAR
    poses = [rod(i) for i in range(5)]

    def end() -> np.ndarray:
        across, along = p["J"]
        bodies = [Body(p["m"], np.diag(across + _along(i) * (along - across))) for i in range(5)]
        joints, axes = [], {x: np.eye(3)[i] for i, x in enumerate("xyz")}
        for i, axis in enumerate((*HINGES, "x")):
            tail = -0.5 * RODS[i] if i < 5 else np.array([0.0, 0.0, 1.0])
            head = 0.5 * RODS[i - 1] if i else np.zeros(3)
            body, other = (i if i < 5 else GROUND), (i - 1 if i else GROUND)
            joints.append(_bodies.hinge(body, other, tail, head, axes[axis], axes[axis]))
        loads = falling([p["m"]] * 5, np.array([0.0, -p["g"], 0.0]))
        return numbers(_bodies.end(bodies, joints, started(poses, q0, v0, p), loads, t1))

    names = tuple(f"hinge{i}" for i in range(5))
    return Scene(
        six_bar_lagrangian, names, p, q0, v0, t1, 4e-3, end, six_bar_closed,
        seen=shown(poses, p), independent=INDEPENDENT,
    )  # fmt: skip


# ---- A copter that carries a load on a rope ------------------------------------------------------

COPTER = {"m": 1.2, "J": np.array([0.012, 0.014, 0.022]), "m_load": 0.4, "rope": 0.8, "g": G}
COPTER |= {"hook": np.array([0.02, 0.0, -0.05]), "thrust": 17.0}
COPTER |= {"torque": np.array([0.001, -0.002, 0.0005])}


def copter_pose(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
    """By position and quaternion."""
    return turn.quaternion.matrix(q[3:7]), q[:3]


def load_pose(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
    """A point; it is shown without rotation."""
    return jnp.eye(3), q[7:]


def copter_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """A rigid body and a point; z upward."""
    body = jl.energy.RigidBody(p["m"], p["J"])
    T = body.kinetic(copter_pose, t, q, v, p) + 0.5 * p["m_load"] * (v[7:] @ v[7:])
    return T - p["g"] * (p["m"] * q[2] + p["m_load"] * q[9])


def copter_rows(t: Any, q: Array, p: Any) -> Array:
    """The norm of the quaternion, the length of the rope from the hook."""
    R, r = copter_pose(t, q, p)
    rope = q[7:] - r - R @ p["hook"]
    return jnp.stack([q[3:7] @ q[3:7] - 1.0, rope @ rope - p["rope"] ** 2])


def rotors(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Constant thrust and torque in body axes."""
    s = q[3:7]
    lift = p["thrust"] * turn.quaternion.matrix(s)[:, 2]
    turned = turn.quaternion.body_rate_matrix(s).T @ p["torque"]
    return jnp.concatenate([lift, turned, jnp.zeros(3)])


def copter() -> Scene:
    """It starts tilted; the load swings."""
    p, t1 = COPTER, 2.0
    s = np.array([0.98, 0.1, -0.12, 0.05])
    s /= np.linalg.norm(s)
    w, r = np.array([0.4, -0.3, 0.6]), np.array([0.0, 0.0, 2.0])
    s_rate = np.asarray(turn.quaternion.from_body_rates(s, w))
    R = np.asarray(turn.quaternion.matrix(s))
    along = np.array([0.3, -0.2, -0.9])
    along /= np.linalg.norm(along)
    v = np.array([0.3, 0.1, 0.0])
    hook = v + R @ np.cross(w, p["hook"])
    swing = np.cross(along, [0.5, 1.0, 0.2])
    q0 = np.concatenate([r, s, r + R @ p["hook"] + p["rope"] * along])
    v0 = np.concatenate([v, s_rate, hook + swing])

    def end() -> np.ndarray:
        bodies = [Body(p["m"], np.diag(p["J"])), Body(p["m_load"], np.eye(3))]
        weights = -p["g"] * np.array([0.0, 0.0, 1.0]) * np.array([[p["m"]], [p["m_load"]]])

        def loads(now: Sequence[Placed]) -> tuple[np.ndarray, np.ndarray]:
            forces, torques = weights.copy(), np.zeros((2, 3))
            forces[0] += p["thrust"] * now[0].R[:, 2]
            torques[0] = now[0].R @ p["torque"]
            return forces, torques

        start = started((copter_pose, load_pose), q0, v0, p)
        return numbers(_bodies.end(bodies, [_bodies.rope(0, 1, p["hook"])], start, loads, t1))

    names = ("x", "y", "z", "s0", "s1", "s2", "s3", "load x", "load y", "load z")
    return Scene(
        copter_lagrangian, names, p, q0, v0, t1, 4e-3, end, copter_rows, force=rotors,
        seen=shown((copter_pose, load_pose), p),
    )  # fmt: skip


# ---- An arm of six hinges ------------------------------------------------------------------------

AXES = "zyyxyx"
OFFSETS = np.array(
    [[0, 0, 0.2], [0.1, 0, 0.2], [0, 0, 0.5], [0.2, 0, 0.1], [0.3, 0, 0], [0.1, 0, 0]]
)
CENTERS = np.array(
    [
        *([0.02, 0, 0.1], [0, 0.05, 0.25], [0.1, -0.03, 0.05]),
        *([0.15, 0, 0], [0.05, 0, 0], [0.04, 0, 0.01]),
    ]
)
ARM = {
    "m": np.array([8.0, 7.0, 4.0, 2.0, 1.0, 0.5]),
    "J": np.array(
        [
            *([0.05, 0.06, 0.04], [0.15, 0.16, 0.02], [0.03, 0.05, 0.05]),
            *([0.004, 0.02, 0.02], [0.002, 0.003, 0.003], [0.0006, 0.0008, 0.0009]),
        ]
    ),
    "d": np.array([2.0, 2.0, 1.0, 0.3, 0.2, 0.05]),
    "g": G,
}


def arm_link(i: int) -> Pose:
    """The pose of a link by its mass center."""

    def pose(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
        R, r = jnp.eye(3), jnp.zeros(3)
        for k in range(i + 1):
            r = r + R @ OFFSETS[k]
            R = R @ ABOUT[AXES[k]](q[k])
        return R, r + R @ CENTERS[i]

    return pose


def arm_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Six rigid bodies; z upward."""
    total, down = jnp.zeros(()), vector(0.0, 0.0, -p["g"])
    for i in range(6):
        body, pose = jl.energy.RigidBody(p["m"][i], p["J"][i]), arm_link(i)
        total = total + body.kinetic(pose, t, q, v, p) - body.gravity(pose, t, q, p, down)
    return total


def friction(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Of every hinge."""
    return -p["d"] * v


def arm() -> Scene:
    """It falls, slowed by friction."""
    p, t1 = ARM, 1.0
    q0, v0 = np.array([0.3, 0.5, -0.4, 0.6, 0.8, -0.3]), np.array([0.5, -0.3, 0.4, 1.0, -0.8, 0.5])
    poses = [arm_link(i) for i in range(6)]
    axes = [np.eye(3)["xyz".index(x)] for x in AXES]

    def end() -> np.ndarray:
        bodies = [Body(m, np.diag(J)) for m, J in zip(p["m"], p["J"], strict=True)]
        joints = []
        for i in range(6):
            before = GROUND if i == 0 else i - 1
            place = OFFSETS[i] - (CENTERS[i - 1] if i else 0.0)
            joints.append(_bodies.hinge(i, before, -CENTERS[i], place, axes[i], axes[i]))
        weights = -p["g"] * p["m"][:, None] * np.array([0.0, 0.0, 1.0])

        def loads(now: Sequence[Placed]) -> tuple[np.ndarray, np.ndarray]:
            torques = np.zeros((6, 3))
            for i, x in enumerate(now):
                e = x.R @ axes[i]
                w = x.w - (now[i - 1].w if i else 0.0)
                torques[i] -= p["d"][i] * (e @ w) * e
                if i:
                    torques[i - 1] += p["d"][i] * (e @ w) * e
            return weights, torques

        return numbers(_bodies.end(bodies, joints, started(poses, q0, v0, p), loads, t1))

    names = tuple(f"hinge{i}" for i in range(6))
    return Scene(
        arm_lagrangian, names, p, q0, v0, t1, 4e-3, end, force=friction, seen=shown(poses, p)
    )


# ---- A tensegrity: six bars, masses at their ends, and 24 springs --------------------------------


def _icosahedron() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes, bars and springs: parallel pairs of bars along the axes."""
    nodes = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            for end in (-2.0, 2.0):
                node = np.zeros(3)
                node[axis], node[(axis + 2) % 3] = end, side
                nodes.append(0.5 * node)
    r = np.array(nodes)
    bars = np.arange(12).reshape(6, 2)
    apart = np.linalg.norm(r[:, None] - r[None], axis=2)
    near = np.isclose(apart, np.sqrt(1.5)) & np.triu(np.ones((12, 12), bool))
    return r, bars, np.argwhere(near)


NODES, BARS, SPRINGS = _icosahedron()
TENSEGRITY = {"m": 0.2, "k": 60.0, "rest": 1.1, "bar": 2.0}


def tensegrity_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Equal masses; springs between them."""
    r = q.reshape(12, 3)
    u = r[SPRINGS[:, 1]] - r[SPRINGS[:, 0]]
    stretch = jnp.sqrt(jnp.sum(u * u, 1)) - p["rest"]
    return 0.5 * p["m"] * (v @ v) - 0.5 * p["k"] * jnp.sum(stretch**2)


def stiff_bars(t: Any, q: Array, p: Any) -> Array:
    """Lengths of the bars."""
    r = q.reshape(12, 3)
    u = r[BARS[:, 1]] - r[BARS[:, 0]]
    return jnp.sum(u * u, 1) - p["bar"] ** 2


def tensegrity() -> Scene:
    """It tumbles and shakes."""
    p, t1, rng = TENSEGRITY, 2.0, np.random.default_rng(3)
    v0 = np.cross([0.5, 1.0, 0.3], NODES) + rng.normal(scale=0.5, size=NODES.shape)
    u, w = NODES[BARS[:, 1]] - NODES[BARS[:, 0]], v0[BARS[:, 1]] - v0[BARS[:, 0]]
    along = 0.5 * np.sum(u * w, 1, keepdims=True) / np.sum(u * u, 1, keepdims=True) * u
    v0[BARS[:, 0]] += along
    v0[BARS[:, 1]] -= along
    first, second = SPRINGS.T

    def forces(r: np.ndarray) -> np.ndarray:
        u = r[second] - r[first]
        size = np.linalg.norm(u, axis=1, keepdims=True)
        pull, found = p["k"] * (1.0 - p["rest"] / size) * u, np.zeros((12, 3))
        np.add.at(found, first, pull)
        np.add.at(found, second, -pull)
        return found

    end = partial(_equations.tensegrity, NODES, v0, BARS, forces, p["m"], t1)
    names = tuple(f"{x}{i}" for i in range(12) for x in "xyz")
    return Scene(
        tensegrity_lagrangian, names, p, NODES.ravel(), v0.ravel(), t1, 4e-3, end, stiff_bars
    )


def spatial_scenes() -> dict[str, Any]:
    """By name."""
    return {
        "bicycle": partial(bicycle, False), "bicycle, quasi": partial(bicycle, True),
        "six-bar": six_bar, "copter with load": copter, "arm": arm, "tensegrity": tensegrity,
    }  # fmt: skip
