"""Transport along a motion whose independent velocities are constant."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._analysis._equations import Equations, Scene, equations_around
from jaxlag._linalg._kkt import units_of
from jaxlag._linalg._mass_solve import dependence_floor
from jaxlag._tracing._compiled import Compiled

STEPS = 24
"""Steps of the classical Runge-Kutta method over one radian or so: errors of 1e-7."""
PARTS = np.arange(STEPS + 1) + 0.4 * np.mod(np.arange(STEPS + 1) * (5**0.5 - 1) / 2, 1.0)
"""Times in steps. They are not multiples of one another: no period of the equations hides."""
NEAR = 1e-6
"""Difference of two changes of L that are the same, over |L|."""


class Transported(NamedTuple):
    """States (q, w, x, inputs) at some times.

    Attributes:
        t: times.
        z: states.
    """

    t: Float[Array, " k"]
    z: Float[Array, "k m"]


def transported(around: Equations, dependent: Bool[Array, " n"]) -> Transported:
    """States that follow from that of `around` if all independent velocities are constant.

    In a steady motion the equations hold at all of them. The fastest coordinate moves by about 1,
    or by its own size. The dependent velocities follow from A v + b = 0, or v from the
    quasi-velocities.

    Args:
        around: the equations, at their state.
        dependent: which velocities depend on the others; without quasi-velocities.
    """
    n, k = around.scene.system.size, around.speeds
    start = around.point(around.z)
    speed = jnp.max(jnp.abs(start.v) / (1.0 + jnp.abs(start.q)), initial=0.0)
    duration = jnp.where(speed > 0, 1.0 / jnp.where(speed > 0, speed, 1.0), 1.0)
    steps = jnp.asarray(np.diff(PARTS) / PARTS[-1], duration.dtype) * duration

    def velocity(t: Array, q: Array) -> Array:
        return _velocities(around, dependent, t, q, start.w, start.v)

    def step(state: tuple[Array, Array], h: Array) -> tuple[Any, Any]:
        t, q = state
        a = velocity(t, q)
        b = velocity(t + h / 2, q + h / 2 * a)
        c = velocity(t + h / 2, q + h / 2 * b)
        d = velocity(t + h, q + h * c)
        after = t + h, q + h / 6 * (a + 2 * b + 2 * c + d)
        return after, after

    _, (t, q) = jax.lax.scan(step, (around.t.astype(duration.dtype), start.q), steps)
    w = jnp.broadcast_to(start.w, (STEPS, k))
    if around.scene.system.quasi is None:
        w = jax.vmap(velocity)(t, q)
    rest = jnp.broadcast_to(around.z[n + k :], (STEPS, around.z.shape[0] - n - k))
    return Transported(t, jnp.concatenate([q, w, rest], axis=1))


def consistent(around: Equations, dependent: Bool[Array, " n"]) -> Float[Array, " m"]:
    """z of the state, with dependent velocities that satisfy A v + b = 0."""
    z, n = around.z, around.scene.system.size
    if around.scene.system.quasi is not None:
        return z
    v = z[n : 2 * n]
    return z.at[n : 2 * n].set(_velocities(around, dependent, around.t, z[:n], v, v))


def _velocities(
    around: Equations, dependent: Array, t: Array, q: Array, w: Array, v: Array
) -> Float[Array, " n"]:
    """v with these independent velocities."""
    scene, params = around.scene, around.params
    system = scene.system
    if system.quasi is not None:
        return system.quasi.velocities(t, q, system.quasi.full(w), params)
    terms, fixed = system._program.terms(q, params, scene.sample), jnp.where(dependent, 0.0, v)
    if not system._rows(params, q.dtype).size:
        return v
    A = terms.rows_of(t, fixed, params)(q)
    units = units_of(terms.mass(t, q, v, params), A)
    sizes = jnp.linalg.norm(A * units, axis=1)
    sizes = jnp.where(sizes > 0, sizes, 1.0)
    scaled = jnp.where(dependent, A * units, 0.0) / sizes[:, None]
    left = -terms.velocity(t, q, fixed, params) / sizes
    found = jnp.linalg.lstsq(scaled, left, rcond=dependence_floor(q.dtype))[0]
    return fixed + jnp.where(dependent, units * found, 0.0)


def without_influence(point: tuple, kept: Sequence[int]) -> list[int]:
    """Coordinates on which no equation depends, except those kept.

    Args:
        point: (scene, params, inputs, t, q, v).
        kept: indices of others.
    """
    scene, params, signals, t, q, v = point
    here, found = np.asarray(_residuals((scene,), params, signals, t, q, v)), []
    for i in range(q.shape[0]):
        near = q.at[i].add(0.7391 * (1.0 + abs(float(q[i]))))
        there = np.asarray(_residuals((scene,), params, signals, t, near, v))
        least = np.finfo(here.dtype).eps ** 0.5 * (np.abs(here) + np.abs(there))
        if i not in kept and np.all(np.abs(there - here) <= least):
            found.append(i)
    return found


@Compiled
def _residuals(scene: Scene, params: Any, signals: Any, t: Array, q: Array, v: Array) -> Array:
    """Accelerations, rates of states, and residuals of the constraints."""
    around = equations_around(scene, params, signals, t, q, v)
    terms = scene.system._program.terms(q, params, scene.sample)
    constraints = terms.position(t, q, params), terms.velocity(t, q, v, params)
    return jnp.concatenate([around.rates(around.z)[0], *constraints])


def most_constant(point: tuple, dependent: Sequence[Sequence[bool]]) -> int:
    """The first set of dependent velocities along whose motion L changes least.

    In a steady motion of a system without supply of energy L is constant.

    Args:
        point: (scene, params, inputs, t, q, v).
        dependent: sets of them.
    """
    scene, params, signals, *at = point
    changes, size = [], 0.0
    for some in dependent:
        values = np.asarray(_lagrangians((scene,), params, signals, *at, jnp.asarray(some)))
        changes.append(np.max(np.abs(values - values[0])))
        size = max(size, float(np.abs(values[0])))
    found = np.where(np.isfinite(changes), changes, np.inf)
    return int(np.argmax(found <= np.min(found) + NEAR * size))


@Compiled
def _lagrangians(
    scene: Scene, params: Any, signals: Any, t: Array, q: Array, v: Array, dependent: Array
) -> Float[Array, " k"]:
    """L along the motion with constant independent velocities."""
    around = equations_around(scene, params, signals, t, q, v)
    z = consistent(around, dependent)
    times, places = transported(around._replace(z=z), dependent)
    n, L = q.shape[0], scene.system.lagrangian
    v = z[n : 2 * n]

    def of(state: tuple[Array, Array]) -> Array:
        return L(state[0], state[1][:n], state[1][n : 2 * n], params)

    return jnp.append(L(t, q, v, params), jax.lax.map(of, (times, places)))
