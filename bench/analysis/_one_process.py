"""A of one scene on one side in a fresh process: `python _one_process.py SIDE SCENE`.

The process prints one line of JSON: seconds to the first A beyond imports, microseconds of later
ones, and A. Libraries are imported inside functions, where this is timed.
"""

import json
import sys
from collections.abc import Callable, Sequence
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

SIDES = ("jaxlag", "differences", "sympy")
RUNS, ENOUGH_S = 200, 2.0
H = np.finfo(float).eps ** (1 / 3)
"""Step of central differences, over 1 + the size of the state."""


def main(arguments: Sequence[str]) -> None:
    """Linearize one scene on one side."""
    side, scene = arguments
    start, later = MAKERS[side](scene)
    begin = perf_counter()
    A = start()
    first = perf_counter() - begin
    later()  # compiles, where the first one has not
    samples: list[float] = []
    while len(samples) < RUNS and sum(samples) < ENOUGH_S:
        begin = perf_counter()
        later()
        samples.append(perf_counter() - begin)
    answer = {"first_s": first, "later_us": 1e6 * median(samples), "A": np.asarray(A).tolist()}
    print(json.dumps(answer))


Calls = tuple[Callable[[], Any], Callable[[], Any]]


def _declared(scene: str) -> tuple[Any, np.ndarray, np.ndarray, Any, Any]:
    """(system, q, v, params, independent states)."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import jaxlag as jl
    from bench.analysis._scenes import BICYCLE, SCENES

    jax.block_until_ready(jnp.zeros(3) + 1.0)  # initializes the backend
    if scene == BICYCLE:
        from bench.mechanisms._bicycle import BICYCLE as PARAMS
        from bench.mechanisms._scenes import SCENES as MECHANISMS

        v = np.zeros(8)
        v[[0, 6, 7]] = 5.0, -5.0 / PARAMS["r_rear"], -5.0 / PARAMS["r_front"]
        system = MECHANISMS[BICYCLE]().system()
        return system, np.zeros(8), v, PARAMS, None
    declared = SCENES[scene]()
    constraints = []
    if (phi := declared.phi) is not None:
        of = lambda t, q, p: jnp.stack(phi(jnp, q))  # noqa: E731
        constraints.append(jl.Holonomic(of, "phi"))
    if (rows := declared.rows) is not None:
        rolling = lambda t, q, v, p: jnp.stack(rows(jnp, q, v))  # noqa: E731
        constraints.append(jl.Pfaffian(rolling, "rows"))
    lagrangian = lambda t, q, v, p: declared.lagrangian(jnp, q, v)  # noqa: E731
    system = jl.System(lagrangian, declared.names, constraints=tuple(constraints))
    return system, declared.q, declared.v, None, declared.independent


def of_jaxlag(scene: str) -> Calls:
    """jl.linearize with all of its checks; later ones compiled, in params or state."""
    system, q, v, params, independent = _declared(scene)
    import jax
    import jax.numpy as jnp

    import jaxlag as jl

    found: dict[str, Any] = {}
    state = jnp.asarray(q), jnp.asarray(v)

    def first() -> Any:
        linear = jl.linearize(system, q, v, params, independent=independent)
        names = linear.states
        of = lambda q, v: jl.linearize(system, q, v, params, independent=names).A  # noqa: E731
        found["program"] = jax.jit(of)
        return np.asarray(linear.A)

    def later() -> Any:
        return found["program"](*state).block_until_ready()

    return first, later


def differences(scene: str) -> Calls:
    """Central differences of compiled accelerations along the directions of the states.

    The directions are those of jaxlag, which are not timed: only the accelerations are.
    """
    system, q, v, params, independent = _declared(scene)
    import jax
    import jax.numpy as jnp

    import jaxlag as jl

    linear = jl.linearize(system, q, v, params, independent=independent)
    n, labels = len(q), linear.coordinates
    basis = jnp.asarray(linear.basis)
    places = [labels.index(x.rstrip("'")) + n * x.endswith("'") for x in linear.states]
    z = jnp.concatenate([jnp.asarray(q), jnp.asarray(v)])
    h = H * (1.0 + float(jnp.max(jnp.abs(z))))

    def rates(z: Any) -> Any:
        a = system.acceleration(z[:n], z[n:], params)
        return jnp.concatenate([z[n:], a])[jnp.asarray(places)]

    @jax.jit
    def of(z: Any, basis: Any) -> Any:
        moved = jax.vmap(rates)(jnp.concatenate([z + h * basis.T, z - h * basis.T]))
        k = basis.shape[1]
        return (moved[:k] - moved[k:]).T / (2 * h)

    system = _declared(scene)[0]  # nothing of it is derived or compiled
    run = lambda: of(z, basis).block_until_ready()  # noqa: E731
    return run, run


def of_sympy(scene: str) -> Calls:
    """LagrangesMethod and its linearizer; later ones as a compiled function are not made."""
    import sympy as sp
    from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

    from bench.analysis._scenes import SCENES

    declared = SCENES[scene]()
    q = [dynamicsymbols(name) for name in declared.names]
    t = dynamicsymbols._t
    v = [x.diff(t) for x in q]
    point = dict(zip(q, map(float, declared.q), strict=True))
    point |= dict(zip(v, map(float, declared.v), strict=True))

    def first() -> Any:
        options = {}
        if declared.phi is not None:
            options["hol_coneqs"] = list(declared.phi(sp, q))
        if declared.rows is not None:
            options["nonhol_coneqs"] = list(declared.rows(sp, q, v))
        method = LagrangesMethod(declared.lagrangian(sp, q, v), q, **options)
        method.form_lagranges_equations()
        names = [*declared.names, *(f"{name}'" for name in declared.names)]
        states = declared.independent or tuple(names)
        kept = [x for x, name in zip(q + v, names, strict=True) if name in states]
        chosen = {"q_ind": [x for x in q if x in kept], "qd_ind": [x for x in v if x in kept]}
        chosen["q_dep"] = [x for x in q if x not in kept] or None
        chosen["qd_dep"] = [x for x in v if x not in kept] or None
        accelerations = _accelerations(method, point, v, t)
        A = method.linearize(op_point=[accelerations, point], A_and_B=True, **chosen)[0]
        return np.array(A.subs(accelerations).subs(point).evalf(), float)

    return first, first


def _accelerations(method: Any, point: Any, v: Any, t: Any) -> dict[Any, float]:
    """Accelerations and multipliers at the state, by symbol, which its linearizer asks for."""
    n, values = len(v), {}
    if method.coneqs:
        values = {x: float(lam) for x, lam in method.solve_multipliers(op_point=point).items()}
    M = np.array(method.mass_matrix_full.subs(point), float)
    right = np.array(method.forcing_full.subs(point), float)
    found = np.linalg.solve(M, right)[n : 2 * n, 0]
    values |= {x.diff(t): float(a) for x, a in zip(v, found, strict=True)}
    return values


MAKERS: dict[str, Callable[[str], Calls]] = {
    "jaxlag": of_jaxlag,
    "differences": differences,
    "sympy": of_sympy,
}


if __name__ == "__main__":
    main(sys.argv[1:])
