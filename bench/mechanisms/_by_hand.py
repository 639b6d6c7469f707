"""The same mechanism written by hand in JAX: derivatives of L, one dense solve, diffrax."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bench.mechanisms._scene import Scene


def rows_of(scene: Scene) -> Callable[[Array, Array, Any], Array] | None:
    """The rows in velocities, A v, the same ones that are solved with; None without rows."""
    parts: list[Callable[[Array, Array, Any], Array]] = []
    phi, rolling = scene.phi, scene.rolling
    if phi is not None:
        parts.append(lambda q, v, p: jax.jvp(lambda q: phi(0.0, q, p), (q,), (v,))[1])
    if rolling is not None:
        parts.append(lambda q, v, p: rolling(0.0, q, v, p))
    if not parts:
        return None

    def rows(q: Array, v: Array, p: Any) -> Array:
        found = jnp.concatenate([jnp.atleast_1d(part(q, v, p)) for part in parts])
        return found if scene.independent is None else found[np.array(scene.independent)]

    return rows


def field(scene: Scene) -> Callable[[Any, Array, Any], Array]:
    """dy/dt with y = (q, v), from M a - A^T lam = Q - h, A a = -gamma."""
    L, rows = scene.lagrangian, rows_of(scene)

    def rates(t: Any, y: Array, p: Any) -> Array:
        q, v = jnp.split(y, 2)
        momentum = jax.grad(L, 2)
        M = jax.jacfwd(momentum, 2)(t, q, v, p)
        moved = jax.jvp(lambda q: momentum(t, q, v, p), (q,), (v,))[1]
        right = jax.grad(L, 1)(t, q, v, p) - moved
        if scene.force is not None:
            right += scene.force(t, q, v, p)
        if rows is None:
            return jnp.concatenate([v, jnp.linalg.solve(M, right)])
        A = jax.jacfwd(rows, 1)(q, v, p)
        gamma = jax.jvp(lambda q: rows(q, v, p), (q,), (v,))[1]
        whole = jnp.block([[M, A.T], [A, jnp.zeros((A.shape[0], A.shape[0]))]])
        solved = jnp.linalg.solve(whole, jnp.concatenate([right, -gamma]))
        return jnp.concatenate([v, solved[: v.size]])

    return rates


def solve(scene: Scene, ts: np.ndarray, tolerance: float) -> Callable[[Array, Any], Any]:
    """The program: coordinates at ts, of (y0, params)."""

    def run(y0: Array, p: Any) -> Any:
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(field(scene)),  # pyright: ignore[reportArgumentType]
            diffrax.Dopri8(),
            ts[0],
            ts[-1],
            None,
            y0,
            p,
            saveat=diffrax.SaveAt(ts=jnp.asarray(ts)),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=100_000,
        )
        assert found.ys is not None
        return found.ys[:, : y0.size // 2]

    return jax.jit(run)
