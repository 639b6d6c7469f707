"""Models of the motions for MuJoCo, if it can represent them.

Hinges turn about -y, x to the right and z upward, so that angles are those of the motions. Joint
angles are relative to the previous link. Bodies are point masses with negligible inertia.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from bench._problems.exact_ends import exact_end
from bench._problems.motions import Motion

POINT = 1e-12  # kg m^2, inertia of a point mass, which MuJoCo requires to be positive
Model = tuple[Any, Callable[[Any], None], Callable[[Any], np.ndarray]]  # model, put, read


def _model(library: Any, g: float, bodies: str) -> Any:
    return library.MjModel.from_xml_string(
        f'<mujoco><option integrator="RK4" gravity="0 0 {-g!r}"/>'
        '<compiler angle="radian" boundmass="0" boundinertia="0"/>'
        '<option><flag contact="disable" constraint="disable" energy="disable"/></option>'
        f"<worldbody>{bodies}</worldbody></mujoco>"
    )


def links(library: Any, motion: Motion) -> Model:
    """Point masses at the ends of links."""
    p = motion.params
    pairs = ((p["m1"], p["h1"]), (p["m2"], p["h2"])) if "m1" in p else zip(p["m"], p["l"])  # noqa: B905
    masses, rods = np.array(list(pairs), float).T
    inner = ""
    for i in reversed(range(len(rods))):
        z = 0.0 if i == 0 else -rods[i - 1]
        inner = (
            f'<body pos="0 0 {float(z)!r}"><joint type="hinge" axis="0 -1 0"/>'
            f'<inertial pos="0 0 {float(-rods[i])!r}" mass="{float(masses[i])!r}" '
            f'diaginertia="{POINT} {POINT} {POINT}"/>{inner}</body>'
        )

    def put(data: Any) -> None:
        data.qpos[:] = np.diff(motion.q0, prepend=0.0)
        data.qvel[:] = np.diff(motion.v0, prepend=0.0)

    return _model(library, p["g"], inner), put, lambda data: np.cumsum(data.qpos)


def elastic(library: Any, motion: Motion) -> Model:
    """A hinge that carries a slide with a spring."""
    p = motion.params
    body = (
        '<body><joint type="hinge" axis="0 -1 0"/>'
        f'<joint type="slide" axis="0 0 -1" stiffness="{p["k"]!r}"/>'
        f'<inertial pos="0 0 {-p["l"]!r}" mass="{p["m"]!r}" '
        f'diaginertia="{POINT} {POINT} {POINT}"/></body>'
    )

    def put(data: Any) -> None:
        (r, angle), (r_rate, w) = motion.q0, motion.v0
        data.qpos[:] = angle, r - p["l"]
        data.qvel[:] = w, r_rate

    def read(data: Any) -> np.ndarray:
        angle, stretch = data.qpos
        return np.array([p["l"] + stretch, angle])

    return _model(library, p["g"], body), put, read


def top(library: Any, motion: Motion) -> Model:
    """A body on a ball joint; angles from its attitude, multiples of 2 pi from the exact end."""
    p, near = motion.params, exact_end("heavy top")
    across = p["I1"] - p["m"] * p["l"] ** 2  # about the mass center
    body = (
        '<body><joint type="ball"/>'
        f'<inertial pos="0 0 {p["l"]!r}" mass="{p["m"]!r}" '
        f'diaginertia="{across!r} {across!r} {p["I3"]!r}"/></body>'
    )
    (phi, theta, psi), (phi_rate, theta_rate, psi_rate) = motion.q0, motion.v0

    def half(angle: float, axis: int) -> np.ndarray:
        quaternion = np.zeros(4)
        quaternion[0], quaternion[axis] = np.cos(angle / 2), np.sin(angle / 2)
        return quaternion

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
        return np.array([a[0] * b[0] - a[1:] @ b[1:], *vector])

    attitude = product(product(half(phi, 3), half(theta, 1)), half(psi, 3))
    rates = (
        phi_rate * np.sin(theta) * np.sin(psi) + theta_rate * np.cos(psi),
        phi_rate * np.sin(theta) * np.cos(psi) - theta_rate * np.sin(psi),
        psi_rate + phi_rate * np.cos(theta),
    )

    def put(data: Any) -> None:
        data.qpos[:], data.qvel[:] = attitude, rates

    def read(data: Any) -> np.ndarray:
        w, x, y, z = data.qpos
        total, difference = np.arctan2(z, w), np.arctan2(y, x)
        tilt = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z))
        angles = np.array([total + difference, tilt, total - difference])
        return angles + 2.0 * np.pi * np.round((near - angles) / (2.0 * np.pi))

    return _model(library, p["g"], body), put, read


MODELS: dict[str, Callable[[Any, Motion], Model]] = {
    "double_pendulum": links,
    "chain": links,
    "elastic_pendulum": elastic,
    "heavy_top": top,
}
