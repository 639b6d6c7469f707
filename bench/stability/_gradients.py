"""Gradients for the cases of `stability`, with the statuses of their motions.

Expected derivatives are closed forms, or complex-step derivatives of equations written by hand.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import expm_frechet

import jaxlag as jl
from bench.stability._cases import TIGHT, Cases, Found, names, run
from bench.stability._extremes import DRIVEN, PUSHED, SPRING, response, tied
from bench.stability._long_runs import ARMS, BOBS, ORBIT
from bench.stability._reference_motions import double_pendulum
from bench.stability._singular_states import ANGLES, QUATERNION, UNEQUAL, G, rod, springs
from systems import spherical_pendulum_cartesian

EPS = float(np.finfo(float).eps)
Motion = Callable[[Any], tuple[Array, jl.Solution]]

cases = Cases()


def reverse(last: Motion, x: Any) -> tuple[Any, tuple[str, ...]]:
    """(gradient of a number at the end of a motion, status of the motion)."""
    slope, motion = jax.grad(last, has_aux=True)(x)
    return jax.tree.map(np.asarray, slope), names(motion.status)


def forward(last: Motion, x: Any, along: Any) -> tuple[np.ndarray, tuple[str, ...]]:
    """(derivative of numbers at the end of a motion along a change, status of the motion)."""
    _, slope, motion = jax.jvp(last, (jnp.asarray(x),), (jnp.asarray(along),), has_aux=True)
    return np.asarray(slope), names(motion.status)


def off(slope: Any, expected: Any, statuses: tuple[str, ...]) -> Found:
    """The largest difference, divided by 1 + the largest expected number."""
    slope, expected = np.asarray(slope), np.asarray(expected)
    size = 1.0 + float(np.max(np.abs(expected)))
    return Found(float(np.max(np.abs(slope - expected))) / size, statuses, f"size {size:.3g}")


def against_differences(last: Motion, x: float, h: float) -> Found:
    """A reverse derivative compared with an extrapolated central difference."""

    def central(h: float) -> float:
        return float(last(x + h)[0] - last(x - h)[0]) / (2 * h)

    slope, statuses = reverse(last, x)
    return off(slope, (4 * central(h / 2) - central(h)) / 3, statuses)


# ---- Unstable, unequal, stiff ------------------------------------------------------------------


# At a pericenter v is 14 and its derivative by e is 700. An error of a tenth of 1e-12 of it per
# step changes the derivative of the energy, v dv, by 1e-9, and that of the phase by 3/2 t = 100
# times as much. The squares of ten such errors add up.
@cases.add("gradient of Kepler, e = 0.99", "relative error", 5e-7)
def eccentric(quick: bool) -> Found:
    e0, t = 0.99, (2 if quick else 10) * 2 * np.pi + 2.0

    def last(e: Any) -> tuple[Array, jl.Solution]:
        q0 = jnp.stack([1.0 - e, 0.0 * e])
        v0 = jnp.stack([0.0 * e, jnp.sqrt((1.0 + e) / (1.0 - e))])
        motion = run(ORBIT, q0, v0, [0.0, t], {}, **TIGHT)
        return jnp.sum(motion.q[-1]), motion

    E = 2.0  # E - e sin E = t
    for _ in range(50):
        E -= (E - e0 * np.sin(E) - 2.0) / (1.0 - e0 * np.cos(E))
    moved = np.sin(E) / (1.0 - e0 * np.cos(E))
    across = np.sqrt(1.0 - e0**2)
    expected = -np.sin(E) * moved - 1.0 - e0 / across * np.sin(E) + across * np.cos(E) * moved
    slope, statuses = reverse(last, e0)
    return off(slope, expected, statuses)


def unequal(t: float, mass: float, **options: Any) -> Found:
    """Derivative by the initial angle of the lower bob."""

    def last(q0: Any) -> tuple[Array, jl.Solution]:
        motion = run(UNEQUAL, q0, [0.0, 0.0], [0.0, t], {"m": mass}, **options)
        return motion.q[-1], motion

    start, along = [1.0, 0.5], (0.0, 1.0)
    slope, statuses = forward(last, start, along)
    return off(slope, double_pendulum(start, t, mass, along)[1], statuses)


# A tenth of 1e-12 per step, squares of 100 steps added, growth 110: the error of the state is
# 1e-10, and the relative error of its derivative is about the same.
@cases.add("gradient of masses 1 : 1e-8", "relative error", 2e-10)
def light_end(quick: bool) -> Found:
    return unequal(5.0, 1e-8, **TIGHT)


# A tenth of 1e-9 per step, squares of 20 steps added, growth 5: 2e-9. Within 1e-2 rad of the
# straight position rates double, and so do derivatives: a hundred times that.
@cases.add("gradient of masses 1 : 1e8, rods not yet straight", "relative error", 2e-7)
def heavy_end(quick: bool) -> Found:
    return unequal(0.13, 1e8)


# The light bob passes the straight line in 1e-4 s. The error of q is a tenth of 1e-9, that of its
# first derivative 1e4 times that, that of its second 1e8 times that.
@cases.add("gradient of masses 1 : 1e8, past the straight line", "relative error", 1e-2)
def thrown(quick: bool) -> Found:
    return unequal(0.14, 1e8)


# The derivative of cos(w t) by ln k is -w t / 2 sin(w t), 3000 for the stiff spring. The error of
# the phase after a thousand periods is 1e-5, that of its derivative by ln k is half of that times w
# t.
@cases.add("gradient of springs over 12 decades", "relative error", 1e-5)
def decades(quick: bool) -> Found:
    k, t = np.array([1e-6, 1.0, 1e6]), 6.0
    system = jl.System(springs, ("a", "b", "c"))

    def last(logs: Array) -> tuple[Array, jl.Solution]:
        options = {"max_steps": 100_000}
        motion = run(system, [1.0] * 3, [0.0] * 3, [0.0, t], {"k": jnp.exp(logs)}, **options)
        return jnp.sum(motion.q[-1]), motion

    w = np.sqrt(k)
    slope, statuses = reverse(last, jnp.log(k))
    expected = -0.5 * w * t * np.sin(w * t)
    return off(slope / (1.0 + np.abs(expected)), expected / (1.0 + np.abs(expected)), statuses)


# ---- Singular coordinates ----------------------------------------------------------------------


def turning(system: jl.System, start: Any, rates: Any, map_: Any) -> Found:
    """Derivative of a ball's attitude by its second rate: that of the matrix exponential."""
    t = 2.0

    def last(w: Any) -> tuple[Array, jl.Solution]:
        options = {"rtol": 1e-11, "atol": 1e-11, "throw": False}
        ball = {"I": np.ones(3)}
        motion = jl.simulate(system, start, None, u0=w, ts=[0.0, t], params=ball, **options)
        return map_.matrix(motion.q[-1]), motion

    def cross(w: Any) -> np.ndarray:
        x, y, z = w
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])

    along = np.array([0.0, 1.0, 0.0])
    expected = expm_frechet(t * cross(rates), t * cross(along), compute_expm=False)
    slope, statuses = forward(last, rates, along)
    return off(slope, expected, statuses)


# The angles change by pi within 1e-3 s: rates of 1e3 rad/s, derivatives of the rates 1e6, errors a
# tenth of 1e-11.
@cases.add("gradient past gimbal lock by 1e-3 rad, angles", "error of dR", 1e-6)
def past_lock(quick: bool) -> Found:
    return turning(ANGLES, [0.0] * 3, np.array([1e-3, 1.0, 1e-3]), jl.rotation.yaw_pitch_roll)


# 1e-11 per step over some dozen steps.
@cases.add("gradient through gimbal lock, quaternions", "error of dR", 1e-9)
def quaternions(quick: bool) -> Found:
    identity = [1.0, 0.0, 0.0, 0.0]
    return turning(QUATERNION, identity, np.array([0.0, 1.0, 0.0]), jl.rotation.quaternion)


# Errors of the difference, h^4 and 1e-12 / h: 1e-8 each.
@cases.add("gradient through the pole, Cartesian", "relative error", 1e-6)
def pole(quick: bool) -> Found:
    entry = spherical_pendulum_cartesian.entry
    params = entry.example.params

    def last(g: Any) -> tuple[Array, jl.Solution]:
        start = [0.96, 0.0, -0.28], [0.0] * 3
        motion = run(entry.system, *start, [0.0, 1.3], {**params, "g": g}, **TIGHT)
        return motion.q[-1, 0], motion

    return against_differences(last, 9.81, 1e-2)


# ---- Constraints -------------------------------------------------------------------------------


# 1e-9 per step over some dozen steps, growth 5, and the same again for the derivatives.
@cases.add("gradient of a straight chain, Cartesian", "relative error", 1e-6)
def taut(quick: bool) -> Found:
    """Derivative of the lower bob of a horizontal chain by the initial angle of both links."""
    t = 1.0

    def last(angle: Any) -> tuple[Array, jl.Solution]:
        x, y = jnp.sin(angle), -jnp.cos(angle)
        motion = run(BOBS, jnp.stack([x, y, 2 * x, 2 * y]), [0.0] * 4, [0.0, t], {})
        return motion.q[-1, 2], motion

    angles, moved = double_pendulum([np.pi / 2] * 2, t, 1.0, (1.0, 1.0))
    slope, statuses = reverse(last, np.pi / 2)
    return off(slope, np.cos(angles) @ moved, statuses)


@cases.add("gradient with a rod declared twice", "relative error", 1e-6)
def twice(quick: bool) -> Found:
    both = (jl.Holonomic(rod, "rod"), jl.Holonomic(rod, "again"))

    def weighted(t: Any, q: Array, v: Array, params: Any) -> Array:
        return 0.5 * (v @ v) - params * q[1]

    system = jl.System(weighted, ("x", "y"), constraints=both)

    def last(g: Any) -> tuple[Array, jl.Solution]:
        motion = run(system, [0.6, -0.8], [0.8, 0.6], [0.0, 1.0], g, **TIGHT)
        return motion.q[-1, 0], motion

    return against_differences(last, 9.81, 1e-2)


# ---- Time, numbers, rest -----------------------------------------------------------------------


# The derivative of the force by w has rounding errors of 6e-8 (1 + w t) instead of the force's
# 8e-8: 6 times as much.
@cases.add("gradient at t0 = 1e9 s", "relative error", 2.4e-7)
def late(quick: bool) -> Found:
    t0, w0, t = 1e9, 1.3, 5.0

    def last(w: Any) -> tuple[Array, jl.Solution]:
        motion = run(DRIVEN, [1.0], [0.0], [t0, t0 + t], {"w": w, "t0": t0})
        return motion.q[-1, 0], motion

    slope, statuses = reverse(last, w0)
    return off(slope, jax.grad(response)(w0, t), statuses)


# Parabolas between knots: every step is exact.
@cases.add("gradient of a force that jumps", "relative error", 100 * EPS)
def jumps(quick: bool) -> Found:
    """Derivative of x(1) by the times of the jumps, and by the values of the force."""
    knots, f = np.array([0.0, 0.3, 0.7, 1.0]), np.array([1.0, -2.0, 3.0, 0.0])

    def last(table: Any) -> tuple[Array, jl.Solution]:
        held = {"f": jl.ZeroOrderHold(*table)}
        motion = run(PUSHED, [0.0], [0.0], [0.0, 1.0], {"m": 1.0, "k": 0.0}, inputs=held)
        return motion.q[-1, 0], motion

    (by_knots, by_values), statuses = reverse(last, (jnp.asarray(knots), jnp.asarray(f)))
    h, left = np.diff(knots), 1.0 - knots
    when = (f[:2] - f[1:3]) * left[1:3]
    what = h * (left[:-1] - 0.5 * h)
    slope = np.concatenate([by_knots[1:3], by_values[:3]])
    return off(slope, np.concatenate([when, what]), statuses)


# By k: -(x t^2 / 2 + v t^3 / 6); by m: 0. Polynomials of degree 3: every step is exact.
@cases.add("gradient at stiffness 0", "relative error", 100 * EPS)
def no_spring(quick: bool) -> Found:
    def last(params: Any) -> tuple[Array, jl.Solution]:
        motion = run(SPRING, [1.0], [2.0], [0.0, 3.0], params)
        return motion.q[-1, 0], motion

    slope, statuses = reverse(last, {"m": 1.0, "k": 0.0})
    return off([slope["k"], slope["m"]], [-13.5, 0.0], statuses)


# 1e-9 per step over some dozen steps, times t / 2.
@cases.add("gradient at mass and stiffness 1e12", "relative error", 1e-7)
def huge(quick: bool) -> Found:
    t = 5.0

    def last(logs: Any) -> tuple[Array, jl.Solution]:
        params = {"m": jnp.exp(logs["m"]), "k": jnp.exp(logs["k"])}
        motion = run(SPRING, [1.0], [0.0], [0.0, t], params)
        return motion.q[-1, 0], motion

    large = np.log(1e12)
    slope, statuses = reverse(last, {"m": large, "k": large})
    expected = 0.5 * t * np.sin(t)
    return off([slope["m"], slope["k"]], [expected, -expected], statuses)


# The linearized motion about the lowest position, at rest: 1e-9 per step, dozens of steps.
@cases.add("gradient of a double pendulum at rest", "relative error", 1e-7)
def hanging(quick: bool) -> Found:
    t = 5.0

    def last(q0: Any) -> tuple[Array, jl.Solution]:
        motion = run(ARMS, q0, [0.0, 0.0], [0.0, t], {})
        return motion.q[-1] @ jnp.array([1.0, 2.0]), motion

    M, K = np.array([[2.0, 1.0], [1.0, 1.0]]), G * np.array([[2.0, 0.0], [0.0, 1.0]])
    squares, modes = np.linalg.eig(np.linalg.solve(M, K))
    swung = modes @ np.diag(np.cos(np.sqrt(squares) * t)) @ np.linalg.inv(modes)
    slope, statuses = reverse(last, jnp.zeros(2))
    return off(slope, np.array([1.0, 2.0]) @ swung, statuses)


@cases.add("gradient of a start balanced upright", "relative error", 1e-6)
def upright(quick: bool) -> Found:
    """d q(T) / d q0 = cosh(sqrt(g / l) T) at q0 = pi."""
    rigid = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 + G * jnp.cos(q[0]), ("a",))

    def last(angle: Any) -> tuple[Array, jl.Solution]:
        motion = run(rigid, jnp.stack([angle]), [0.0], [0.0, 2.0], {}, **TIGHT)
        return motion.q[-1, 0], motion

    slope, statuses = reverse(last, np.pi)
    return off(slope, np.cosh(np.sqrt(G) * 2.0), statuses)


@cases.add("gradient at rest at zero length", "error", 1e-7)
def zero_length(quick: bool) -> Found:
    """d q(T) / d q0 = cos(T) at the origin, at rest."""
    system = jl.System(tied, ("x", "y"))

    def last(q0: Array) -> tuple[Array, jl.Solution]:
        motion = run(system, q0, [0.0, 0.0], [0.0, 5.0], {"k": 1.0})
        return motion.q[-1], motion

    slope, motion = jax.jacrev(last, has_aux=True)(jnp.zeros(2))
    return off(slope, np.cos(5.0) * np.eye(2), names(motion.status))


# ---- Chaos -------------------------------------------------------------------------------------


# A tenth of 1e-12 per step, squares of 700 steps added, growth 7000: the error of the state is
# 2e-8, and the relative error of its derivative is about the same.
@cases.add("gradient of chaos", "relative error", 2e-8)
def chaos(quick: bool) -> Found:
    t, along = 10.0, (1.0, 0.0)

    def last(q0: Any) -> tuple[Array, jl.Solution]:
        motion = run(ARMS, q0, [0.0, 0.0], [0.0, t], {}, **TIGHT)
        return jnp.sum(motion.q[-1]), motion

    slope, statuses = reverse(last, jnp.array([2.0, 2.0]))
    return off(slope[0], np.sum(double_pendulum([2.0, 2.0], t, 1.0, along)[1]), statuses)
