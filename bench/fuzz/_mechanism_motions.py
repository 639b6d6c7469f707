"""Short motions of random mechanisms: two formulations compared, and their statuses.

If there is a solution, both formulations must give the same motion within the tolerance. If there
is none, the motion must end with the status that names the cause.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from bench.fuzz._comparison import Compared, worst
from bench.fuzz._mechanism_programs import Prepared, prepare
from bench.fuzz._random_mechanisms import Mechanism, values
from bench.fuzz._reference_solution import Unclear

DURATION = 0.1
LOCAL = 1e4  # allowed difference of two motions, in units of the tolerance (local errors)
NAMED = {
    "contradictory": {"contradictory_rows", "rank_change"},
    "singular": {"mass_singular"},
    "kinematics": {"kinematics_singular"},
}


def compared(mechanism: Mechanism) -> Compared:
    """Compare the motions of a mechanism by two formulations."""
    try:
        prepared = prepare(mechanism, 1)
    except Unclear as unclear:
        return Compared(f"not compared: {unclear}")
    drawn, quasi = mechanism.drawn, mechanism.quasi
    # Quasi-velocities by U do not satisfy additional rows.
    with_u = quasi is not None and not (quasi.U is not None and mechanism.rows)
    first, second = ("quasi", "multipliers") if with_u else ("multipliers", "null_space")
    tolerance = 1e-9 if drawn.dtype == "float64" else 1e-5
    outcome = prepared.equations.outcome
    if any(row.role == "bent" for row in mechanism.rows) and outcome == "solution":
        return Compared("not compared: rows that bend at rest")
    ends, found = {}, {}
    for way in (first, second):
        motion = _motion(mechanism, prepared, way, tolerance)
        status = jl.Status(int(motion.status)).name
        singular = quasi is not None and quasi.singular and way == "quasi"
        expected = "kinematics" if singular and outcome == "solution" else outcome
        if expected in NAMED:
            right = NAMED[expected] | (NAMED["kinematics"] if singular else set())
            if expected == "contradictory" and not _holds(mechanism, prepared):
                right = right | {"inconsistent_start"}
            wrong = status not in right
            found[f"{way}: {status} where rows or masses are {expected}"] = np.inf if wrong else 0.0
        elif status == "ok":
            ends[way] = _end(mechanism, motion)
        elif _solvable_at_end(mechanism, motion):
            found[f"{way}: {status} without need"] = np.inf
    if len(ends) == 2:
        one, other = ends.values()
        size = 1.0 + np.max(np.abs(one))
        off = float(np.max(np.abs(one - other))) / (LOCAL * tolerance * size)
        found[f"{first} beside {second}"] = off if np.isfinite(off) else np.inf
    return worst(found)


def _motion(mechanism: Mechanism, prepared: Prepared, way: str, tolerance: float) -> jl.Solution:
    drawn = mechanism.drawn
    units = np.array(drawn.units)
    dtype = jnp.dtype(drawn.dtype)
    bound = tuple(float(x) for x in tolerance * units)
    haste = 0.0
    if prepared.equations.outcome == "solution":
        haste = float(np.max(np.abs(prepared.right.a * prepared.equations.units / units)))
    duration = DURATION / (1.0 + haste**0.5)
    q, v = (jnp.asarray(x, dtype) for x in (prepared.state.q, prepared.state.v))
    return jl.simulate(
        mechanism.system,
        q,
        v,
        jnp.asarray([mechanism.t, mechanism.t + duration]),
        values(drawn),
        method="tsit5",  # compiles three times as fast as the default
        formulation=way,
        rtol=tolerance,
        atol=min(bound) if way == "quasi" else bound,
        max_steps=2000,
        throw=False,
    )


def _holds(mechanism: Mechanism, prepared: Prepared) -> bool:
    """Whether velocities satisfy all rows except void ones; if rows contradict, none can."""
    A, b, v = prepared.terms.A, prepared.terms.b, prepared.state.v
    void = np.array([row.role == "void" for row in mechanism.all_rows], bool)
    size = np.abs(A) @ np.abs(v) + np.abs(b)
    eps = float(jnp.finfo(mechanism.drawn.dtype).eps)
    return bool(np.all((np.abs(A @ v + b) <= eps**0.5 * size)[~void]))


def _end(mechanism: Mechanism, motion: jl.Solution) -> np.ndarray:
    units = np.array(mechanism.drawn.units)
    q, v = (np.asarray(x[-1], float) / units for x in (motion.q, motion.v))
    return np.concatenate([q, v])


def _solvable_at_end(mechanism: Mechanism, motion: jl.Solution) -> bool:
    """Whether the equations at the end of the motion also have a solution for certain."""
    q, v = (tuple(map(float, np.asarray(x))) for x in motion.last_state[:2])
    ended: Any = mechanism._replace(t=float(motion.last_time), q=q, v=v)
    try:
        return prepare(ended, 1).equations.outcome == "solution"
    except Unclear:
        return False
