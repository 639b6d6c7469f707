"""Forward dynamics of the chain by other libraries, each in its recommended use.

numba: equations written by hand in absolute angles, with a dense M; the loop is also compiled.
MuJoCo: `mj_step` with RK4 and its loop in C, relative joint angles, contacts and constraints off;
a step consists of four evaluations and the integration. Pinocchio: articulated-body algorithm,
relative joint angles, one call from Python per evaluation, with an overhead of about 1 us. A
library that cannot be imported is left out.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from bench._problems.scenes import Scene
from bench.lowering._rk4 import STAGES, STEP

Vector = np.ndarray
MODULES = {"numba": "numba", "MuJoCo": "mujoco", "Pinocchio": "pinocchio"}


class Library(NamedTuple):
    """Forward dynamics of one chain.

    Attributes:
        acceleration: of the absolute angles, from absolute angles and rates.
        call: runs many evaluations.
        evaluations: their number.
    """

    acceleration: Callable[[Vector, Vector], Vector]
    call: Callable[[], Any]
    evaluations: int


def libraries(scene: Scene, steps: int) -> dict[str, Library]:
    """The libraries that can be imported, to be timed over this number of steps."""
    absent = missing()
    return {name: make(scene, steps) for name, make in MAKERS.items() if name not in absent}


def missing() -> list[str]:
    """The libraries that cannot be imported."""
    return [name for name, module in MODULES.items() if not _imports(module)]


def _imports(module: str) -> bool:
    try:
        import_module(module)
    except ImportError:
        return False
    return True


def by_numba(scene: Scene, steps: int) -> Library:
    """M_ij = A_ij cos(q_i - q_j), A_ij = l_i l_j times the sum of the masses from max(i, j) on."""
    m, rods, g, q0, v0 = _numbers(scene)
    carried = np.cumsum(m[::-1])[::-1]
    A = np.outer(rods, rods) * carried[np.maximum.outer(np.arange(rods.size), np.arange(rods.size))]
    gravity = carried * g * rods
    evaluate, run = _compiled()

    def acceleration(q: Vector, v: Vector) -> Vector:
        a = np.empty_like(q)
        evaluate(q, v, A, gravity, a, *_scratch(q.size))
        return a

    return Library(acceleration, lambda: run(q0, v0, A, gravity, STEP, steps), STAGES * steps)


def _scratch(n: int) -> tuple[Vector, Vector, Vector, Vector]:
    return np.empty(n), np.empty(n), np.empty(n), np.empty((n, n))


_functions: list[Callable] = []


def _compiled() -> list[Callable]:
    if _functions:
        return _functions
    njit = import_module("numba").njit

    @njit
    def evaluate(q, v, A, gravity, a, s, c, w, L):
        n = q.size
        for i in range(n):
            s[i], c[i], w[i] = np.sin(q[i]), np.cos(q[i]), v[i] * v[i]
            a[i] = -gravity[i] * s[i]
        for i in range(n):
            L[i, i] = A[i, i]
            for j in range(i):
                L[i, j] = A[i, j] * (c[i] * c[j] + s[i] * s[j])
                coupling = A[i, j] * (s[i] * c[j] - c[i] * s[j])
                a[i] -= coupling * w[j]
                a[j] += coupling * w[i]
        for i in range(n):  # Cholesky, row by row; 1 / L_ii in place of L_ii
            for j in range(i):
                x = L[i, j]
                for k in range(j):
                    x -= L[i, k] * L[j, k]
                L[i, j] = x * L[j, j]
            x = L[i, i]
            for k in range(i):
                x -= L[i, k] * L[i, k]
            L[i, i] = 1.0 / np.sqrt(x)
            x = a[i]
            for k in range(i):
                x -= L[i, k] * a[k]
            a[i] = x * L[i, i]
        for i in range(n - 1, -1, -1):
            a[i] *= L[i, i]
            for k in range(i):
                a[k] -= L[i, k] * a[i]

    @njit
    def run(q0, v0, A, gravity, h, count):
        n = q0.size
        q, v, x, y = q0.copy(), v0.copy(), np.empty(n), np.empty(n)
        a, dq, dv = np.empty(n), np.empty(n), np.empty(n)
        s, c, w, L = np.empty(n), np.empty(n), np.empty(n), np.empty((n, n))
        for _ in range(count):
            x[:], y[:] = q, v
            dq[:], dv[:] = 0.0, 0.0
            for stage in range(4):
                evaluate(x, y, A, gravity, a, s, c, w, L)
                weight = h / 3.0 if 0 < stage < 3 else h / 6.0
                ahead = h if stage == 2 else h / 2.0
                for i in range(n):
                    dq[i] += weight * y[i]
                    dv[i] += weight * a[i]
                    x[i] = q[i] + ahead * y[i]
                    y[i] = v[i] + ahead * a[i]
            q += dq
            v += dv
        return q, v

    _functions.extend([evaluate, run])
    return _functions


def by_mujoco(scene: Scene, steps: int) -> Library:
    """Hinges about -y; each body is a mass at the end of its link, with negligible inertia."""
    mujoco: Any = import_module("mujoco")
    m, rods, g, q0, v0 = _numbers(scene)
    inner = ""
    for i in reversed(range(m.size)):
        z = 0.0 if i == 0 else -rods[i - 1]
        inner = (
            f'<body pos="0 0 {z}"><joint type="hinge" axis="0 -1 0"/>'
            f'<inertial pos="0 0 {-rods[i]}" mass="{m[i]}" diaginertia="1e-12 1e-12 1e-12"/>'
            f"{inner}</body>"
        )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option integrator="RK4" timestep="{STEP}" gravity="0 0 {-g}">'
        '<flag contact="disable" constraint="disable" energy="disable"/></option>'
        f"<worldbody>{inner}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)

    def put(q: Vector, v: Vector) -> None:
        data.qpos[:], data.qvel[:] = _relative(q), _relative(v)

    def acceleration(q: Vector, v: Vector) -> Vector:
        put(q, v)
        mujoco.mj_forward(model, data)
        return np.cumsum(data.qacc)

    def call() -> None:
        put(q0, v0)
        mujoco.mj_step(model, data, nstep=steps)

    return Library(acceleration, call, STAGES * steps)


def by_pinocchio(scene: Scene, steps: int) -> Library:
    """Joints about y, so that joint angles have the opposite sign; the bodies are point masses."""
    pin: Any = import_module("pinocchio")
    m, rods, g, q0, v0 = _numbers(scene)
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -g])
    joint = 0
    for i in range(m.size):
        down = np.array([0.0, 0.0, 0.0 if i == 0 else -rods[i - 1]])
        joint = model.addJoint(joint, pin.JointModelRY(), pin.SE3(np.eye(3), down), f"joint{i}")
        body = pin.Inertia(m[i], np.array([0.0, 0.0, -rods[i]]), np.zeros((3, 3)))
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    data, aba, free = model.createData(), pin.aba, np.zeros(m.size)

    def acceleration(q: Vector, v: Vector) -> Vector:
        return -np.cumsum(aba(model, data, -_relative(q), -_relative(v), free))

    q, v = -_relative(q0), -_relative(v0)

    def call() -> None:
        for _ in range(STAGES * steps):
            aba(model, data, q, v, free)

    return Library(acceleration, call, STAGES * steps)


def _numbers(scene: Scene) -> tuple[Vector, Vector, float, Vector, Vector]:
    m, rods = (np.asarray(scene.params[name], float) for name in "ml")
    return m, rods, float(scene.params["g"]), np.array(scene.q0, float), np.array(scene.v0, float)


def _relative(x: Vector) -> Vector:
    return np.diff(x, prepend=0.0)


MAKERS: dict[str, Callable[[Scene, int], Library]] = {
    "numba": by_numba,
    "MuJoCo": by_mujoco,
    "Pinocchio": by_pinocchio,
}
