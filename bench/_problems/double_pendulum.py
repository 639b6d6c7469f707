"""A double pendulum that several benchmarks use, and three ways to solve it.

m = l = 1, g = 9.81, both angles from the downward vertical, q0 = (1, 0.5), at rest, t = 10,
tolerance 1e-9, float64.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from systems.catalogue.chapter3.double_pendulum import kinetic, potential, system

PARAMS = {"m1": 1.0, "m2": 1.0, "h1": 1.0, "h2": 1.0, "g": 9.81}
Q0 = (1.0, 0.5)
DURATION = 10.0
TOLERANCE = 1e-9
TIGHT = 1e-13
MAX_STEPS = 16384

driven = jl.System(
    coordinates=("theta1", "theta2"),
    kinetic=kinetic,
    potential=potential,
    forces=[
        jl.GeneralizedForce(
            lambda t, q, v, params, inputs: jnp.stack([inputs["torque"], jnp.zeros_like(q[0])]),
            "torque on the first string",
        )
    ],
)

Field = Callable[[Any, Array, Any], Array]


class Ended(NamedTuple):
    """States (q, v) after the start, and the number of steps."""

    states: Array  # (s - 1, 4)
    accepted: Array
    rejected: Array


def params() -> dict[str, Array]:
    return {name: jnp.asarray(value) for name, value in PARAMS.items()}


def start() -> Array:
    return jnp.array([*Q0, 0.0, 0.0])


def times(count: int) -> np.ndarray:
    return np.linspace(0.0, DURATION, count)


def by_hand(t: Any, y: Array, params: Any) -> Array:
    """The equations of motion written by hand, M inverted in closed form."""
    m1, m2, h1, h2, g = (params[name] for name in ("m1", "m2", "h1", "h2", "g"))
    theta1, theta2, w1, w2 = y
    sin, cos = jnp.sin(theta1 - theta2), jnp.cos(theta1 - theta2)
    M11, M12, M22 = (m1 + m2) * h1**2, m2 * h1 * h2 * cos, m2 * h2**2
    r1 = -m2 * h1 * h2 * sin * w2**2 - (m1 + m2) * g * h1 * jnp.sin(theta1)
    r2 = m2 * h1 * h2 * sin * w1**2 - m2 * g * h2 * jnp.sin(theta2)
    det = M11 * M22 - M12**2
    return jnp.stack([w1, w2, (M22 * r1 - M12 * r2) / det, (M11 * r2 - M12 * r1) / det])


def naive(t: Any, y: Array, params: Any) -> Array:
    """The equations of motion as in a first prototype: Hessian, Jacobian, library solve."""

    def L(q: Array, v: Array) -> Array:
        return kinetic(t, q, v, params) - potential(t, q, params)

    q, v = y[:2], y[2:]
    M = jax.hessian(L, 1)(q, v)
    p_rate = jax.jacfwd(jax.grad(L, 1), 0)(q, v) @ v
    return jnp.concatenate([v, jnp.linalg.solve(M, jax.grad(L, 0)(q, v) - p_rate)])


def with_jaxlag(ts: Any) -> Callable[[Array, Any, Array], Ended]:
    """`solve(y0, params, tolerance)` by `jl.simulate`."""

    def solve(y0: Array, params: Any, tolerance: Array) -> Ended:
        motion = jl.simulate(
            system, y0[:2], y0[2:], ts, params, rtol=tolerance, atol=tolerance, throw=False
        )
        return ended(motion)

    return solve


def ended(motion: jl.Solution) -> Ended:
    """States and steps of a motion; states not reached are nan."""
    states = jnp.concatenate([motion.q, motion.v], axis=1)[1:]
    return Ended(states, motion.stats["accepted"], motion.stats["rejected"])


def with_diffrax(field: Field, ts: Any, land: bool = False) -> Callable[[Array, Any, Array], Ended]:
    """`solve(y0, params, tolerance)` by diffrax; with `land`, steps end on every time of `ts`."""
    last_only = len(ts) == 2

    def solve(y0: Array, params: Any, tolerance: Array) -> Ended:
        controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            ts[0],
            ts[-1],
            None,
            y0,
            params,
            saveat=diffrax.SaveAt(t1=True) if last_only else diffrax.SaveAt(ts=ts[1:]),
            stepsize_controller=diffrax.ClipStepSizeController(controller, step_ts=jnp.asarray(ts))
            if land
            else controller,
            max_steps=MAX_STEPS,
            throw=False,
        )
        stats = solution.stats
        return Ended(solution.ys, stats["num_accepted_steps"], stats["num_rejected_steps"])

    return solve


def reference(ts: Any) -> Array:
    """States after the start at the tight tolerance, without interpolation."""
    solve = jax.jit(with_diffrax(by_hand, ts, land=True))
    return solve(start(), params(), jnp.asarray(TIGHT)).states
