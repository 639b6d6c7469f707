"""Unequal masses, gimbal lock, poles, folded linkages: difficult states with known solutions."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._cases import (
    TIGHT,
    Cases,
    Found,
    difference,
    energy_change,
    must_end,
    names,
    run,
)
from bench.stability._long_runs import ARMS, BOBS, ORBIT, kepler
from bench.stability._reference_motions import double_pendulum
from systems import four_bar, rigid_aircraft, spherical_pendulum_cartesian, spherical_pendulum_fixed

EPS = np.finfo(float).eps
G = 9.81
LOCK = ("mass_singular", "kinematics_singular", "nonfinite", "step_below_resolution", "max_steps")

cases = Cases()


# ---- Unstable, unequal, stiff ------------------------------------------------------------------


# Errors of 1e-12 per step grow with t and, by the period, with (1 - e)^-2: 1e-12 * 60 * 1e4.
@cases.add("Kepler, e = 0.99", "error of q", 1e-6)
def eccentric(quick: bool) -> Found:
    e, revolutions = 0.99, 2 if quick else 10
    q0, v0 = np.array([1 - e, 0.0]), np.array([0.0, np.sqrt((1 + e) / (1 - e))])
    t = np.array([0.0, revolutions * 2 * np.pi + 2.0])
    exact = kepler(q0[None], v0[None], np.array([e]), t)[0, -1]
    return difference(run(ORBIT, q0, v0, t, {}, **TIGHT), exact)


# The linearized solution. The cubic terms are of 1e-9; the rounding error of pi is 1e-16, that is
# 1e-7 of the deviation.
@cases.add("falling from upright, 1e-9 rad", "error over the deviation", 1e-5)
def upright(quick: bool) -> Found:
    M, K = np.array([[2.0, 1.0], [1.0, 1.0]]), -G * np.array([[2.0, 0.0], [0.0, 1.0]])
    values, modes = np.linalg.eig(np.linalg.solve(M, -K))
    start, t = 1e-9 * np.array([1.0, -0.5]), 1.2
    exact = modes @ (np.cosh(np.sqrt(values) * t) * np.linalg.solve(modes, start))
    motion = run(ARMS, np.pi + start, [0.0, 0.0], [0.0, t], {}, rtol=1e-13, atol=1e-16)
    return difference(motion, np.pi + exact, float(np.max(np.abs(exact))))


def unequal(t: Any, q: Array, v: Array, params: Any) -> Array:
    """Double pendulum with the second mass m."""
    m, c = params["m"], jnp.cos(q[0] - q[1])
    T = 0.5 * (1 + m) * v[0] ** 2 + 0.5 * m * v[1] ** 2 + m * v[0] * v[1] * c
    return T + G * ((1 + m) * jnp.cos(q[0]) + m * jnp.cos(q[1]))


UNEQUAL = jl.System(unequal, ("a", "b"))


# The error of a step of order 8 is at most a tenth of its estimate, 1e-9. The squares of these
# errors add up, and the errors grow as perturbations of the start do. Light bob: 70 steps, growth
# 110, 1e-10 * sqrt(70) * 110. Heavy bob, with a tension of 1e8 times the weight of the upper bob:
# 950 steps, growth 5, 1e-10 * sqrt(950) * 5.
@cases.add("masses 1 : 1e-8, both bobs", "error of q, rad", 1e-7)
def light_end(quick: bool) -> Found:
    start, t, m = [1.0, 0.5], 5.0, 1e-8
    return difference(
        run(UNEQUAL, start, [0.0, 0.0], [0.0, t], {"m": m}), double_pendulum(start, t, m)[0]
    )


@cases.add("masses 1 : 1e8, both bobs", "error of q, rad", 2e-8)
def heavy_end(quick: bool) -> Found:
    start, t, m = [1.0, 0.5], 1.0, 1e8
    return difference(
        run(UNEQUAL, start, [0.0, 0.0], [0.0, t], {"m": m}), double_pendulum(start, t, m)[0]
    )


# 1e-9 of 1e8 g per step, over 2000 steps.
@cases.add("masses 1 : 1e8, energy", "change of H over that of the large mass", 2e-6)
def heavy_energy(quick: bool) -> Found:
    ts = np.linspace(0.0, 2.0, 21)
    return energy_change(run(UNEQUAL, [1.0, 0.5], [0.0, 0.0], ts, {"m": 1e8}), 1e8 * G)


def springs(t: Any, q: Array, v: Array, params: Any) -> Array:
    """Masses of 1 kg on springs."""
    return 0.5 * (v @ v) - 0.5 * (params["k"] @ q**2)


# A thousand periods of the stiff spring, ten steps each with 1e-9.
@cases.add("springs over 12 decades", "error of q", 1e-5)
def decades(quick: bool) -> Found:
    k, t = np.array([1e-6, 1.0, 1e6]), 2 * np.pi
    system = jl.System(springs, ("a", "b", "c"))
    motion = run(system, [1.0] * 3, [0.0] * 3, [0.0, t], {"k": k}, max_steps=100_000)
    return difference(motion, np.cos(np.sqrt(k) * t))


def elastic(t: Any, q: Array, v: Array, params: Any) -> Array:
    """A pendulum on a spring of natural length 1 m."""
    stretch = jl.math.norm(q) - 1.0
    return 0.5 * (v @ v) - 9.81 * q[1] - 0.5 * params["k"] * stretch**2


# Explicit steps resolve the spring's vibration; implicit steps of order 5 have 1e-8 per step.
@cases.add("stiff spring, implicit steps", "difference from explicit steps, m", 1e-4)
def stiff(quick: bool) -> Found:
    system, start = jl.System(elastic, ("x", "y")), ([1.0, 0.0], [0.0, 0.0])
    t, params = [0.0, 0.5 if quick else 2.0], {"k": 1e6}
    explicit = run(system, *start, t, params, max_steps=100_000, **TIGHT)
    options = {"method": "kvaerno5", "rtol": 1e-8, "atol": 1e-8, "max_steps": 100_000}
    return difference(run(system, *start, t, params, **options), explicit.q[-1])


# ---- Singular coordinates ----------------------------------------------------------------------


@cases.add("gimbal lock at the start", "-", 0.0, LOCK)
def locked(quick: bool) -> Found:
    entry = rigid_aircraft.entry
    q0, v0 = [0.0, 0.0, 0.0, 0.1, np.pi / 2, 0.2], [1.0, 0.0, 0.0, 0.1, 0.2, 0.3]
    return must_end(run(entry.system, q0, v0, [0.0, 0.5], entry.example.params))


def spinning(t: Any, q: Array, u: Array, params: Any) -> Array:
    return 0.5 * params["I"] @ u**2


def zero_potential(t: Any, q: Array, params: Any) -> Array:
    return jnp.zeros_like(q[0])


def by_quaternion(t: Any, q: Array, u: Array, params: Any) -> Array:
    return jl.rotation.quaternion.from_body_rates(q, u)


def body_rates(t: Any, q: Array, v: Array, params: Any) -> Array:
    return jl.rotation.yaw_pitch_roll.body_rates(q, v)


RATES = ("wx", "wy", "wz")
QUATERNION = jl.System(
    spinning,
    coordinates={"e": (4,)},
    constraints=(jl.Holonomic(lambda t, q, params: q @ q - 1.0, "unit norm"),),
    quasi=jl.QuasiVelocities(kinematics=by_quaternion, names=RATES),
    written_in="u",
)
ANGLES = jl.System(
    spinning,
    coordinates=("a", "b", "c"),
    quasi=jl.QuasiVelocities(body_rates, RATES),
    written_in="u",
)
INERTIA = np.array([1.0, 2.0, 3.0])


def tumble(system: jl.System, start: Any, w: Any, t: float, **options: Any) -> jl.Solution:
    options = {"throw": False} | (options or {"rtol": 1e-11, "atol": 1e-11})
    return jl.simulate(system, start, None, u0=w, ts=[0.0, t], params={"I": INERTIA}, **options)


def attitude(map_: Any, motion: jl.Solution) -> np.ndarray:
    return np.asarray(map_.matrix(motion.q[-1]))


# A uniform rotation about the pitch axis. Steps may end at gimbal lock or on either side of it. The
# angle is t, so every method is exact with any steps.
@cases.add("through gimbal lock, angles", "error of R", 1e-6, LOCK)
def through_lock(quick: bool) -> Found:
    return pitch_error(tumble(ANGLES, [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 2.0))


# The tenth step ends at gimbal lock, where the rates of the angles are undefined.
@cases.add("a step that ends in gimbal lock, angles", "error of R", 1e-6, LOCK)
def into_lock(quick: bool) -> Found:
    options = {"method": "dopri8", "dt": np.pi / 20}
    return pitch_error(tumble(ANGLES, [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 2.0, **options))


def pitch_error(motion: jl.Solution) -> Found:
    """Compare the attitude with a pitch of 2 rad."""
    exact = np.asarray(jl.rotation.about_y(2.0))
    error = np.max(np.abs(attitude(jl.rotation.yaw_pitch_roll, motion) - exact))
    return Found(float(error), names(motion.status))


# The angles change by pi within 1e-3 s: rates of 1e3 rad/s, errors of 1e-11 times that.
@cases.add("past gimbal lock by 1e-3 rad, angles", "difference from quaternions", 1e-7)
def past_lock(quick: bool) -> Found:
    w = [1e-3, 1.0, 1e-3]
    by_angles = tumble(ANGLES, [0.0, 0.0, 0.0], w, 2.0)
    straight = tumble(QUATERNION, [1.0, 0.0, 0.0, 0.0], w, 2.0)
    one = attitude(jl.rotation.yaw_pitch_roll, by_angles)
    other = attitude(jl.rotation.quaternion, straight)
    error = float(np.max(np.abs(one - other)))
    return Found(error, names(by_angles.status) + names(straight.status))


@cases.add("through gimbal lock, quaternions", "error of R", 1e-9)
def quaternions(quick: bool) -> Found:
    motion = tumble(QUATERNION, [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0], np.pi)
    error = np.abs(attitude(jl.rotation.quaternion, motion) - np.diag([-1.0, 1.0, -1.0]))
    return Found(float(np.max(error)), names(motion.status))


@cases.add("spherical pendulum through its pole, angles", "error of q, rad", 1e-6, LOCK)
def pole(quick: bool) -> Found:
    """Motion in a plane, as of a plane pendulum: from 1 rad to the other side."""
    entry = spherical_pendulum_fixed.entry
    params = entry.example.params
    plane = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 + p["g"] / p["L"] * jnp.cos(q[0]), ("phi",)
    )
    expected = run(plane, [1.0], [0.0], [0.0, 1.0], params, **TIGHT).q[-1]
    motion = run(entry.system, [0.3, 1.0], [0.0, 0.0], [0.0, 1.0], params)
    return difference(motion, jnp.concatenate([jnp.array([0.3]), expected]))


# 1e-9 per step; the azimuth changes by pi within 1e-6 s near the pole.
@cases.add("spherical pendulum past its pole, angles", "change of H, J", 1e-5)
def past_pole(quick: bool) -> Found:
    entry = spherical_pendulum_fixed.entry
    ts = np.linspace(0.0, 2.0, 41)
    return energy_change(run(entry.system, [0.3, 1.0], [1e-4, 0.0], ts, entry.example.params), 1.0)


@cases.add("spherical pendulum through its pole, Cartesian", "error of x, m", 1e-6)
def pole_cartesian(quick: bool) -> Found:
    """Released at (0.96, 0, -0.28), it is below the pivot after a quarter of the period."""
    entry = spherical_pendulum_cartesian.entry
    params = entry.example.params
    angle = np.arctan2(0.96, 0.28)
    from_rest = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 + p["g"] / p["L"] * jnp.cos(q[0]), ("phi",)
    )
    end = run(from_rest, [angle], [0.0], [0.0, 1.3], params, **TIGHT).q[-1, 0]
    motion = run(entry.system, [0.96, 0.0, -0.28], [0.0] * 3, [0.0, 1.3], params)
    return difference(motion, jnp.stack([jnp.sin(end), 0.0 * end, -jnp.cos(end)]))


# ---- Constraints -------------------------------------------------------------------------------


@cases.add("straight chain let go, Cartesian", "difference from angles, m", 1e-6)
def taut(quick: bool) -> Found:
    """Both bobs on a horizontal line with the pivot: the constraint rows are partly parallel."""
    angles = run(ARMS, [np.pi / 2] * 2, [0.0, 0.0], [0.0, 1.0], {}, **TIGHT).q[-1]
    x, y = np.sin(angles), -np.cos(angles)
    motion = run(BOBS, [1.0, 0.0, 2.0, 0.0], [0.0] * 4, [0.0, 1.0], {})
    return difference(motion, [x[0], y[0], x[0] + x[1], y[0] + y[1]])


@cases.add("chain hanging at rest", "displacement, m", 1e-12)
def hanging(quick: bool) -> Found:
    q0 = [0.0, -1.0, 0.0, -2.0]
    return difference(run(BOBS, q0, [0.0] * 4, [0.0, 100.0], {}), q0)


def particle(t: Any, q: Array, v: Array, params: Any) -> Array:
    return 0.5 * (v @ v) - G * q[1]


def rod(t: Any, q: Array, params: Any) -> Array:
    return q @ q - 1.0


@cases.add("a rod declared twice", "difference from once, m", 1e-8)
def twice(quick: bool) -> Found:
    start = [0.6, -0.8], [0.8, 0.6]
    once = (jl.Holonomic(rod, "rod"),)
    both = (*once, jl.Holonomic(rod, "again"))
    systems = [jl.System(particle, ("x", "y"), constraints=c) for c in (once, both)]
    single, double = (run(system, *start, [0.0, 5.0], {}) for system in systems)
    return difference(double, single.q[-1])


@cases.add("rows that contradict each other", "-", 0.0, ("contradictory_rows", "rank_change"))
def contradictory(quick: bool) -> Found:
    """x = 0 and x = t^2 / 2 agree in position and velocity at t = 0, but not in acceleration."""
    held = jl.Holonomic(lambda t, q, p: q[0], "held")
    drawn = jl.Holonomic(lambda t, q, p: q[0] - 0.5 * t**2, "drawn")
    system = jl.System(particle, ("x", "y"), constraints=(held, drawn))
    return must_end(run(system, [0.0, 0.0], [0.0, 0.0], [0.0, 1.0], {}))


@cases.add("parallelogram through its folded position", "change of H, J", 1e-6)
def folded(quick: bool) -> Found:
    """All links on one line, a bifurcation of the mechanism, with a save time near it."""
    entry = four_bar.entry
    params = dict(entry.example.params) | {"a": 0.5, "b": 1.0, "c": 0.5, "d": 1.0, "g": 0.0}
    crank = 2.0
    q0 = [crank, 0.0, crank - np.pi]
    motion = run(entry.system, q0, [-1.0, 0.0, -1.0], np.linspace(0.0, 4.0, 81), params)
    return energy_change(motion, 1.0)


# Rounding errors of |q|^2 = 4 in one step, independent of the number of steps.
@cases.add("constraints after many steps", "residual over |q|^2", 16 * EPS)
def residual(quick: bool) -> Found:
    steps = 5_000 if quick else 100_000
    motion = run(
        BOBS,
        [0.6, -0.8, 1.6, -0.8],
        [0.0] * 4,
        [0.0, 0.01 * steps],
        {},
        method="dopri8",
        dt=0.01,
        max_steps=2 * steps,
    )
    phi = BOBS._terms.position(motion.ts[-1], motion.q[-1], {})
    return Found(float(jnp.max(jnp.abs(phi)) / 4.0), names(motion.status))
