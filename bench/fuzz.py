"""Lagrangians at random: the scalar program against the array program, derivatives included.

Systems of 1 to 5 coordinates with every kind of operation, energies of 1e-12 to 1e12 times the
usual size, coordinates in units of 1e-6 to 1e6, float32 and float64. Accelerations, their
derivatives in q, v and params, and second derivatives in q are compared at random states, near
zero and with equal coordinates. Two programs may differ by what a few roundings of their arguments
change. What differs more is made smaller and written down as source.
"""

from collections import Counter
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bench._harness import Report, Target
from bench._random_systems import Drawn, draw, smaller
from jaxlag._lowering import ArrayTerms, ScalarTerms

SECONDS = 900.0
SLACK = 1e3  # times what NUDGES nudges of a few roundings change, or roundings of the result
DERIVED = 1e5  # the same for derivatives: JAX's own of tan(tanh(x)) lose 5 digits near 0
NUDGES = 4
STATES = 4
QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
TOGETHER = 20  # programs that are kept at a time
SMALLEST = 60  # attempts to make a find smaller


class Compared(NamedTuple):
    """How one system compares.

    Attributes:
        kind: "equal", "differs", or why there is nothing to compare.
        worst: the largest difference over what is allowed.
        what: which derivative it is in.
    """

    kind: str
    worst: float = 0.0
    what: str = ""


def run(quick: bool, seconds: float | None = None, first: int = 0) -> Report:
    """Systems one after the other until the time is over."""
    if seconds is None:
        seconds = 20.0 if quick else SECONDS
    end = perf_counter() + seconds
    kinds: Counter[str] = Counter()
    finds, seed, worst = [], first, 0.0
    while perf_counter() < end:
        drawn = draw(seed)
        found = compared(drawn)
        kinds[found.kind] += 1
        if found.kind == "differs":
            finds.append(_written_down(seed, *_smallest(drawn, found)))
        else:
            worst = max(worst, found.worst)
        seed += 1
        if seed % TOGETHER == 0:
            jax.clear_caches()
    rows: list[dict[str, Any]] = [{"kind": k, "systems": n} for k, n in kinds.most_common()]
    rows.append({"kind": "worst of the equal, over the bound", "systems": worst})
    targets = [
        Target("systems that differ", float(kinds["differs"]), "<=", 0.0),
        Target("systems compared", float(kinds["equal"]), ">=", 0.0 if quick else 2000.0),
    ]
    return Report(rows + finds, targets, [], rows)


def compared(drawn: Drawn) -> Compared:
    """The scalar program of a system beside the array program, without compiling."""
    system = drawn.system
    dtype = jnp.dtype(drawn.dtype)
    leaves = {
        "a": jnp.asarray(drawn.params["a"], dtype),
        "b": jnp.asarray(drawn.params["b"], dtype),
    }
    params = leaves | {"k": _number(drawn)}
    arrays = ArrayTerms(system.lagrangian, system.forces)
    scalars = ScalarTerms(arrays, 1500)
    try:
        like = jax.ShapeDtypeStruct((drawn.n,), dtype)
        system.check_traceable(params, dtype, {})
    except (TypeError, ValueError):
        return Compared("no Lagrangian")
    lowered = scalars.lowered(like, params, {})
    if lowered.equations is None:
        return Compared(_reason(lowered.reason))
    return _judged(drawn, arrays, scalars, leaves)


def _number(drawn: Drawn) -> Any:
    """A number of Python's is double precision in a scalar program."""
    k = drawn.params["k"]
    return k if drawn.dtype == "float64" else jnp.asarray(k, drawn.dtype)


def _reason(said: str) -> str:
    for known in ("random states to compare", "operations", "weighted sums"):
        if known in said:
            return f"not used: {known}"
    if said.startswith("differs"):
        return "not used: differs where it was compared"
    return f"not used: {said.split(' at ')[0]}"


def _judged(drawn: Drawn, arrays: Any, scalars: Any, leaves: dict[str, Any]) -> Compared:
    dtype, n = jnp.dtype(drawn.dtype), drawn.n
    eps = float(jnp.finfo(dtype).eps)
    rng = np.random.default_rng(1)
    units = np.array(drawn.units).astype(dtype)
    parts = {"da/dq": slice(0, n), "da/dv": slice(n, 2 * n), "da/dparams": slice(2 * n, None)}

    def everything(terms: Any) -> Any:
        def a(x: Any) -> Any:
            """The acceleration in units, as a function of state in units and params in one row."""
            params = {"a": x[2 * n : -1], "b": x[-1], "k": _number(drawn)}
            q, v = units * x[:n], units * x[n : 2 * n]
            return terms.acceleration(jnp.asarray(0.3), q, v, params, {}) / units

        def of(x: Any) -> dict[str, Any]:
            value, push = jax.linearize(a, x)
            slopes = jax.vmap(push, out_axes=1)(jnp.eye(x.size, dtype=dtype))
            found = {"a": value} | {name: slopes[:, part] for name, part in parts.items()}
            if drawn.second:
                along = jnp.zeros_like(x).at[:n].set(jnp.linspace(0.5, 1.0, n, dtype=dtype))
                bent = jax.jacfwd(lambda x: jax.jvp(a, (x,), (along,))[1])(x)
                found["d2a/dq2"] = bent[:, :n]
            return found

        return jax.jit(jax.vmap(of), compiler_options=QUICKLY)

    q = rng.uniform(-1.5, 1.5, (STATES, n))
    v = rng.uniform(-1.5, 1.5, (STATES, n))
    q[-2] *= 1e-5  # near zero
    q[-1] = q[-1, 0]  # equal to one another
    known = np.concatenate([leaves["a"], leaves["b"][None]])
    exact = np.concatenate([q, v, np.tile(known, (STATES, 1))], axis=1).astype(dtype)
    signs = rng.choice([-2.0, 0.0, 2.0], (NUDGES, *exact.shape))
    nudged = np.concatenate([exact, *(exact * (1.0 + eps * s) for s in signs)]).astype(dtype)
    values = [everything(terms)(jnp.asarray(nudged)) for terms in (arrays, scalars)]
    worst, what = 0.0, ""
    for name in values[0]:
        shape = 1 + NUDGES, STATES
        right, found = (np.asarray(x[name], float).reshape(*shape, -1) for x in values)
        off = _off(right, found, eps, SLACK if name == "a" else DERIVED)
        if off > worst:
            worst, what = off, name
    return Compared("differs" if worst > 1.0 else "equal", worst, what)


def _off(right: np.ndarray, found: np.ndarray, eps: float, slack: float) -> float:
    """The largest difference over what is allowed; first axis: the state itself, then nudges."""
    states = right.shape[1]
    worst = 0.0
    for k in range(states):
        x, y = right[:, k], found[:, k]
        sound = np.isfinite(x[0]).all(), np.isfinite(y[0]).all()
        if not sound[0] or not sound[1]:
            # Where the array program overflows, or is undefined, the other need not be.
            worst = max(worst, np.inf if sound[0] and np.isfinite(x).all() else 0.0)
            continue
        spread = [np.nanmax(np.abs(z[1:] - z[0]), initial=0.0) for z in (x, y)]
        size = np.max(np.abs(x[0]), initial=0.0)
        allowed = slack * (max(spread) + eps * size) + np.finfo(float).tiny
        worst = max(worst, float(np.max(np.abs(y[0] - x[0]), initial=0.0) / allowed))
    return worst


def _smallest(drawn: Drawn, found: Compared) -> tuple[Drawn, Compared]:
    """A system in which the programs still differ, with as much left out as the tries allow."""
    tries, again = 0, True
    while again:
        again = False
        for other in smaller(drawn):
            tries += 1
            if tries > SMALLEST:
                return drawn, found
            try:
                now = compared(other)
            except Exception:  # left too little
                continue
            if now.kind == "differs":
                drawn, found, again = other, now, True
                break
    return drawn, found


def _written_down(seed: int, drawn: Drawn, found: Compared) -> dict[str, Any]:
    return {
        "kind": f"seed {seed}: {found.what} differs",
        "systems": found.worst,
        "lagrangian": drawn.lagrangian,
        "force": [str(x) for x in drawn.force],
        "params": str(drawn.params),
        "units": str(drawn.units),
        "dtype": drawn.dtype,
    }
