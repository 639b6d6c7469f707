"""Newton's and Euler's equations of free rigid bodies with joint forces, on numbers.

Every body has its own position and rotation matrix. Joints are rows on accelerations,
J a + gamma = 0, with forces J^T lam. They are solved for by least squares, so that redundant joints
are allowed. Positions of joints are kept by the accuracy of the integration alone.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from bench.mechanisms._equations import integrated

GROUND = -1


class Body(NamedTuple):
    """Mass, and inertia about the mass center in body axes."""

    mass: float
    inertia: np.ndarray


class Placed(NamedTuple):
    """Center, rotation, velocity and angular velocity in space of one body."""

    r: np.ndarray
    R: np.ndarray
    v: np.ndarray
    w: np.ndarray


REST = Placed(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
Row = tuple[dict[int, np.ndarray], float]  # by body, its six entries of J; gamma
Joint = Callable[[Sequence[Placed]], list[Row]]


def _at(bodies: Sequence[Placed], i: int) -> Placed:
    return REST if i == GROUND else bodies[i]


def _entries(i: int, j: int, of_i: Any, of_j: Any) -> dict[int, np.ndarray]:
    both = {i: np.concatenate(of_i), j: np.concatenate(of_j)}
    return {body: row for body, row in both.items() if body != GROUND}


def pin(i: int, j: int, a: np.ndarray, b: np.ndarray) -> Joint:
    """The point a of body i is the point b of body j, both from the centers, in body axes."""

    def rows(bodies: Sequence[Placed]) -> list[Row]:
        x, y = _at(bodies, i), _at(bodies, j)
        p, q = x.R @ a, y.R @ b
        gamma = np.cross(x.w, np.cross(x.w, p)) - np.cross(y.w, np.cross(y.w, q))
        return [
            (_entries(i, j, (e, np.cross(p, e)), (-e, -np.cross(q, e))), gamma @ e)
            for e in np.eye(3)
        ]

    return rows


def parallel(i: int, j: int, axis: np.ndarray, other: np.ndarray) -> Joint:
    """The axis of body i keeps the direction of an axis of body j."""
    across = np.linalg.svd(other[None])[2][1:]

    def rows(bodies: Sequence[Placed]) -> list[Row]:
        x, y = _at(bodies, i), _at(bodies, j)
        e, found, none = x.R @ axis, [], np.zeros(3)
        for p in (y.R @ p for p in across):
            normal = np.cross(e, p)
            rate = np.cross(np.cross(x.w, e), p) + np.cross(e, np.cross(y.w, p))
            found.append((_entries(i, j, (none, normal), (none, -normal)), (x.w - y.w) @ rate))
        return found

    return rows


def hinge(i: int, j: int, a: Any, b: Any, axis: Any, other: Any) -> Joint:
    """A pin with a common axis."""
    parts = pin(i, j, np.asarray(a, float), np.asarray(b, float))
    turns = parallel(i, j, np.asarray(axis, float), np.asarray(other, float))
    return lambda bodies: parts(bodies) + turns(bodies)


def rope(i: int, j: int, a: np.ndarray) -> Joint:
    """The center of body j keeps its distance from the point a of body i."""

    def rows(bodies: Sequence[Placed]) -> list[Row]:
        x, y = bodies[i], bodies[j]
        p = x.R @ a
        u, rate = y.r - x.r - p, y.v - x.v - np.cross(x.w, p)
        gamma = rate @ rate - u @ np.cross(x.w, np.cross(x.w, p))
        return [(_entries(i, j, (-u, -np.cross(p, u)), (u, np.zeros(3))), gamma)]

    return rows


def wheel(i: int, radius: float, down: np.ndarray) -> Joint:
    """A thin wheel, its axis along y of the body, that rolls without slip on a plane."""

    def rows(bodies: Sequence[Placed]) -> list[Row]:
        x = bodies[i]
        e = x.R[:, 1]
        turned = np.cross(x.w, e)
        d, d_rate = down - (e @ down) * e, -(turned @ down) * e - (e @ down) * turned
        size = np.linalg.norm(d)
        n = d / size
        arm, arm_rate = radius * n, radius * (d_rate - n * (n @ d_rate)) / size
        gamma = np.cross(x.w, arm_rate)
        return [
            ({i: np.concatenate([axis, np.cross(arm, axis)])}, gamma @ axis) for axis in np.eye(3)
        ]

    return rows


Loads = Callable[[Sequence[Placed]], tuple[np.ndarray, np.ndarray]]


def end(
    bodies: Sequence[Body],
    joints: Sequence[Joint],
    start: Sequence[Placed],
    loads: Loads,
    t1: float,
) -> list[Placed]:
    """The bodies at t1.

    Args:
        bodies: all bodies.
        joints: the rows.
        start: of all bodies.
        loads: forces at the mass centers and torques, in space, of all bodies.
        t1: s.
    """
    count = len(bodies)

    def unpacked(y: np.ndarray) -> list[Placed]:
        parts = y.reshape(count, 18)
        return [Placed(x[:3], x[3:12].reshape(3, 3), x[12:15], x[15:]) for x in parts]

    def moving(t: float, y: np.ndarray) -> np.ndarray:
        now = unpacked(y)
        forces, torques = loads(now)
        inverse, free = np.zeros((count, 6, 6)), np.zeros((count, 6))
        for k, (body, at) in enumerate(zip(bodies, now, strict=True)):
            inertia = at.R @ body.inertia @ at.R.T
            inverse[k, :3, :3] = np.eye(3) / body.mass
            inverse[k, 3:, 3:] = np.linalg.inv(inertia)
            torque = torques[k] - np.cross(at.w, inertia @ at.w)
            free[k] = inverse[k] @ np.concatenate([forces[k], torque])
        rows = [row for joint in joints for row in joint(now)]
        J, gamma = np.zeros((len(rows), count, 6)), np.zeros(len(rows))
        for i, (entries, rate) in enumerate(rows):
            gamma[i] = rate
            for k, entry in entries.items():
                J[i, k] += entry
        moved = np.einsum("kab,ikb->ika", inverse, J)
        S = np.einsum("ika,jka->ij", J, moved)
        lam = np.linalg.lstsq(S, -gamma - np.einsum("ika,ka->i", J, free), rcond=1e-11)[0]
        a = free + np.einsum("ika,i->ka", moved, lam)
        rates = [
            np.concatenate([x.v, np.cross(x.w, x.R, axisb=0, axisc=0).ravel(), a[k]])
            for k, x in enumerate(now)
        ]
        return np.concatenate(rates)

    y0 = np.concatenate([np.concatenate([x.r, x.R.ravel(), x.v, x.w]) for x in start])
    return unpacked(integrated(moving, y0, t1))
