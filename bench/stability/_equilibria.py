"""Random closed linkages at rest: `equilibrium` from random configurations on their constraints.

The linkages have lengths that can be closed, masses over two decades, and springs or none. Each of
them has a stable state of rest. A result counts as wrong if the status is ok but the forces are not
balanced along the constraints, or the constraints are violated. Both are computed independently
from V and phi.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._cases import Cases, Found, names

COUNT, QUICK_COUNT = 200, 20
ROUNDING = 1e-9  # of the largest force, and of lengths in m; the worst observed is 3e-11
GRAVITY = 9.81

cases = Cases()


class Linkage(NamedTuple):
    """Params and the start of one linkage, or of many along a first axis."""

    params: dict[str, Any]
    q0: Any


Potential = Callable[[Any, Array, Any], Array]
Residual = Callable[[Any, Array, Any], Array]
Draw = Callable[[np.random.Generator], Linkage]


def row(name: str, size: int, potential: Potential, residual: Residual, draw: Draw) -> None:
    """Add a case of linkages with `size` coordinates."""
    system = jl.System(
        coordinates=tuple(f"q{i}" for i in range(size)),
        kinetic=lambda t, q, v, params: 0.5 * v @ v,
        potential=potential,
        constraints=(jl.Holonomic(residual, "loops"),),
    )

    def one(linkage: Linkage) -> tuple[Array, Array]:
        """(status, larger of the force residual along the constraints and the constraint error)."""
        params, q0 = linkage
        rest = jl.equilibrium(system, q0, params, throw=False)
        F = jax.grad(potential, argnums=1)(0.0, rest.q, params)
        A = jax.jacobian(residual, argnums=1)(0.0, rest.q, params)
        left = F - A.T @ jnp.linalg.lstsq(A.T, F)[0]
        open_by = jnp.max(jnp.abs(residual(0.0, rest.q, params)))
        return rest.status, jnp.maximum(jnp.max(jnp.abs(left)) / jnp.max(jnp.abs(F)), open_by)

    def run(quick: bool) -> Found:
        rng = np.random.default_rng(size)
        drawn = [draw(rng) for _ in range(QUICK_COUNT if quick else COUNT)]
        many = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *drawn)
        status, left = map(np.asarray, jax.jit(jax.vmap(one))(many))
        ended = names(status)
        ok = status == int(jl.Status.ok)
        details = f"{int(np.sum(~ok))} of {len(ok)} without rest, {np.max(left[ok], initial=0):.1e}"
        wrong = float(np.sum(ok & ~(left <= ROUNDING)))
        return Found(wrong, tuple(dict.fromkeys(ended)), details)

    cases.add(f"rest of closed linkages: {name}", "linkages that do not balance", 0.0)(run)


def direction(angle: Any, xp: Any = jnp) -> Any:
    return xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1)


# ---- Chains of links between two pivots, by the angles of the links ----------------------------


def tips(q: Array, params: Any) -> Array:
    return jnp.cumsum(params["l"][:, None] * direction(q), axis=0)


def chain_potential(t: Any, q: Array, params: Any) -> Array:
    """Weights at fractions f of the links, springs from their tips to fixed points: V."""
    ends = tips(q, params)
    links = params["l"][:, None] * direction(q)
    y = (ends - (1.0 - params["f"][:, None]) * links)[:, 1]
    r = jnp.sqrt(jnp.sum((ends - params["anchor"]) ** 2, axis=1) + 1e-12)
    springs = jnp.sum(params["k"] * (r - params["r0"]) ** 2)
    return GRAVITY * jnp.sum(params["m"] * y) + 0.5 * springs


def chain_open(t: Any, q: Array, params: Any) -> Array:
    return tips(q, params)[-1] - params["g"]


def chain_doubled(t: Any, q: Array, params: Any) -> Array:
    """The same rows and two dependent ones: rank 2 on the constraints, higher rank elsewhere."""
    x, y = chain_open(t, q, params)
    return jnp.stack([x, y, 2.0 * x + y, x * (1.0 + q[0] ** 2)])


def dyad(rng: np.random.Generator, to: Any, l1: float, l2: float) -> tuple[float, float] | None:
    """Angles of two links that reach `to`, one of two solutions; None if they cannot."""
    d = np.hypot(*to)
    if not abs(l1 - l2) < d < l1 + l2:
        return None
    bend = np.arccos((l1**2 + d**2 - l2**2) / (2 * l1 * d))
    first = np.arctan2(to[1], to[0]) + rng.choice([-1, 1]) * bend
    rest = to - l1 * direction(first, np)
    return first, np.arctan2(rest[1], rest[0])


def chain(size: int, springs: bool = True) -> Draw:
    def draw(rng: np.random.Generator) -> Linkage:
        while True:
            lengths, ground = rng.uniform(0.3, 1.5, size), rng.uniform(0.3, 1.5)
            g, q = ground * direction(rng.uniform(-np.pi, np.pi), np), rng.uniform(-3, 3, size)
            to = g - np.sum(lengths[:-2, None] * direction(q[:-2], np), axis=0)
            ends = dyad(rng, to, *lengths[-2:])
            if ends is not None:
                break
        q[-2:] = ends
        k = rng.uniform(0, 1, size) * rng.choice([0, 10.0, 100.0], size) * springs
        r0 = rng.uniform(0, 1, size) * rng.choice([0, 1], size)
        params = {"l": lengths, "g": g, "k": k, "r0": r0, "anchor": rng.uniform(-2, 2, (size, 2))}
        params |= {"m": 10 ** rng.uniform(-1, 1, size), "f": rng.uniform(0, 1, size)}
        return Linkage(params, q)

    return draw


row("four-bars in angles", 3, chain_potential, chain_open, chain(3))
row("four-bars, rows twice", 3, chain_potential, chain_doubled, chain(3))
row("five-bars with springs", 4, chain_potential, chain_open, chain(4))
row("hanging chains of 8 links", 8, chain_potential, chain_open, chain(8, springs=False))


# ---- The same by the Cartesian coordinates of the points between the links ---------------------


def points_potential(t: Any, q: Array, params: Any) -> Array:
    points = q.reshape(-1, 2)
    r = jnp.sqrt(jnp.sum((points - params["anchor"][:-1]) ** 2, axis=1) + 1e-12)
    springs = jnp.sum(params["k"][:-1] * (r - params["r0"][:-1]) ** 2)
    return GRAVITY * params["m"][:-1] @ points[:, 1] + 0.5 * springs


def points_open(t: Any, q: Array, params: Any) -> Array:
    pivots = jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2), params["g"][None]])
    return jnp.sum(jnp.diff(pivots, axis=0) ** 2, axis=1) - params["l"] ** 2


def points(size: int, springs: bool = True) -> Draw:
    def draw(rng: np.random.Generator) -> Linkage:
        params, q = chain(size, springs)(rng)
        ends = np.cumsum(params["l"][:, None] * direction(q, np), axis=0)
        return Linkage(params, ends[:-1].ravel())

    return draw


row("four-bars in Cartesian coordinates", 4, points_potential, points_open, points(3))
row("hanging chains of 6 rods", 10, points_potential, points_open, points(6, springs=False))


# ---- Slider-cranks -----------------------------------------------------------------------------


def slider_open(t: Any, q: Array, params: Any) -> Array:
    end = tips(q[:2], params)[-1]
    return end - params["offset"] - q[2] * direction(params["tilt"])


def slider_potential(t: Any, q: Array, params: Any) -> Array:
    (crank, pin), m = tips(q[:2], params), params["m"]
    y = m[0] * 0.5 * crank[1] + m[1] * 0.5 * (crank + pin)[1] + m[2] * pin[1]
    return GRAVITY * y + 0.5 * params["k"] * (q[2] - params["s0"]) ** 2


def slider(rng: np.random.Generator) -> Linkage:
    while True:
        lengths, tilt, a = rng.uniform(0.3, 1.5, 2), *rng.uniform(-np.pi, np.pi, 2)
        along, across = direction(tilt, np), direction(tilt + np.pi / 2, np)
        offset = rng.uniform(-1, 1) * across
        crank = lengths[0] * direction(a, np) - offset
        if abs(crank @ across) < lengths[1]:
            break
    s = crank @ along + rng.choice([-1, 1]) * np.sqrt(lengths[1] ** 2 - (crank @ across) ** 2)
    rod = s * along - crank
    k = rng.uniform(0, 1) * rng.choice([0, 10.0, 100.0])
    params = {"l": lengths, "tilt": tilt, "offset": offset, "k": k, "s0": rng.uniform(-1, 1)}
    params |= {"m": 10 ** rng.uniform(-1, 1, 3)}
    return Linkage(params, np.array([a, np.arctan2(rod[1], rod[0]), s]))


row("slider-cranks", 3, slider_potential, slider_open, slider)


# ---- Six-bars: a dyad from a point of a four-bar's coupler to the ground -----------------------


def joints(q: Array, params: Any) -> tuple[Array, Array, Array]:
    """Joints of the four-bar, the point on its coupler, joints of the dyad."""
    loop = tips(q[:3], params | {"l": params["l"][:3]})
    at = loop[0] + params["arm"] * direction(q[1] + params["bend"])
    return loop, at, at + tips(q[3:], params | {"l": params["l"][3:]})


def six_open(t: Any, q: Array, params: Any) -> Array:
    loop, _, ends = joints(q, params)
    return jnp.concatenate([loop[-1] - params["g"], ends[-1] - params["h"]])


def six_potential(t: Any, q: Array, params: Any) -> Array:
    loop, at, ends = joints(q, params)
    y = jnp.stack([*loop[:2, 1], at[1], ends[0, 1]])
    off = ends[0] - params["anchor"]
    return GRAVITY * params["m"] @ y + 0.5 * params["k"] * off @ off


def six(rng: np.random.Generator) -> Linkage:
    four, q = chain(3)(rng)
    lengths = np.append(four["l"], rng.uniform(0.3, 1.5, 2))
    arm, (bend, d, e) = rng.uniform(0.2, 1.0), rng.uniform(-np.pi, np.pi, 3)
    at = lengths[0] * direction(q[0], np) + arm * direction(q[1] + bend, np)
    h = at + lengths[3:] @ direction(np.array([d, e]), np)
    k = rng.uniform(0, 1) * rng.choice([0, 10.0, 100.0])
    params = {"l": lengths, "arm": arm, "bend": bend, "g": four["g"], "h": h, "k": k}
    params |= {"m": 10 ** rng.uniform(-1, 1, 4), "anchor": rng.uniform(-2, 2, 2)}
    return Linkage(params, np.array([*q, d, e]))


row("six-bars", 5, six_potential, six_open, six)
