"""The library's programs for a mechanism compared with the reference: accelerations, multipliers.

The programs are those on arrays, on scalars with multipliers, by null spaces, and both programs in
quasi-velocities. Derivatives are compared along one direction in q, v and params that is tangent
to the constraints. If there is no solution, the results must not be finite.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bench.fuzz._comparison import SLACK, Compared, worst
from bench.fuzz._random_mechanisms import Mechanism, values
from bench.fuzz._reference_solution import Equations, Solved, Terms, Unclear, terms_of
from bench.fuzz._rounding import evaluated
from jaxlag._linalg._independent_rows import RowChoice
from jaxlag._lowering import ArrayProgram, ArrayTerms, Choices, QuasiState, ScalarProgram
from jaxlag._lowering import State as StateOfProgram

NUDGES = 4
NEARBY = 2  # nudged states, to distinguish a contradiction from rounding
MORE = 60  # nudged states if NUDGES of them show a difference
OPERATIONS = 3000


class State(NamedTuple):
    """A state and params, or a direction of these, in the system's precision."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    b: np.ndarray

    @property
    def size(self) -> int:
        """Number of numbers."""
        return sum(x.size for x in self)

    def nudged(self, eps: float, rng: np.random.Generator) -> "State":
        """Each number changed by a rounding error."""
        return State(*(x * (1.0 + eps * rng.uniform(-1.0, 1.0, x.shape)) for x in self))


class Prepared(NamedTuple):
    """A mechanism at its state, with the reference solution.

    Attributes:
        turning: size of v' at u' = 0 and of its derivative along the direction. Accelerations are
            the sum of it and of a part from u'; either part may be larger than the sum.
    """

    state: State
    direction: State
    terms: Terms
    rates: Terms
    equations: Equations
    right: Solved
    spread: list[Solved]
    dtype: str
    turning: tuple[float, float] = (0.0, 0.0)


def compared(mechanism: Mechanism, nudges: int = NUDGES) -> Compared:
    """Compare all programs of a mechanism with the reference."""
    try:
        prepared = prepare(mechanism, nudges)
    except Unclear as unclear:
        return Compared(f"not compared: {unclear}")
    found = _judged(mechanism, prepared)
    if found.kind == "differs" and nudges < MORE and np.isfinite(found.worst):
        return compared(mechanism, MORE)
    return found


def prepare(mechanism: Mechanism, nudges: int) -> Prepared:
    """A consistent state, a direction tangent to the constraints, and the solution.

    Raises:
        Unclear: whether there is a solution is uncertain.
    """
    drawn, rng = mechanism.drawn, np.random.default_rng(2)
    eps = float(jnp.finfo(drawn.dtype).eps)
    terms = terms_of(mechanism)

    def everything(q: Any, v: Any, a: Any, b: Any, *dots: Any) -> Any:
        def at(q: Any, v: Any, a: Any, b: Any) -> Any:
            params = values(drawn, np.float64) | {"a": a, "b": b}
            return terms(jnp.asarray(mechanism.t), q, v, params)

        return jax.jvp(at, (q, v, a, b), dots)

    given = [np.asarray(x, drawn.dtype).astype(float) for x in (mechanism.q, mechanism.v)]
    given += [np.asarray(values(drawn)[name]).astype(float) for name in ("a", "b")]
    state = State(*given)
    zero = State(*(0.0 * x for x in state))
    written = jax.make_jaxpr(everything)(*state, *zero)

    def run(state: State, dots: State, *noise: Any) -> tuple[Terms, Terms]:
        found = [np.asarray(x, float) for x in evaluated(written, [*state, *dots], *noise)]
        return Terms(*found[:5]), Terms(*found[5:])

    here, _ = run(state, zero)
    void = np.array([row.role == "void" for row in mechanism.all_rows], bool)
    units = np.array(drawn.units)
    if not np.all(np.isfinite(here.A)) or not np.all(np.isfinite(here.b)):
        raise Unclear("terms that are not finite")
    state = state._replace(v=_consistent(mechanism, here, void, units))
    here, _ = run(state, zero)
    near = [run(state.nudged(eps, rng), zero, eps, rng)[0] for _ in range(NEARBY)]
    equations = Equations(here, void, eps, near)
    if equations.outcome == "singular" and all(drawn.masses):  # as inertias differ in size
        raise Unclear("inertia that nearly vanishes")
    direction = _along(mechanism, state, here, run, equations, rng)
    here, rates = run(state, direction)
    if equations.outcome != "solution" or not all(np.all(np.isfinite(x)) for x in rates):
        nothing = Solved(*(np.zeros(0) for _ in range(4)))
        return Prepared(state, direction, here, rates, equations, nothing, [], drawn.dtype)
    right = equations.solve(here, rates)
    spread = []
    for _ in range(nudges):
        near = run(state.nudged(eps, rng), direction, eps, rng)
        if all(np.all(np.isfinite(x)) for part in near for x in part):
            spread.append(equations.solve(*near, rng))
    turning = _turning(mechanism, state, direction) / equations.units
    sizes = [float(np.max(np.abs(x), initial=0.0)) for x in turning]
    known = state, direction, here, rates, equations, right, spread, drawn.dtype
    return Prepared(*known, (sizes[0], max(sizes)))


def _turning(mechanism: Mechanism, state: State, direction: State) -> np.ndarray:
    """(v' at u' = 0, its derivative along the direction); zeros without quasi-velocities."""
    quasi, drawn = mechanism.quasi, mechanism.drawn
    if quasi is None or quasi.singular:
        return np.zeros((2, len(state.q)))
    given = quasi.declared
    t, free = jnp.asarray(mechanism.t), given.free

    def turning(q: Any, v: Any, a: Any, b: Any) -> Any:
        params = values(drawn, np.float64) | {"a": a, "b": b}
        u = given.full(given.of(t, q, v, params)[free])

        def velocity(t: Any, q: Any) -> Any:
            return given.velocities(t, q, u, params)

        return jax.jvp(velocity, (t, q), (jnp.ones_like(t), v))[1]

    def both(*args: Any) -> Any:
        return jax.jvp(turning, args[:4], args[4:])

    args = [*state, *direction]
    return np.stack(evaluated(jax.make_jaxpr(both)(*args), args))


def _consistent(mechanism: Mechanism, here: Terms, void: Any, units: Any) -> np.ndarray:
    """The consistent velocity nearest to the drawn one, in units, in the system's precision."""
    A, b = here.A[~void] * units, here.b[~void]
    size = np.linalg.norm(A, axis=1)
    size = np.where(size > 0, size, 1.0)
    A, b = A / size[:, None], b / size
    if mechanism.rest is not None:
        A = np.vstack([A, np.eye(len(units))[mechanism.rest]])
        b = np.append(b, 0.0)
    x = np.array(mechanism.v) / units
    for _ in range(2):
        x = x - np.linalg.lstsq(A, A @ x + b, rcond=1e-6)[0]
    if mechanism.rest is not None:
        x[mechanism.rest] = 0.0
    x[np.abs(x) < 1e3 * np.finfo(float).eps] = 0.0
    return (units * x).astype(mechanism.drawn.dtype).astype(float)


def _along(
    mechanism: Mechanism, state: State, here: Terms, run: Any, equations: Equations, rng: Any
) -> State:
    """A direction that preserves A v + b = 0 and phi = 0 of the base rows.

    It is drawn in units in which rows have length 1. So least squares do not drop short rows.
    """
    units, n = np.array(mechanism.drawn.units), len(state.q)
    base = equations.base
    holonomic = np.array([mechanism.all_rows[k].kind == "holonomic" for k in base], bool)
    A = here.A[base] * units
    size = np.linalg.norm(A, axis=1)
    A = A / size[:, None]
    da, db = rng.uniform(-1.0, 1.0, 3), np.asarray(rng.uniform(-1.0, 1.0) * state.b)
    if np.any(holonomic):  # phi = 0 holds for these params only
        da, db = 0.0 * da, 0.0 * db
    x = rng.uniform(-1.0, 1.0, n)
    if np.any(holonomic):
        x = x - np.linalg.lstsq(A[holonomic], A[holonomic] @ x, rcond=1e-9)[0]
    dots = State(units * x, 0.0 * state.v, da, db)
    _, rates = run(state, dots)
    moved = (rates.A @ state.v + rates.b)[base] / size
    y = rng.uniform(-1.0, 1.0, n)
    if len(base):
        y = y - np.linalg.lstsq(A, A @ y + moved, rcond=1e-9)[0]
    return dots._replace(v=units * y)


def programs(mechanism: Mechanism, prepared: Prepared) -> dict[str, Any]:
    """Functions of (t, q, v, params) that return a, or (a, lam), by name."""
    system = mechanism.system
    array = ArrayTerms(system.lagrangian, system.forces, system.constraints)
    selected = np.isin(np.arange(len(mechanism.all_rows)), prepared.equations.base)
    choice = RowChoice(jnp.asarray(selected), jnp.asarray(~prepared.equations.void))

    def by(program: Any) -> Any:
        def a(t: Any, q: Any, v: Any, params: Any) -> Any:
            return program.acceleration(StateOfProgram(t, q, v, params, {}), None, choice)

        return a

    found: dict[str, Any] = {"arrays": lambda t, q, v, p: array.reactions(t, q, v, p, {})}
    if mechanism.quasi is not None:
        return found | _in_quasi(mechanism, choice)
    if prepared.equations.outcome == "contradictory":
        return found  # the others solve with the given rows only
    found["scalars"] = by(ScalarProgram(array, OPERATIONS))
    if round(1e3 * mechanism.t) % 3 == 0:  # for a third of the systems
        given = system.lagrangian, system.forces, system.constraints
        found["null space"] = by(ArrayProgram(ArrayTerms(*given, "null_space")))
    return found


def _in_quasi(mechanism: Mechanism, choice: RowChoice) -> dict[str, Any]:
    """The programs of quasi-velocities."""
    system = mechanism.system
    quasi = system.quasi
    assert quasi is not None
    given = system.lagrangian, system.forces, system.constraints
    terms = ArrayTerms(*given, quasi=quasi, in_u=system._in_u)
    scalars = ScalarProgram(terms, OPERATIONS)

    def speeds(t: Any, q: Any, v: Any, params: Any) -> Any:
        return quasi.of(t, q, v, params)[quasi.free]

    def projected(t: Any, q: Any, v: Any, params: Any) -> Any:
        w = speeds(t, q, v, params)
        moving = QuasiState(terms, t, q, w, params, {})
        if system.constraints:
            found = moving.reactions()
        else:
            found = (moving.velocity_rate(moving.accelerations()),)
        regular = quasi.regular(t, q, params)
        return tuple(jnp.where(regular, x, jnp.nan) for x in found)

    def straight(t: Any, q: Any, v: Any, params: Any) -> Any:
        """v' = B u' + s, from the rates (v, u') of the scalar program."""
        w = speeds(t, q, v, params)
        prepared: Any = scalars.precompute(
            q, params, {}, Choices(active_rows=choice.active_rows, multiplier_rows=choice)
        )
        rates = scalars.quasi_rates(StateOfProgram(t, q, w, params, {}), prepared)
        du = rates[q.shape[0] :]

        def velocity(t: Any, q: Any, w: Any) -> Any:
            return quasi.velocities(t, q, quasi.full(w), params)

        return jax.jvp(velocity, (t, q, w), (jnp.ones_like(t), v, du))[1]

    if mechanism.quasi is not None and mechanism.quasi.singular:
        return {"quasi, arrays": projected}  # motions check this before the scalar program runs
    return {"quasi, arrays": projected, "quasi, scalars": straight}


def has_scalars(mechanism: Mechanism, name: str) -> bool:
    """Whether there is a scalar program of this name."""
    system, dtype = mechanism.system, jnp.dtype(mechanism.drawn.dtype)
    given = system.lagrangian, system.forces, system.constraints
    if name == "scalars":
        terms = ArrayTerms(*given)
    else:
        terms = ArrayTerms(*given, quasi=system.quasi, in_u=system._in_u)
    like = jax.ShapeDtypeStruct((mechanism.drawn.n,), dtype)
    scalars = ScalarProgram(terms, OPERATIONS)
    return scalars.lowered(like, values(mechanism.drawn), {}).equations is not None


def _judged(mechanism: Mechanism, prepared: Prepared) -> Compared:
    outcome, differences = prepared.equations.outcome, {}
    for name, program in programs(mechanism, prepared).items():
        if name.endswith("scalars") and not has_scalars(mechanism, name):
            continue
        results = _evaluated(mechanism, program, prepared)
        singular = mechanism.quasi is not None and mechanism.quasi.singular
        refused = outcome != "solution" or (singular and name.startswith("quasi"))
        if refused:
            number = np.all(np.isfinite(results["a"]))
            why = "singular kinematics" if outcome == "solution" else outcome
            differences[f"{name}: a number where rows or masses are {why}"] = (
                np.inf if number else 0.0
            )
            continue
        bent = any(row.role == "bent" for row in mechanism.rows)
        for what, off in _off(results, prepared, bent).items():
            differences[f"{name}: {what}"] = off
    differences = {name: 0.0 if np.isnan(x) else x for name, x in differences.items()}
    found = worst(differences)
    return found if found.kind == "differs" else Compared("equal", found.worst, found.what)


def _evaluated(mechanism: Mechanism, program: Any, prepared: Prepared) -> dict[str, np.ndarray]:
    """The results of a program in double precision, by name."""
    drawn = mechanism.drawn
    dtype = jnp.dtype(drawn.dtype)

    def everything(q: Any, v: Any, a: Any, b: Any, *dots: Any) -> Any:
        def at(q: Any, v: Any, a: Any, b: Any) -> Any:
            params = values(drawn) | {"a": a, "b": b}
            found = program(jnp.asarray(mechanism.t, jnp.float64), q, v, params)
            found = found if isinstance(found, tuple) else (found,)
            return dict(zip(("a", "lam"), found, strict=False))

        return jax.jvp(at, (q, v, a, b), dots)

    args = [np.asarray(x, dtype) for x in (*prepared.state, *prepared.direction)]
    written, shapes = jax.make_jaxpr(everything, return_shape=True)(*args)
    found = evaluated(written, args)
    found = jax.tree.unflatten(jax.tree.structure(shapes), found)
    names = [dict(found[0]), {f"d{name}": x for name, x in found[1].items()}]
    return {name: np.asarray(x, float) for part in names for name, x in part.items()}


def _off(
    results: dict[str, np.ndarray], prepared: Prepared, bent: bool = False
) -> dict[str, float]:
    """Differences divided by the allowed ones, in units of inertias and rows.

    If the rank drops at this state alone (`bent`), derivatives do not exist.
    """
    equations, right = prepared.equations, prepared.right
    roles = {"a": "a", "lam": "mu", "da": "da", "dlam": "dmu"}
    found = {}
    for name, of in roles.items():
        expected = getattr(right, of)
        derived = name.startswith("d")
        size = max(right.dsize if derived else right.size, prepared.turning[derived])
        if name not in results or (bent and name.startswith("d")):
            continue
        x = results[name]
        # Values below the smallest numbers of the precision count as zero.
        least = float(jnp.finfo(prepared.dtype).tiny) / equations.eps
        if of.endswith("a"):
            x = x / equations.units
            least = least / np.min(equations.units)
        else:
            least = least * np.max(equations.lengths, initial=0.0)
            known = np.where(equations.void, x, 0.0)
            if np.any(known != 0.0):
                found[f"{name} of a row that says nothing"] = np.inf
            x = np.where(equations.void, 0.0, x * equations.lengths)
        if not np.all(np.isfinite(x)):
            found[f"{name} is no number"] = np.inf
            continue
        several = [np.max(np.abs(getattr(s, of) - expected), initial=0.0) for s in prepared.spread]
        allowed = SLACK * (max(several, default=0.0) + equations.eps * size) + least
        off = float(np.max(np.abs(x - expected), initial=0.0))
        found[name] = off / allowed
    return found
