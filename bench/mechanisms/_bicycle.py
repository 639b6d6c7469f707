"""Whipple's bicycle (Meijaard, Papadopoulos, Ruina, Schwab, Proc. R. Soc. A 463 (2007) 1955).

x forward, y to the right, z downward.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.mechanisms import _bodies
from bench.mechanisms._bodies import Body
from bench.mechanisms._poses import G, Pose, falling, numbers, shown, started, turn, vector
from bench.mechanisms._scene import Scene

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
    return R @ turn.about_y(q[6]), vector(q[0], q[1], 0.0) - p["r_rear"] * R[:, 2]


def frame(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
    """The frame with its rider."""
    R = _pitched(q)
    return R, rear_wheel(t, q, p)[1] + R @ (p["at_frame"] + vector(0.0, 0.0, p["r_rear"]))


def _on_axis(t: Any, q: Array, p: Any) -> Array:
    """The point of the steering axis that is on the ground at the start."""
    ahead = vector(p["w"] + p["c"], 0.0, p["r_rear"])
    return rear_wheel(t, q, p)[1] + _pitched(q) @ ahead


def fork(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
    """The fork with the handlebar."""
    R = _steered(q, p)
    return R, _on_axis(t, q, p) + R @ (p["at_fork"] - vector(p["w"] + p["c"], 0.0, 0.0))


def front_wheel(t: Any, q: Array, p: Any) -> tuple[Array, Array]:
    """It touches the ground by a row."""
    R = _steered(q, p)
    center = _on_axis(t, q, p) + R @ vector(-p["c"], 0.0, -p["r_front"])
    return R @ turn.about_y(q[7]), center


def bicycle_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Four rigid bodies."""
    up, total = vector(0.0, 0.0, p["g"]), jnp.zeros(())
    for name, pose in (("rear", rear_wheel), ("frame", frame), ("fork", fork),
                       ("front", front_wheel)):  # fmt: skip
        body = jl.energy.RigidBody(p[f"m_{name}"], p[f"I_{name}"])
        total = total + body.kinetic(pose, t, q, v, p) - body.gravity(pose, t, q, p, up)
    return total


def _down(q: Array, p: Any) -> Array:
    """From the center of the front wheel to its lowest point."""
    axis = _steered(q, p)[:, 1]
    d = vector(0.0, 0.0, 1.0) - axis[2] * axis
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
    return numbers(_bodies.end(bodies, joints, start, loads, t1))


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
