"""The scalar program of a system compared with its array program, with derivatives.

Accelerations, their derivatives in q, v and params, and second derivatives in q are compared at
random states, near zero and with equal coordinates. The allowed difference is the change of the
array program's results by other rounding errors of its arguments and operations (`_rounding.py`).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.fuzz._comparison import DIFFERS, EQUAL, SLACK, Compared
from bench.fuzz._random_systems import Drawn
from bench.fuzz._rounding import evaluated
from jaxlag._lowering import ArrayProgram, ArrayTerms, ScalarProgram, State
from jaxlag._system._inspection import check_traceable
from jaxlag._tracing._input_values import InputValues

NUDGES = 4  # runs with other rounding errors
MORE = 60  # runs if these show a difference: a `floor` may jump at one rounding in ten
STATES = 4


def compared(drawn: Drawn) -> Compared:
    """Compare the scalar program of a system with its array program."""
    system = drawn.system
    dtype = jnp.dtype(drawn.dtype)
    leaves = {
        "a": jnp.asarray(drawn.params["a"], dtype),
        "b": jnp.asarray(drawn.params["b"], dtype),
    }
    params = leaves | {"k": _number(drawn)}
    terms = ArrayTerms(system.lagrangian, system.forces)
    arrays, scalars = ArrayProgram(terms), ScalarProgram(terms, 1500)
    try:
        like = jax.ShapeDtypeStruct((drawn.n,), dtype)
        check_traceable(system, params, dtype, InputValues({}))
    except (TypeError, ValueError):
        return Compared("no Lagrangian")
    lowered = scalars.lowered(like, params, {})
    if lowered.equations is None:
        return Compared(_reason(lowered.reason))
    found = _judged(drawn, arrays, scalars, leaves, NUDGES)
    return found if found.kind == EQUAL else _judged(drawn, arrays, scalars, leaves, MORE)


def _number(drawn: Drawn) -> Any:
    """The param `k`; in float32 an array, as scalar programs use doubles for Python numbers."""
    k = drawn.params["k"]
    return k if drawn.dtype == "float64" else jnp.asarray(k, drawn.dtype)


def _reason(reason: str) -> str:
    for known in ("random states to compare", "operations", "weighted sums"):
        if known in reason:
            return f"not used: {known}"
    if reason.startswith("differs"):
        return "not used: differs where it was compared"
    return f"not used: {reason.split(' at ')[0]}"


def _judged(
    drawn: Drawn, arrays: Any, scalars: Any, leaves: dict[str, Any], nudges: int
) -> Compared:
    dtype, n = jnp.dtype(drawn.dtype), drawn.n
    eps = float(jnp.finfo(dtype).eps)
    rng = np.random.default_rng(1)
    units = np.array(drawn.units).astype(dtype)
    parts = {"da/dq": slice(0, n), "da/dv": slice(n, 2 * n), "da/dparams": slice(2 * n, None)}

    def everything(program: Any) -> Any:
        def a(x: Any) -> Any:
            """Acceleration in units, as a function of one vector: state in units, then params."""
            params = {"a": x[2 * n : -1], "b": x[-1], "k": _number(drawn)}
            q, v = units * x[:n], units * x[n : 2 * n]
            return program.acceleration(State(jnp.asarray(0.3), q, v, params, {})) / units

        def of(x: Any) -> dict[str, Any]:
            value, jvp_fn = jax.linearize(a, x)
            slopes = jax.vmap(jvp_fn, out_axes=1)(jnp.eye(x.size, dtype=dtype))
            found = {"a": value} | {name: slopes[:, part] for name, part in parts.items()}
            if drawn.second:
                along = jnp.zeros_like(x).at[:n].set(jnp.linspace(0.5, 1.0, n, dtype=dtype))
                bent = jax.jacfwd(lambda x: jax.jvp(a, (x,), (along,))[1])(x)
                found["d2a/dq2"] = bent[:, :n]
            return found

        return jax.vmap(of)

    q = rng.uniform(-1.5, 1.5, (STATES, n))
    v = rng.uniform(-1.5, 1.5, (STATES, n))
    q[-2] *= 1e-5  # near zero
    q[-1] = q[-1, 0]  # equal to one another
    known = np.concatenate([leaves["a"], leaves["b"][None]])
    exact = np.concatenate([q, v, np.tile(known, (STATES, 1))], axis=1).astype(dtype)
    written, shapes = jax.make_jaxpr(everything(arrays), return_shape=True)(exact)
    right = [evaluated(written, [exact])]
    for _ in range(nudges):
        nudged = exact * (1.0 + eps * rng.uniform(-1.0, 1.0, exact.shape))
        right.append(evaluated(written, [nudged.astype(dtype)], eps, rng))
    found = evaluated(jax.make_jaxpr(everything(scalars))(exact), [exact])
    several = [[np.asarray(x, float).reshape(STATES, -1) for x in run] for run in right]
    worst, what = 0.0, ""
    for k, name in enumerate(shapes):
        y = np.asarray(found[k], float).reshape(STATES, -1)
        off = _off(np.stack([x[k] for x in several]), y, several[0][0], eps)
        if off > worst:
            worst, what = off, name
    return Compared(DIFFERS if worst > 1.0 else EQUAL, worst, what)


def _off(right: np.ndarray, found: np.ndarray, a: np.ndarray, eps: float) -> float:
    """The largest difference divided by the allowed one.

    Derivatives are per unit of a coordinate. They need not be more accurate than the rounding
    error of the acceleration.

    Args:
        right: from the array program, (1 + nudges, STATES, entries): without nudges, then nudged.
        found: from the scalar program, (STATES, entries).
        a: the acceleration, (STATES, n).
        eps: machine precision of the numbers.
    """
    worst = 0.0
    for k, y in enumerate(found):
        x = right[:, k]
        if not np.isfinite(x[0]).all() or not np.isfinite(y).all():
            # If the array program overflows or is undefined, the scalar program may be finite.
            worst = max(worst, np.inf if np.isfinite(x).all() else 0.0)
            continue
        spread = np.nanmax(np.abs(x[1:] - x[0]), initial=0.0)
        size = max(np.max(np.abs(x[0]), initial=0.0), np.nanmax(np.abs(a[k]), initial=0.0))
        allowed = SLACK * (spread + eps * size) + np.finfo(float).tiny
        worst = max(worst, float(np.max(np.abs(y - x[0]), initial=0.0) / allowed))
    return worst
