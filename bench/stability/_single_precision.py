"""Cases in float32, with eps = 1.2e-7 and default tolerances of 1e-5 and 1e-6."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._cases import Cases, Found, difference, energy_change, names, run
from bench.stability._drifts import FIGURE, Length, drift, long_run, most
from bench.stability._long_runs import ARMS, BOBS
from bench.stability._reference_motions import double_pendulum
from bench.stability._singular_states import G

EPS = float(np.finfo(np.float32).eps)
START, TIME = np.array([1.0, 0.5], np.float32), np.array([0.0, 3.0])
AT_REST = np.zeros(2, np.float32)
LENGTH = Length(50_000, 2_500, 20)

cases = Cases()


def single(motion: jl.Solution, found: Found) -> Found:
    """`found` if the motion is in float32, otherwise a failed case."""
    return found if motion.q.dtype == jnp.float32 else found._replace(figure=np.inf)


# 1e-5 per step in float32, with an energy of some 10 J, over some hundred steps.
@cases.add("float32: energy of two pendulums", "change of H over g", 1e-3)
def energy(quick: bool) -> Found:
    pair = jl.System(
        lambda t, q, v, p: 0.5 * (v @ v) + np.float32(G) * jnp.sum(jnp.cos(q)), ("a", "b")
    )
    motion = run(pair, START, AT_REST, np.linspace(0.0, 10.0, 11), {})
    return single(motion, energy_change(motion, G))


# A tenth of 1.1e-5 per step, squares of 30 steps added, growth 1.4: 8e-6. Rounding errors are a
# tenth of that.
@cases.add("float32: double pendulum", "error of q, rad", 1e-5)
def double(quick: bool) -> Found:
    motion = run(ARMS, START, AT_REST, TIME, {})
    return single(motion, difference(motion, double_pendulum(START.astype(float), TIME[-1])[0]))


def points(angles: Any) -> Any:
    """Bobs of a double pendulum."""
    x, y = np.sin(angles), -np.cos(angles)
    return np.array([x[0], y[0], x[0] + x[1], y[0] + y[1]])


# The same; the position of the lower bob depends on both angles.
@cases.add("float32: bobs on rods", "error of q, m", 2e-5)
def bobs(quick: bool) -> Found:
    expected = points(double_pendulum(START.astype(float), TIME[-1])[0])
    motion = run(BOBS, points(START).astype(np.float32), np.zeros(4, np.float32), TIME, {})
    return single(motion, difference(motion, expected))


# Rounding errors of |q|^2 = 4, independent of the number of steps.
@cases.add("float32: constraints after many steps", "residual over |q|^2", 16 * EPS)
def residual(quick: bool) -> Found:
    start, steps = np.array([0.6, -0.8, 1.6, -0.8], np.float32), 5_000
    options: dict[str, Any] = {"method": "dopri5", "dt": 0.01, "max_steps": 2 * steps}
    motion = run(BOBS, start, np.zeros(4, np.float32), [0.0, 0.01 * steps], {}, **options)
    phi = BOBS._terms.position(motion.ts[-1], motion.q[-1].astype(float), {})
    return single(motion, Found(float(jnp.max(jnp.abs(phi)) / 4.0), names(motion.status)))


# The bounds of the runs in float64, in units of float32's eps.
def _add_drift(method: str) -> None:
    name = f"float32: energy over {LENGTH.steps} steps, {method}"

    @cases.add(name, FIGURE, most(method, LENGTH))
    def energies(quick: bool) -> Found:
        motions = long_run(method, LENGTH, np.float32)
        return drift(motions.energy, motions.every, motions.statuses, EPS)


for _method in ("splitting4", "gauss4", "variational2"):
    _add_drift(_method)


# An error of q, 1e-5, changes the derivative by this error times w t, at most 20.
@cases.add("float32: gradient by the start", "relative error", 2e-4)
def gradient(quick: bool) -> Found:
    def last(angle: Array) -> tuple[Array, jl.Solution]:
        motion = run(ARMS, jnp.stack([jnp.asarray(START[0]), angle]), AT_REST, TIME, {})
        return motion.q[-1, 1], motion

    slope, motion = jax.grad(last, has_aux=True)(jnp.asarray(START[1]))
    expected = double_pendulum(START.astype(float), TIME[-1], along=(0.0, 1.0))[1][1]
    error = abs(float(slope) - expected) / (1.0 + abs(expected))
    return single(motion, Found(error, names(motion.status)))
