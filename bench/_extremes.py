"""Extremes of time, tolerance and numbers, gradients, and what cannot be integrated."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import Array

import jaxlag as jl
from bench._long_runs import ARMS, ORBIT, kepler
from bench._places import G, rod
from bench._stress import TIGHT, Found, Rows, difference, energy_change, must_end, names, run
from systems import spherical_pendulum_cartesian

EPS = np.finfo(float).eps

rows = Rows()


# ---- Time, tolerance, numbers ------------------------------------------------------------------


# 1e-5 a step in float32 of an energy of some 10 J, over some hundred steps.
@rows.row("float32", "change of H over g", 1e-3)
def single_precision(quick: bool) -> Found:
    ts = np.linspace(0.0, 10.0, 11)
    start = np.float32([1.0, 0.5]), np.float32([0.0, 0.0])
    single = jl.System(
        lambda t, q, v, p: 0.5 * (v @ v) + np.float32(G) * jnp.sum(jnp.cos(q)), ("a", "b")
    )
    return energy_change(run(single, *start, ts, {}), G)


@rows.row("t0 = 1e9 s", "difference from t0 = 0, rad", 1e-6)
def late(quick: bool) -> Found:
    start, span = ([1.0, 0.5], [0.0, 0.0]), np.array([0.0, 5.0])
    early = run(ARMS, *start, span, {})
    return difference(run(ARMS, *start, 1e9 + span, {}), early.q[-1])


@rows.row("a span of 1e-12 s", "error of q, rad", 4 * EPS)
def short(quick: bool) -> Found:
    motion = run(ARMS, [1.0, 0.5], [0.3, -0.2], [0.0, 1e-12], {})
    return difference(motion, [1.0 + 0.3e-12, 0.5 - 0.2e-12])


# Round-off of some thousand steps instead of the tolerance.
@rows.row("tolerance 1e-14", "error of q", 1e-11)
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
@rows.row("a force that jumps", "error of x, m", 100 * EPS)
def jumps(quick: bool) -> Found:
    knots, f = np.array([0.0, 0.3, 0.7, 1.0]), np.array([1.0, -2.0, 3.0, 0.0])
    held = {"f": jl.ZeroOrderHold(jnp.asarray(knots), jnp.asarray(f))}
    x = v = 0.0
    for h, a in zip(np.diff(knots), f, strict=False):
        x, v = x + h * v + 0.5 * h**2 * a, v + h * a
    motion = run(PUSHED, [0.0], [0.0], [0.0, 1.0], {"m": 1.0, "k": 0.0}, inputs=held)
    return difference(motion, [x])


def tied(t: Any, q: Array, v: Array, params: Any) -> Array:
    """On a spring of no natural length."""
    return 0.5 * (v @ v) - jl.energy.spring(params["k"], q)


# 1e-9 a step over some dozen steps.
@rows.row("a start at zero length", "error of q, m", 1e-7)
def zero_length(quick: bool) -> Found:
    motion = run(jl.System(tied, ("x", "y")), [0.0, 0.0], [0.3, 0.4], [0.0, 5.0], {"k": 1.0})
    return difference(motion, np.sin(5.0) * np.array([0.3, 0.4]))


SPRING = jl.System(free, ("x",))


@rows.row("at rest at zero length", "displacement, m", 0.0)
def rest(quick: bool) -> Found:
    motion = run(jl.System(tied, ("x", "y")), [0.0, 0.0], [0.0, 0.0], [0.0, 5.0], {"k": 1.0})
    return difference(motion, [0.0, 0.0])


@rows.row("stiffness 0", "error of x, m", 100 * EPS)
def no_spring(quick: bool) -> Found:
    return difference(run(SPRING, [1.0], [2.0], [0.0, 3.0], {"m": 1.0, "k": 0.0}), [7.0])


@rows.row("mass and stiffness 1e12", "error of x, m", 1e-7)
def huge(quick: bool) -> Found:
    motion = run(SPRING, [1.0], [0.0], [0.0, 5.0], {"m": 1e12, "k": 1e12})
    return difference(motion, [np.cos(5.0)])


@rows.row("stiffness 1e12 on 1 kg", "error of x, m", 1e-7)
def hardest(quick: bool) -> Found:
    options = {"rtol": 1e-9, "atol": 1e-9}
    motion = run(SPRING, [1.0], [0.0], [0.0, 5e-6], {"m": 1.0, "k": 1e12}, **options)
    return difference(motion, [np.cos(5.0)])


# The tolerance times the growth of a perturbation from anywhere on the way, times ten.
@rows.row("chaos: double pendulum from (2, 2)", "error over tolerance and growth", 10.0)
def chaos(quick: bool) -> Found:
    ts = np.linspace(0.0, 5.0 if quick else 10.0, 51)
    tol = 1e-9
    motion = run(ARMS, [2.0, 2.0], [0.0, 0.0], ts, {}, rtol=tol, atol=tol)
    exact = run(ARMS, [2.0, 2.0], [0.0, 0.0], ts, {}, rtol=3e-14, atol=3e-14)
    kappa = float(jl.grad_growth(motion).kappa[-1])
    error = jnp.abs(motion.q[-1] - exact.q[-1]) / (1.0 + jnp.abs(exact.q[-1]))
    return Found(float(jnp.max(error)) / (tol * kappa), names(motion.status))


# ---- Gradients of the same rows ----------------------------------------------------------------


def against_differences(function: Any, x: float, h: float) -> float:
    """Relative difference of a reverse derivative and an extrapolated central difference."""

    def central(h: float) -> float:
        return float(function(x + h) - function(x - h)) / (2 * h)

    expected = (4 * central(h / 2) - central(h)) / 3
    return abs(float(jax.grad(function)(x)) - expected) / (1.0 + abs(expected))


# h^4 and 1e-12 / h: 1e-8 each.
@rows.row("gradient through the pole, Cartesian", "relative error", 1e-6)
def gradient_pole(quick: bool) -> Found:
    entry = spherical_pendulum_cartesian.entry
    params = entry.example.params

    def last(g: Any) -> Any:
        with_g = {**params, "g": g}
        start = [0.96, 0.0, -0.28], [0.0] * 3
        return run(entry.system, *start, [0.0, 1.3], with_g, **TIGHT).q[-1, 0]

    return Found(against_differences(last, 9.81, 1e-2), ("ok",))


@rows.row("gradient with a rod declared twice", "relative error", 1e-6)
def gradient_twice(quick: bool) -> Found:
    both = (jl.Holonomic(rod, "rod"), jl.Holonomic(rod, "again"))

    def weighted(t: Any, q: Array, v: Array, params: Any) -> Array:
        return 0.5 * (v @ v) - params * q[1]

    system = jl.System(weighted, ("x", "y"), constraints=both)

    def last(g: Any) -> Any:
        return run(system, [0.6, -0.8], [0.8, 0.6], [0.0, 1.0], g, **TIGHT).q[-1, 0]

    return Found(against_differences(last, 9.81, 1e-2), ("ok",))


@rows.row("gradient of a start balanced upright", "relative error", 1e-6)
def gradient_upright(quick: bool) -> Found:
    """d q(T) / d q0 = cosh(sqrt(g / l) T) at q0 = pi."""
    rigid = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 + G * jnp.cos(q[0]), ("a",))
    slope = jax.grad(lambda q: run(rigid, [q], [0.0], [0.0, 2.0], {}, **TIGHT).q[-1, 0])
    expected = np.cosh(np.sqrt(G) * 2.0)
    return Found(abs(float(slope(np.pi)) - expected) / expected, ("ok",))


@rows.row("gradient at zero length", "error", 1e-7)
def gradient_zero_length(quick: bool) -> Found:
    """d q(T) / d q0 = cos(T) at the origin, at rest."""
    system = jl.System(tied, ("x", "y"))

    def last(q0: Array) -> Array:
        return run(system, q0, [0.0, 0.0], [0.0, 5.0], {"k": 1.0}).q[-1]

    slope = jax.jacrev(last)(jnp.zeros(2))
    return Found(float(jnp.max(jnp.abs(slope - np.cos(5.0) * jnp.eye(2)))), ("ok",))


# ---- Ill-conditioned fits ----------------------------------------------------------------------


def fitted(scale: Array, least: float) -> tuple[Array, bool]:
    """(m, k) of a spring from 40 exact positions, by Levenberg and Marquardt from half as much.

    The motion determines k / m alone: the normal equations are singular in every turn.
    """
    ts = jnp.linspace(0.0, 6.0, 41)
    spring = jl.System(free, ("x",))

    def residual(logs: Array, _: Any) -> Array:
        m, k = jnp.exp(logs) * scale
        return run(spring, [1.0], [0.0], ts, {"m": m, "k": k}, **TIGHT).q[1:, 0] - jnp.cos(ts[1:])

    solver = optimistix.LevenbergMarquardt(rtol=least, atol=least)
    start = jnp.log(jnp.array([0.7, 1.3]))
    found = optimistix.least_squares(residual, solver, start, max_steps=100, throw=False)
    return jnp.exp(found.value) * scale, bool(found.result == optimistix.RESULTS.successful)


# Positions are exact to some 1e-12, and so is the frequency that they determine.
@rows.row("a fit that determines k / m alone", "error of k / m", 1e-9)
def ratio_alone(quick: bool) -> Found:
    (m, k), ended = fitted(jnp.ones(2), 1e-12)
    return Found(abs(float(k / m) - 1.0), ("ok" if ended else "not converged",))


@rows.row("the same at 1e9 kg", "error of k / m", 1e-9)
def heavy_ratio(quick: bool) -> Found:
    (m, k), ended = fitted(jnp.full(2, 1e9), 1e-12)
    return Found(abs(float(k / m) - 1.0), ("ok" if ended else "not converged",))


# The Jacobian has columns a factor 1e6 apart: its singular values spread over 6 decades more.
@rows.row("a fit with sensitivities 1e6 apart", "relative error of the weak one", 1e-4)
def weak_parameter(quick: bool) -> Found:
    """Stiffness and cubic stiffness 1e-6 of a soft oscillation."""
    ts = jnp.linspace(0.0, 6.0, 41)
    system = jl.System(
        lambda t, q, v, p: (
            0.5 * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2 - 0.25e-6 * p["c"] * q[0] ** 4
        ),
        ("x",),
    )

    def positions(p: Any) -> Array:
        return run(system, [1.0], [0.0], ts, {"k": p[0], "c": p[1]}, **TIGHT).q[1:, 0]

    data = positions(jnp.array([1.0, 1.0]))
    solver = optimistix.LevenbergMarquardt(rtol=1e-13, atol=1e-13)
    found = optimistix.least_squares(
        lambda p, _: 1e6 * (positions(p) - data),
        solver,
        jnp.array([0.8, 3.0]),
        max_steps=200,
        throw=False,
    )
    ended = bool(found.result == optimistix.RESULTS.successful)
    return Found(abs(float(found.value[1]) - 1.0), ("ok" if ended else "not converged",))


# ---- What cannot be integrated -----------------------------------------------------------------


@rows.row("a force that becomes nan", "-", 0.0, ("nonfinite", "step_below_resolution"))
def broken(quick: bool) -> Found:
    force = jl.GeneralizedForce(lambda t, q, v, p: jnp.sqrt(0.5 - q), "broken")
    system = jl.System(free, ("x",), forces=(force,))
    return must_end(run(system, [0.0], [1.0], [0.0, 2.0], {"m": 1.0, "k": 0.0}))


@rows.row("fewer steps than it takes", "-", 0.0, ("max_steps",))
def few(quick: bool) -> Found:
    return must_end(run(ARMS, [1.0, 0.5], [0.0, 0.0], [0.0, 100.0], {}, max_steps=50))


@rows.row("steps too long to be solved, gauss6", "-", 0.0, ("implicit_solve_failed",))
def unsolved(quick: bool) -> Found:
    return must_end(run(ARMS, [2.0, 2.0], [0.0, 0.0], [0.0, 9.0], {}, method="gauss6", dt=3.0))


@rows.row("steps far too long for a stiff spring", "-", 0.0, ("nonfinite", "max_steps"))
def unstable(quick: bool) -> Found:
    """An explicit method with fixed steps of 10 times its limit of stability."""
    options: dict[str, Any] = {"method": diffrax.Tsit5(), "dt": 0.03, "max_steps": 10_000}
    return must_end(run(SPRING, [1.0], [0.0], [0.0, 100.0], {"m": 1.0, "k": 1e6}, **options))


@rows.row("a mass that is used up", "-", 0.0, ("mass_singular", "step_below_resolution"))
def used_up(quick: bool) -> Found:
    """M = 1 - t under a constant force."""
    system = jl.System(lambda t, q, v, p: 0.5 * (1.0 - t) * v[0] ** 2 + q[0], ("x",))
    return must_end(run(system, [0.0], [0.0], [0.0, 2.0], {}))


@rows.row("beyond the table of an input", "-", 0.0, ("input_range",))
def out_of_range(quick: bool) -> Found:
    table = {"f": jl.Linear(jnp.array([0.0, 1.0]), jnp.array([0.0, 1.0]))}
    solve = jax.jit(lambda t: run(PUSHED, [0.0], [0.0], t, {"m": 1.0, "k": 0.0}, inputs=table))
    return must_end(solve(jnp.array([0.0, 2.0])))
