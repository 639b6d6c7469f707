"""The loop in which all accelerations are timed: Runge-Kutta steps of fixed length.

A state is a list of arrays: scalars, or one vector for a program on arrays.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.experimental.xla_metadata import set_xla_metadata

import jaxlag as jl
from bench._problems.scenes import Scene
from jaxlag._lowering import ScalarProgram, State

STEP = 1e-4  # s
STAGES = 4  # evaluations per step

Parts = Sequence[Array]
Field = Callable[[Parts, Parts], Parts]  # (q, v) -> a
Equations = Callable[[Any], Field]  # terms that depend on params alone are computed here


def loop(equations: Equations, steps: int) -> Callable[[Parts, Parts, Any], Any]:
    """`run(q, v, params)`: the state after all steps."""

    def run(q: Parts, v: Parts, params: Any) -> Any:
        field = equations(params)

        def step(state: Any, _: Any) -> Any:
            q, v = state
            v_1, a_1 = v, field(q, v)
            v_2 = _moved(v, a_1, STEP / 2)
            a_2 = field(_moved(q, v_1, STEP / 2), v_2)
            v_3 = _moved(v, a_2, STEP / 2)
            a_3 = field(_moved(q, v_2, STEP / 2), v_3)
            v_4 = _moved(v, a_3, STEP)
            a_4 = field(_moved(q, v_3, STEP), v_4)
            q = _moved(q, _mean(v_1, v_2, v_3, v_4), STEP / 6)
            v = _moved(v, _mean(a_1, a_2, a_3, a_4), STEP / 6)
            return (q, v), None

        return lax.scan(step, (list(q), list(v)), None, length=steps)[0]

    return run


def _moved(x: Parts, rate: Parts, h: float) -> list[Array]:
    return [a + h * b for a, b in zip(x, rate, strict=True)]


def _mean(*rates: Parts) -> list[Array]:
    return [a + d + 2.0 * (b + c) for a, b, c, d in zip(*rates, strict=True)]


def called(equations: Equations) -> Equations:
    """The same as a function that every stage calls, which is how jaxlag compiles long code."""

    def wrapped(params: Any) -> Field:
        field = equations(params)

        @jax.jit
        def evaluate(state: Array) -> Array:
            q, v = jnp.split(state, 2)
            return jnp.stack(field(_elements(q), _elements(v)))

        def call(q: Parts, v: Parts) -> Parts:
            with set_xla_metadata(inlineable="false"):
                return _elements(evaluate(jnp.stack([*q, *v])))

        return call

    return wrapped


def _elements(x: Array) -> list[Array]:
    return [lax.squeeze(lax.slice_in_dim(x, i, i + 1), (0,)) for i in range(x.shape[0])]


def system(scene: Scene, lowering: str = "auto") -> jl.System:
    """The scene as a user declares it."""
    names = [f"q{i}" for i in range(len(scene.q0))]
    return jl.System(scene.lagrangian, names, lowering=lowering)


def by_jaxlag(scene: Scene, lowering: str = "auto") -> tuple[Equations, bool]:
    """jaxlag's equations as `jl.simulate` uses them, and whether they are on scalars."""
    program = system(scene, lowering)._program
    like, t = jnp.asarray(scene.q0), jnp.zeros(())
    scalar = isinstance(program, ScalarProgram) and operations(scene, lowering) is not None
    if isinstance(program, ScalarProgram):
        program = replace(program, in_loop=True)

    def equations(params: Any) -> Field:
        prepared = program.precompute(like, params, {})

        def on_scalars(q: Parts, v: Parts) -> Parts:
            a = program.acceleration(State(t, jnp.stack(q), jnp.stack(v), params, {}), prepared)
            return _elements(a)

        def on_arrays(q: Parts, v: Parts) -> Parts:
            return [program.acceleration(State(t, *q, *v, params, {}), prepared)]

        return on_scalars if scalar else on_arrays

    return equations, scalar


def operations(scene: Scene, lowering: str = "auto") -> int | None:
    """Number of operations of the scalar program; None if there is no scalar program."""
    program = system(scene, lowering)._program
    if not isinstance(program, ScalarProgram):
        return None
    lowered = program.lowered(jnp.asarray(scene.q0), scene.params, {})
    return None if lowered.equations is None else lowered.equations.program.operations


def parts(x: Sequence[float], scalar: bool) -> list[Array]:
    """A vector in the form for the loop."""
    return [jnp.asarray(float(number)) for number in x] if scalar else [jnp.asarray(x)]
