"""Spatial mechanisms: bodies by poses."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.mechanisms import _bodies, _equations
from bench.mechanisms._bodies import GROUND, Body, Placed
from bench.mechanisms._scene import Scene

G = 9.81
turn = jl.rotation
Pose = Callable[[Any, Array, Any], tuple[Array, Array]]


def shown(poses: Sequence[Pose], params: Any) -> Callable[[Any], np.ndarray]:
    """Centers and rotations of all bodies, of q."""

    def read(q: Any) -> np.ndarray:
        placed = [pose(0.0, jnp.asarray(q), params) for pose in poses]
        return np.concatenate([np.concatenate([r, np.ravel(R)]) for R, r in placed])

    return read


def _numbers(bodies: Sequence[Placed]) -> np.ndarray:
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


# ---- Whipple's bicycle (Meijaard, Papadopoulos, Ruina, Schwab, Proc. R. Soc. A 463 (2007) 1955) --
# x forward, y to the right, z downward.

BICYCLE = {
    "w": 1.02,
    "c": 0.08,
    "tilt": np.pi / 10.0,
    "g": G,
    "r_rear": 0.3,
    "m_rear": 2.0,
    "I_rear": np.array([0.0603, 0.12, 0.0603]),
    "m_frame": 85.0,
    "at_frame": np.array([0.3, 0.0, -0.9]),
    "I_frame": np.array([[9.2, 0.0, 2.4], [0.0, 11.0, 0.0], [2.4, 0.0, 2.8]]),
    "m_fork": 4.0,
    "at_fork": np.array([0.9, 0.0, -0.7]),
    "I_fork": np.array([[0.05892, 0.0, -0.00756], [0.0, 0.06, 0.0], [-0.00756, 0.0, 0.00708]]),
    "r_front": 0.35,
    "m_front": 3.0,
    "I_front": np.array([0.1405, 0.28, 0.1405]),
}
BICYCLE_NAMES = ("x", "y", "yaw", "lean", "pitch", "steer", "rear", "front")


def _vector(*parts: Any) -> Array:
    return jnp.stack([jnp.asarray(x, dtype=float) for x in parts])


def _leaned(q: Array) -> Array:
    return turn.about_z(q[2]) @ turn.about_x(q[3])


def _pitched(q: Array) -> Array:
    return _leaned(q) @ turn.about_y(q[4])


def _steered(q: Array, p: Any) -> Array:
    axis = turn.about_y(p["tilt"])
    return _pitched(q) @ axis @ turn.about_z(q[5]) @ axis.T


def rear_wheel(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
    """It touches the ground at (x, y)."""
    R = _leaned(q)
    return R @ turn.about_y(q[6]), _vector(q[0], q[1], 0.0) - p["r_rear"] * R[:, 2]


def frame(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
    """The frame with its rider."""
    R = _pitched(q)
    return R, rear_wheel(t, q, p)[1] + R @ (p["at_frame"] + _vector(0.0, 0.0, p["r_rear"]))


def _on_axis(t: Any, q: Array, p: Any) -> Array:
    """The point of the steering axis that is on the ground at the start."""
    ahead = _vector(p["w"] + p["c"], 0.0, p["r_rear"])
    return rear_wheel(t, q, p)[1] + _pitched(q) @ ahead


def fork(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
    """The fork with the handlebar."""
    R = _steered(q, p)
    return R, _on_axis(t, q, p) + R @ (p["at_fork"] - _vector(p["w"] + p["c"], 0.0, 0.0))


def front_wheel(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
    """It touches the ground by a row."""
    R = _steered(q, p)
    center = _on_axis(t, q, p) + R @ _vector(-p["c"], 0.0, -p["r_front"])
    return R @ turn.about_y(q[7]), center


def bicycle_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Four rigid bodies."""
    up, total = _vector(0.0, 0.0, p["g"]), jnp.zeros(())
    for name, pose in (("rear", rear_wheel), ("frame", frame), ("fork", fork),
                       ("front", front_wheel)):  # fmt: skip
        body = jl.energy.RigidBody(p[f"m_{name}"], p[f"I_{name}"])
        total = total + body.kinetic(pose, t, q, v, p) - body.gravity(pose, t, q, p, up)
    return total


def _down(q: Array, p: Any) -> Array:
    """From the center of the front wheel to its lowest point."""
    axis = _steered(q, p)[:, 1]
    d = _vector(0.0, 0.0, 1.0) - axis[2] * axis
    return p["r_front"] * d / jnp.sqrt(d @ d)


def touching(t: Any, q: Array, p: Any) -> Array:
    """Depth of the lowest point of the front wheel."""
    return front_wheel(t, q, p)[1][2] + _down(q, p)[2]


def _slip(pose: Pose, arm: Array, t: Any, q: Array, v: Array, p: Any) -> Array:
    velocity = jl.energy.velocity(lambda t, q, p: pose(t, q, p)[1], t, q, v, p)
    w = pose(t, q, p)[0] @ jl.energy.body_velocity(pose, t, q, v, p)[1]
    return (velocity + jnp.cross(w, arm))[:2]


def slips(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Velocities of both contacts along the ground."""
    rear = _slip(rear_wheel, p["r_rear"] * _leaned(q)[:, 2], t, q, v, p)
    return jnp.concatenate([rear, _slip(front_wheel, _down(q, p), t, q, v, p)])


def bicycle_speeds(t: Any, q: Array, v: Array, p: Any) -> Array:
    """The slips, and rates of lean, pitch, steer and the rear wheel."""
    return jnp.concatenate([slips(t, q, v, p), v[3:7]])


def _bicycle_end(q0: np.ndarray, v0: np.ndarray, t1: float) -> np.ndarray:
    p = BICYCLE
    names = ("rear", "frame", "fork", "front")
    bodies = [
        Body(p[f"m_{name}"], np.diag(J) if (J := p[f"I_{name}"]).ndim == 1 else J) for name in names
    ]
    hub = np.array([0.0, 0.0, p["r_rear"]]) + p["at_frame"]
    head = np.array([p["w"] + p["c"], 0.0, 0.0])
    axis, across = np.array([np.sin(p["tilt"]), 0.0, np.cos(p["tilt"])]), np.array([0.0, 1.0, 0.0])
    front = np.array([-p["c"], 0.0, -p["r_front"]]) + head - p["at_fork"]
    down, none = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    joints = [
        _bodies.hinge(0, 1, none, -hub, across, across),
        _bodies.hinge(1, 2, head - p["at_frame"], head - p["at_fork"], axis, axis),
        _bodies.hinge(3, 2, none, front, across, across),
        _bodies.wheel(0, p["r_rear"], down),
        _bodies.wheel(3, p["r_front"], down),
    ]
    loads = falling([body.mass for body in bodies], p["g"] * down)
    start = started((rear_wheel, frame, fork, front_wheel), q0, v0, p)
    return _numbers(_bodies.end(bodies, joints, start, loads, t1))


def bicycle(quasi: bool) -> Scene:
    """It rides upright at 4.6 m/s and is pushed sideways."""
    q0, v0 = np.zeros(8), np.zeros(8)
    v0[[0, 3, 6, 7]] = 4.6, 0.5, -4.6 / BICYCLE["r_rear"], -4.6 / BICYCLE["r_front"]
    slipping = ("rear x", "rear y", "front x", "front y")
    free = ("lean rate", "pitch rate", "steer rate", "rear rate")
    speeds = jl.QuasiVelocities(bicycle_speeds, (*slipping, *free), slipping)
    return Scene(
        bicycle_lagrangian, BICYCLE_NAMES, BICYCLE, q0, v0, 5.0, 1e-2,
        partial(_bicycle_end, q0, v0, 5.0), touching, slips, quasi=speeds if quasi else None,
        seen=shown((rear_wheel, frame, fork, front_wheel), BICYCLE),
    )  # fmt: skip


# ---- Bricard's six-bar: five moving rods of length 1, all hinges at right angles -----------------

SIX_BAR = {"m": 1.0, "J": np.array([1.0 / 12.0, 0.002]), "g": G}  # J across a rod, along it
RODS = np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [-1, 0, 0], [0, 1, 0]], float)
HINGES = "yzxyz"
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
    total, up = jnp.zeros(()), _vector(0.0, -p["g"], 0.0)
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
        return _numbers(_bodies.end(bodies, joints, started(poses, q0, v0, p), loads, t1))

    names = tuple(f"hinge{i}" for i in range(5))
    return Scene(
        six_bar_lagrangian, names, p, q0, v0, t1, 4e-3, end, six_bar_closed,
        seen=shown(poses, p), independent=INDEPENDENT,
    )  # fmt: skip


INDEPENDENT = (0, 1, 2, 4)

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
        return _numbers(_bodies.end(bodies, [_bodies.rope(0, 1, p["hook"])], start, loads, t1))

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
    total, down = jnp.zeros(()), _vector(0.0, 0.0, -p["g"])
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

        return _numbers(_bodies.end(bodies, joints, started(poses, q0, v0, p), loads, t1))

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
