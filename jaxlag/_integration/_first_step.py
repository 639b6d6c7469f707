"""The length of the first adaptive step."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


def slope_and_step(
    field: Callable, t0: Array, y0: Array, controller: Any, order: float
) -> tuple[Array, Array]:
    """(dy/dt at the start, length of the first step), in a loop that contains the field once.

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. II.4.
    """
    size = partial(_scaled_norm, controller, y0)

    def body_fun(i: Array, carry: tuple) -> tuple:
        f0, h, t, y = carry
        f = field(t, y)
        f0 = jnp.where(i == 0, f, f0)
        d0, d1 = size(y0), size(f0)
        tiny = (d0 < 1e-5) | (d1 < 1e-5)
        trial = jnp.where(tiny, 1e-6, 0.01 * d0 / jnp.where(tiny, 1.0, d1))
        steepest = jnp.maximum(d1, size(f - f0) / trial)
        flat = steepest <= 1e-15
        allowed = (0.01 / jnp.where(flat, 1.0, steepest)) ** (1 / order)
        allowed = jnp.where(flat, jnp.maximum(1e-6, 1e-3 * trial), allowed)
        h = jnp.minimum(100.0 * trial, allowed)
        return f0, h, t0 + trial.astype(t0.dtype), y0 + trial * f0

    init = (jnp.zeros_like(y0), jnp.zeros((), y0.dtype), t0, y0)
    f0, h, _, _ = jax.lax.fori_loop(0, 2, body_fun, init)
    return f0, h


def _scaled_norm(controller: Any, y0: Array, x: Array) -> Array:
    return controller.norm(x / (controller.atol + controller.rtol * jnp.abs(y0)))


def first_step(
    solver: Any,
    controller: Any,
    term: Any,
    t0: Array,
    t1: Array,
    y: PyTree,
    args: Any,
    guess: Array | None,
) -> tuple[Array, Any]:
    """(first adaptive step, the controller's state), by the controller's own estimate.

    Args:
        solver: the method.
        controller: step-size controller.
        term: vector field.
        t0: start.
        t1: end of the motion.
        y: state at the start.
        args: arguments of a step from there.
        guess: the step; None if it is to be estimated.
    """
    order = solver.error_order(term)
    dtype = jnp.result_type(*jax.tree.leaves(y))
    if dtype == t0.dtype:
        end, state = controller.init(term, t0, t1, y, guess, args, solver.func, order)
        return jnp.asarray(end - t0), state

    # diffrax estimates a first step only where time and state share a dtype: count from t0.
    def func(term: Any, elapsed: Any, y: PyTree, args: Any) -> PyTree:
        return solver.func(term, t0 + jnp.asarray(elapsed, t0.dtype), y, args)

    guess = None if guess is None else guess.astype(dtype)
    zero = jnp.zeros_like(t0, dtype)
    span = (t1 - t0).astype(dtype)
    end, state = controller.init(term, zero, span, y, guess, args, func, order)
    return jnp.asarray(end, t0.dtype), state
