"""The motions solved in JAX: every solver of jaxlag, and diffrax alone.

diffrax has the explicit equations by hand and, as in a first prototype, naive autodiff:
`jax.hessian` of L, Jacobians of the constraint rows, `jnp.linalg.solve`. All are functions of
start, parameters and tolerance (or step), compiled once and called repeatedly, as in a fit. They
return only the needed results: final coordinates, whether the end was reached, number of steps.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax import Array

import jaxlag as jl
from bench._harness.timing import build
from bench._problems.explicit_equations import functions
from bench._problems.motions import Motion
from bench.work_precision._sweep import Line, Solved, steps, tolerances
from jaxlag._simulation._methods import METHODS
from jaxlag.solvers import AbstractFixedStep

ORDER = 5  # lowest order of diffrax's own methods that have a line
MOST_STEPS = 1 << 22
JNP = functions(jnp)
DIFFRAX = {"Tsit5": diffrax.Tsit5, "Dopri8": diffrax.Dopri8}


def methods(motion: Motion) -> list[str]:
    """Names of jaxlag's solvers and of diffrax's from order 5; implicit ones if it is stiff."""
    found = []
    for name, make in METHODS.items():
        solver = make()
        ours = type(solver).__module__.startswith("jaxlag")
        implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
        high = (solver.order(diffrax.ODETerm(lambda t, y, args: y)) or 0) >= ORDER
        # Lanes are compared for adaptive methods only.
        single = motion.lanes == 1 or not isinstance(solver, AbstractFixedStep)
        if (ours or high) and (motion.stiff or ours or not implicit) and single:
            found.append(name)
    return found


def with_jaxlag(motion: Motion, method: str) -> Line:
    """By `jl.simulate`, jitted.

    Raises:
        ValueError: the method does not apply to such systems.
    """
    fixed = isinstance(METHODS[method](), AbstractFixedStep)
    # The state of structure-preserving methods has velocities, not quasi-velocities.
    formulation = "multipliers" if fixed and motion.system.quasi is not None else "auto"

    def solve(q0: Array, v0: Array, params: Any, knob: Array) -> tuple[Array, Array, Array]:
        options = {"dt": knob, "max_steps": MOST_STEPS}
        if not fixed:
            options = {"rtol": knob, "atol": knob, "max_steps": MOST_STEPS}
        ts, options["formulation"] = (0.0, motion.t1), formulation
        end = jl.simulate(motion.system, q0, v0, ts, params, method=method, throw=False, **options)
        return end.q[-1], end.ok, end.stats["accepted"]

    knobs = (
        steps(motion.t1, motion.fewest, MOST_STEPS) if fixed else tolerances(motion.loosest, 16.0)
    )
    args = (jnp.asarray(motion.q0), jnp.asarray(motion.v0), _params(motion))

    return _line(motion, solve, args, knobs, fixed)


def with_diffrax(motion: Motion, field: Callable, method: str, y0: Array) -> Line:
    """By `diffrax.diffeqsolve`, jitted."""

    n = motion.q0.shape[-1]

    def solve(y0: Array, params: Any, knob: Array) -> tuple[Array, Array, Array]:
        end = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            DIFFRAX[method](),
            0.0,
            motion.t1,
            None,
            y0,
            params,
            stepsize_controller=diffrax.PIDController(rtol=knob, atol=knob),
            max_steps=MOST_STEPS,
            throw=False,
        )
        assert end.ys is not None
        done = jnp.asarray(end.result == diffrax.RESULTS.successful)
        return end.ys[-1, :n], done, end.stats["num_accepted_steps"]

    knobs = tolerances(motion.loosest, 16.0)
    return _line(motion, solve, (y0, _params(motion)), knobs, False)


def _line(motion: Motion, solve: Callable, args: tuple, knobs: list[float], fixed: bool) -> Line:
    if motion.lanes > 1:
        moving = len(args) - 1  # all except the parameters and the knob
        solve = jax.vmap(solve, (0,) * moving + (None, None))
    program = build(solve, *args, jnp.asarray(knobs[0]))

    def make(knob: float) -> Callable[[], Any]:
        value = jnp.asarray(knob)
        return lambda: program.call(*args, value)

    def read(end: tuple[Array, Array, Array]) -> Solved:
        q, done, accepted = end
        return Solved(jnp.where(done[..., None], q, jnp.nan), int(jnp.max(accepted)))

    return Line("step" if fixed else "tolerance", knobs, make, read, 0.0)


def _params(motion: Motion) -> dict[str, Array]:
    return {name: jnp.asarray(value) for name, value in motion.params.items()}


def by_hand(motion: Motion) -> Callable[[Any, Array, Any], Array]:
    """dy/dt by the explicit equations."""

    def field(t: Any, y: Array, params: Any) -> Array:
        return jnp.stack(motion.rates(JNP, params, [y[i] for i in range(y.shape[0])]))

    return motion.field or field


def naive(motion: Motion) -> Callable[[Any, Array, Any], Array]:
    """d(q, v)/dt by autodiff on arrays and a library solve for accelerations and multipliers."""

    def field(t: Any, y: Array, params: Any) -> Array:
        q, v = jnp.split(y, 2)
        L = lambda q, v: motion.lagrangian(t, q, v, params)  # noqa: E731
        M = jax.hessian(L, 1)(q, v)
        right = jax.grad(L, 0)(q, v) - jax.jacfwd(jax.grad(L, 1), 0)(q, v) @ v
        if motion.force is not None:
            right = right + motion.force(q, v, params)
        if motion.rows is None:
            return jnp.concatenate([v, jnp.linalg.solve(M, right)])
        A = jax.jacfwd(motion.rows, 1)(q, v, params)
        gamma = jax.jvp(lambda q: motion.rows(q, v, params), (q,), (v,))[1]
        zero = jnp.zeros((len(A), len(A)))
        K = jnp.block([[M, A.T], [A, zero]])
        return jnp.concatenate([v, jnp.linalg.solve(K, jnp.concatenate([right, -gamma]))[: len(q)]])

    return field


def lines(
    motion: Motion, ours: Sequence[str] | None, prototype: bool
) -> dict[str, Callable[[], Line]]:
    """Lines of one process: jaxlag's methods and diffrax's.

    Args:
        motion: the motion to solve.
        ours: names of jaxlag's methods; None for all.
        prototype: whether naive autodiff has lines.
    """
    chosen = [name for name in methods(motion) if ours is None or name in ours]
    found: dict[str, Callable[[], Line]] = {
        f"jaxlag {name}": partial(with_jaxlag, motion, name) for name in chosen
    }
    forms = {"by hand": (by_hand(motion), jnp.asarray(motion.start()))}
    if prototype:
        qv = jnp.concatenate([jnp.asarray(motion.q0), jnp.asarray(motion.v0)], axis=-1)
        forms["naive"] = naive(motion), qv
    for label, (field, start) in forms.items():
        for name in DIFFRAX:
            make = partial(with_diffrax, motion, field, name, start)
            found[f"diffrax {name}, {label}"] = make
    return found
