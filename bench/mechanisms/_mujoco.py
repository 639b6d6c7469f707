"""The arm as a model of MuJoCo."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from bench.mechanisms._scene import Scene
from bench.mechanisms._spatial import AXES, CENTERS, OFFSETS


def _text(x: Any) -> str:
    return " ".join(repr(float(a)) for a in np.ravel(x))


def arm(scene: Scene, h: float) -> tuple[Callable[[int], Any], np.ndarray]:
    """(a function that takes steps of h from the start, the accelerations there)."""
    library, p, inner = import_module("mujoco"), scene.params, ""
    for i in reversed(range(6)):
        axis = np.eye(3)["xyz".index(AXES[i])]
        inner = (
            f'<body pos="{_text(OFFSETS[i])}">'
            f'<joint type="hinge" axis="{_text(axis)}" damping="{_text(p["d"][i])}"/>'
            f'<inertial pos="{_text(CENTERS[i])}" mass="{_text(p["m"][i])}" '
            f'diaginertia="{_text(p["J"][i])}"/>{inner}</body>'
        )
    model = library.MjModel.from_xml_string(
        f'<mujoco><option integrator="RK4" gravity="0 0 {-p["g"]!r}" timestep="{h!r}">'
        '<flag contact="disable" constraint="disable"/></option>'
        '<compiler angle="radian" boundmass="0" boundinertia="0"/>'
        f"<worldbody>{inner}</worldbody></mujoco>"
    )
    data = library.MjData(model)

    def begin() -> None:
        data.qpos[:], data.qvel[:] = scene.q0, scene.v0

    begin()
    library.mj_forward(model, data)
    a = np.array(data.qacc)

    def steps(count: int) -> np.ndarray:
        begin()
        library.mj_step(model, data, nstep=count)
        return np.array(data.qpos)

    return steps, a
