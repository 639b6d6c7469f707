"""Redundant constraint rows and void rows: they must not change the results.

Redundant rows: rollers of radius r on a rail, whose rows differ by levers of r meters only,
declared with additional dependent rows. Void rows: rows that are 0 = 0 except for rounding, in
every kind of declaration and formulation. They must not change the motion. With a gap added to
such a row, the contradiction must be reported.
"""

from itertools import product
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench.stability._cases import OK, Cases, Found, names

cases = Cases()


# ---- Short levers --------------------------------------------------------------------------------


def rolling(t: Any, q: Array, params: Any) -> Array:
    return jnp.stack([q[0] - params * q[1], q[0] - params * q[2]])


DEPENDENT = {
    "none": None,
    "doubled": lambda t, q, r: 2.0 * rolling(t, q, r)[:1],
    "sum": lambda t, q, r: jnp.sum(rolling(t, q, r))[None],
    "implied": lambda t, q, r: jnp.stack([q[1] - q[2], 3.0 * (q[1] - q[2])]),
}


def imbalance(dtype: Any) -> Found:
    """The largest |M a + h - A^T lam| divided by the sum of its terms, in units of eps."""
    worst, where = 0.0, ""
    for name, dependent in DEPENDENT.items():
        constraints = (jl.Holonomic(rolling, "rollers"),)
        if dependent is not None:
            constraints += (jl.Holonomic(dependent, "again"),)
        system = jl.System(
            coordinates=("x", "a", "b"),
            kinetic=lambda t, q, v, r: 0.5 * (v[0] ** 2 + r**2 * (v[1] ** 2 + 2 * v[2] ** 2)),
            potential=lambda t, q, r: 9.81 * q[0] + r * (3.0 * q[1] - q[2]),
            constraints=constraints,
        )
        for radius in 10.0 ** -np.arange(9):
            at = jnp.zeros(3, dtype), jnp.zeros(3, dtype), jnp.asarray(radius, dtype)
            a, M, h = system.acceleration(*at), system.mass_matrix(*at), system.bias(*at)
            lam = jnp.concatenate([jnp.ravel(x) for x in system.multipliers(*at).values()])
            A = system._terms.rows(jnp.zeros(()), *at)[0]
            a, M, h, lam, A = (np.asarray(x, np.float64) for x in (a, M, h, lam, A))
            terms = np.abs(M @ a) + np.abs(h) + np.abs(lam) @ np.abs(A)
            off = float(np.max(np.abs(M @ a + h - lam @ A) / terms)) / float(jnp.finfo(dtype).eps)
            worst, where = max((worst, where), (off, f"{name}, r = {radius:.0e} m"))
    return Found(worst, (OK,), where)


@cases.add("reactions beside redundant rows, levers to 10 nm", "imbalance, roundings", 8.0)
def double(quick: bool) -> Found:
    return imbalance(jnp.float64)


@cases.add("reactions beside redundant rows, levers to 10 nm, float32", "imbalance, roundings", 8.0)
def single(quick: bool) -> Found:
    return imbalance(jnp.float32)


# ---- Void rows -----------------------------------------------------------------------------------


def identity(x: Array) -> Array:
    return jnp.sin(x) ** 2 + jnp.cos(x) ** 2 - 1.0


EMPTY = {
    "holonomic": jl.Holonomic(lambda t, q, gap: identity(q[0]) * q[1] + gap, "void"),
    "rheonomic": jl.Holonomic(lambda t, q, gap: identity(q[0] + t) * q[1] + gap * t, "void"),
    "Pfaffian": jl.Pfaffian(lambda t, q, v, gap: identity(q[0]) * v[1] + gap, "void"),
}
ROD = jl.Holonomic(lambda t, q, gap: q @ q - 1.0, "rod")
WAYS = {
    "multipliers": {},
    "null space": {"formulation": "null_space"},
    "assembled": {"assemble": True},
}


def moved(constraints: Any, lowering: str, gap: float, ways: Any) -> jl.Solution:
    system = jl.System(
        lambda t, q, v, gap: 0.5 * v @ v - 9.81 * q[1],
        ("x", "y"),
        constraints=constraints,
        lowering=lowering,
    )
    return jl.simulate(system, [0.6, -0.8], [0.24, 0.18], [0.0, 0.5], gap, throw=False, **ways)


def wrong_motions(gap: float, quick: bool) -> Found:
    """Number of motions that differ from the expected result."""
    wrong, count, found = 0, 0, set[str]()
    alone = [()] if quick else [(), (ROD,)]
    for others, lowering in product(alone, ["auto"] if quick else ["auto", "array"]):
        expected = moved(others, lowering, 0.0, {})
        for row, ways in product(EMPTY.values(), WAYS.values()):
            motion = moved((*others, row), lowering, gap, ways)
            (status,) = names(motion.status)
            count += 1
            if gap:
                wrong += status != "contradictory_rows"
            else:
                wrong += not (status == OK and np.allclose(motion.q, expected.q, atol=1e-8))
            found.add(status)
    return Found(float(wrong), (OK,), f"of {count}: {', '.join(sorted(found))}")


@cases.add("rows that are 0 = 0 but for rounding", "motions refused or changed", 0.0)
def empty(quick: bool) -> Found:
    return wrong_motions(0.0, quick)


@cases.add("the same with a gap of 1 nm", "contradictions not told", 0.0)
def contradictory(quick: bool) -> Found:
    return wrong_motions(1e-9, quick)
