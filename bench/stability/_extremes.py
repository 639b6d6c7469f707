"""Extremes of time, tolerance and numbers, and problems that cannot be integrated."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._cases import Cases, Found, difference, must_end, run
from bench.stability._long_runs import ARMS, ORBIT, kepler

EPS = np.finfo(float).eps

cases = Cases()


# ---- Time, tolerance, numbers ------------------------------------------------------------------


def driven(t: Any, q: Array, v: Array, params: Any) -> Array:
    """An oscillator driven by the force cos(w (t - t0))."""
    force = jnp.cos(params["w"] * (t - params["t0"]))
    return 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2 + force * q[0]


DRIVEN = jl.System(driven, ("x",))


def response(w: Any, t: Any) -> Any:
    """Its motion from x = 1 at rest."""
    return jnp.cos(t) + (jnp.cos(w * t) - jnp.cos(t)) / (1.0 - w**2)


# Times are multiples of 1.2e-7 s, so the force has rounding errors of up to 8e-8 of its size. Its
# effect on a step of length h, 8e-8 h, is limited to 1e-9: steps of 1/80 s. The squares of 400
# steps add up to 2e-8, and the same again for the tolerance of 1e-9 per step.
@cases.add("t0 = 1e9 s, pushed", "error of x, m", 4e-8)
def late(quick: bool) -> Found:
    t0, w, span = 1e9, 1.3, np.array([0.0, 5.0])
    motion = run(DRIVEN, [1.0], [0.0], t0 + span, {"w": w, "t0": t0})
    return difference(motion, [response(w, 5.0)])


@cases.add("a span of 1e-12 s", "error of q, rad", 4 * EPS)
def short(quick: bool) -> Found:
    motion = run(ARMS, [1.0, 0.5], [0.3, -0.2], [0.0, 1e-12], {})
    return difference(motion, [1.0 + 0.3e-12, 0.5 - 0.2e-12])


# Rounding errors of some thousand steps instead of the tolerance.
@cases.add("tolerance 1e-14", "error of q", 1e-11)
def finest(quick: bool) -> Found:
    q0, v0, t = np.array([0.9, 0.0]), np.array([0.0, np.sqrt(1.1 / 0.9)]), np.array([0.0, 20.0])
    exact = kepler(q0[None], v0[None], np.array([0.1]), t)[0, -1]
    return difference(run(ORBIT, q0, v0, t, {}, rtol=1e-14, atol=1e-14), exact)


def free(t: Any, q: Array, v: Array, params: Any) -> Array:
    return 0.5 * params["m"] * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2


def push(t: Any, q: Array, v: Array, params: Any, inputs: Any) -> Array:
    return jnp.reshape(inputs["f"], (1,))


PUSHED = jl.System(free, ("x",), forces=(jl.GeneralizedForce(push, "push"),))


# Parabolas between knots: every step is exact.
@cases.add("a force that jumps", "error of x, m", 100 * EPS)
def jumps(quick: bool) -> Found:
    knots, f = np.array([0.0, 0.3, 0.7, 1.0]), np.array([1.0, -2.0, 3.0, 0.0])
    held = {"f": jl.ZeroOrderHold(jnp.asarray(knots), jnp.asarray(f))}
    x = v = 0.0
    for h, a in zip(np.diff(knots), f, strict=False):
        x, v = x + h * v + 0.5 * h**2 * a, v + h * a
    motion = run(PUSHED, [0.0], [0.0], [0.0, 1.0], {"m": 1.0, "k": 0.0}, inputs=held)
    return difference(motion, [x])


def tied(t: Any, q: Array, v: Array, params: Any) -> Array:
    """A mass on a spring of zero natural length."""
    return 0.5 * (v @ v) - jl.energy.spring(params["k"], q)


# 1e-9 per step over some dozen steps.
@cases.add("a start at zero length", "error of q, m", 1e-7)
def zero_length(quick: bool) -> Found:
    motion = run(jl.System(tied, ("x", "y")), [0.0, 0.0], [0.3, 0.4], [0.0, 5.0], {"k": 1.0})
    return difference(motion, np.sin(5.0) * np.array([0.3, 0.4]))


SPRING = jl.System(free, ("x",))


@cases.add("at rest at zero length", "displacement, m", 0.0)
def rest(quick: bool) -> Found:
    motion = run(jl.System(tied, ("x", "y")), [0.0, 0.0], [0.0, 0.0], [0.0, 5.0], {"k": 1.0})
    return difference(motion, [0.0, 0.0])


@cases.add("stiffness 0", "error of x, m", 100 * EPS)
def no_spring(quick: bool) -> Found:
    return difference(run(SPRING, [1.0], [2.0], [0.0, 3.0], {"m": 1.0, "k": 0.0}), [7.0])


@cases.add("mass and stiffness 1e12", "error of x, m", 1e-7)
def huge(quick: bool) -> Found:
    motion = run(SPRING, [1.0], [0.0], [0.0, 5.0], {"m": 1e12, "k": 1e12})
    return difference(motion, [np.cos(5.0)])


@cases.add("stiffness 1e12 on 1 kg", "error of x, m", 1e-7)
def hardest(quick: bool) -> Found:
    options = {"rtol": 1e-9, "atol": 1e-9}
    motion = run(SPRING, [1.0], [0.0], [0.0, 5e-6], {"m": 1.0, "k": 1e12}, **options)
    return difference(motion, [np.cos(5.0)])


# ---- Problems that cannot be integrated --------------------------------------------------------


@cases.add("a force that becomes nan", "-", 0.0, ("nonfinite", "step_below_resolution"))
def broken(quick: bool) -> Found:
    force = jl.GeneralizedForce(lambda t, q, v, p: jnp.sqrt(0.5 - q), "broken")
    system = jl.System(free, ("x",), forces=(force,))
    return must_end(run(system, [0.0], [1.0], [0.0, 2.0], {"m": 1.0, "k": 0.0}))


@cases.add("fewer steps than it takes", "-", 0.0, ("max_steps",))
def few(quick: bool) -> Found:
    return must_end(run(ARMS, [1.0, 0.5], [0.0, 0.0], [0.0, 100.0], {}, max_steps=50))


@cases.add("steps too long to be solved, gauss6", "-", 0.0, ("implicit_solve_failed",))
def unsolved(quick: bool) -> Found:
    return must_end(run(ARMS, [2.0, 2.0], [0.0, 0.0], [0.0, 9.0], {}, method="gauss6", dt=3.0))


@cases.add("steps far too long for a stiff spring", "-", 0.0, ("nonfinite", "max_steps"))
def unstable(quick: bool) -> Found:
    """An explicit method with fixed steps of 10 times its stability limit."""
    options: dict[str, Any] = {"method": diffrax.Tsit5(), "dt": 0.03, "max_steps": 10_000}
    return must_end(run(SPRING, [1.0], [0.0], [0.0, 100.0], {"m": 1.0, "k": 1e6}, **options))


@cases.add("a mass that is used up", "-", 0.0, ("mass_singular", "step_below_resolution"))
def used_up(quick: bool) -> Found:
    """M = 1 - t under a constant force."""
    system = jl.System(lambda t, q, v, p: 0.5 * (1.0 - t) * v[0] ** 2 + q[0], ("x",))
    return must_end(run(system, [0.0], [0.0], [0.0, 2.0], {}))


@cases.add("beyond the table of an input", "-", 0.0, ("input_range",))
def out_of_range(quick: bool) -> Found:
    table = {"f": jl.LinearInterpolation(jnp.array([0.0, 1.0]), jnp.array([0.0, 1.0]))}
    solve = jax.jit(lambda t: run(PUSHED, [0.0], [0.0], t, {"m": 1.0, "k": 0.0}, inputs=table))
    return must_end(solve(jnp.array([0.0, 2.0])))
