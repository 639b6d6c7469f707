"""One program from the start of a process to its result: `python _one_process.py SCENE CASE`.

The process prints one line of JSON. Libraries are imported inside functions, where this is timed.
"""

import json
import sys
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

ROWS, TOLERANCE = 101, 1e-9
OPTIONS: dict[str, dict[str, Any]] = {
    "solve": {},
    "null_space": {"formulation": "null_space"},
    "kvaerno5": {"method": "kvaerno5", "rtol": 1e-6, "atol": 1e-6},
    "variational4": {"method": "variational4", "rtol": None, "atol": None},
}
CASES = (*OPTIONS, "explain", "gradient", "acceleration", "assemble", "by hand", "sympy", "mujoco")
EVALUATIONS, SMALL_STEP = 2000, 1e-9
ENOUGH_S, ENOUGH_RUNS = 1.0, 200


def main(arguments: Sequence[str]) -> None:
    """Time one program."""
    scene, case = arguments
    begin = perf_counter()
    import jaxlag  # noqa: F401

    import_s = perf_counter() - begin
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.block_until_ready(jax.numpy.zeros(3) + 1.0)  # initializes the backend
    from bench.mechanisms._scenes import SCENES

    print(json.dumps({"import_s": import_s, **measured(SCENES[scene](), case)}))


def measured(scene: Any, case: str) -> dict[str, Any]:
    """The columns of one case."""
    measure = {"explain": explain, "gradient": gradient, "by hand": by_hand, "sympy": by_sympy,
               "acceleration": acceleration, "assemble": assemble, "mujoco": by_mujoco}  # fmt: skip
    return measure[case](scene) if case in measure else solve(scene, case)


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    import jax

    begin = perf_counter()
    found = jax.block_until_ready(call())
    return perf_counter() - begin, found


def _shortest_ms(call: Callable[[], Any]) -> float:
    runs: list[float] = []
    while len(runs) < 3 or (sum(runs) < ENOUGH_S and len(runs) < ENOUGH_RUNS):
        runs.append(_timed(call)[0])
    return 1e3 * min(runs)


def _first_and_run(call: Callable[[], Any]) -> tuple[dict[str, float], Any]:
    first_s, found = _timed(call)
    return {"first_s": first_s, "run_ms": _shortest_ms(call)}, found


def _listed(x: Any) -> list[float]:
    import numpy as np

    return np.ravel(np.asarray(x, float)).tolist()


def _times(scene: Any) -> Any:
    import numpy as np

    return np.linspace(0.0, scene.t1, ROWS)


def solve(scene: Any, case: str) -> dict[str, Any]:
    """jaxlag: a whole motion."""
    import jax

    import jaxlag as jl

    options = {"rtol": TOLERANCE, "atol": TOLERANCE, **OPTIONS[case]}
    if case == "variational4":
        options["dt"] = scene.dt
    system, ts = scene.system(), _times(scene)
    found = {}

    def call() -> Any:
        found["motion"] = jl.simulate(system, scene.q0, scene.v0, ts, scene.params, **options)
        return found["motion"].q

    try:
        times, q = _first_and_run(call)
    except (ValueError, jl.IncompleteSolutionError) as error:
        return {"refused": str(error).splitlines()[0]}
    steps = int(jax.numpy.asarray(found["motion"].stats["accepted"]))
    answer = {**times, "steps": steps, "end": _listed(scene.seen(q[-1]))}
    return answer | (evaluation(scene, system) if case == "solve" else {})


def evaluation(scene: Any, system: Any) -> dict[str, Any]:
    """Nanoseconds of an evaluation, in a loop of steps v += h a, q += h v; operations; a."""
    from dataclasses import replace

    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxlag._integration._vector_field import VectorField
    from jaxlag._tracing import _params

    held, static = _params.split(scene.params)
    quasi = "quasi" if scene.quasi is not None else "multipliers"
    mass = np.linalg.eigvalsh(np.asarray(system.mass_matrix(scene.q0, params=scene.params)))
    regular = bool(mass[0] > 1e-10 * mass[-1])
    n, w0 = len(scene.names), scene.v0
    if scene.quasi is not None:
        u = scene.quasi.of(jnp.zeros(()), *map(jnp.asarray, (scene.q0, w0)), scene.params)
        w0 = np.asarray(u)[scene.quasi.free]
    ts = jnp.array([0.0, scene.t1])

    def start(y: Any, held: Any) -> Any:
        dynamics = VectorField(
            system, _params.Static(static), _params.Static({}), 1, None, _params.sample(held),
            in_loop=True,
            formulation=quasi, stabilization="projection", regular=regular,
        )  # fmt: skip
        args = dynamics.arguments(held, {}, ts)
        dynamics = replace(dynamics, rows=system._rows(scene.params, y.dtype))
        return dynamics, dynamics.precompute(jnp.zeros(()), y, args)

    def run(y: Any, held: Any, count: Any) -> Any:
        dynamics, args = start(y, held)

        def step(_: Any, y: Any) -> Any:
            if scene.quasi is not None:
                return y + SMALL_STEP * dynamics._quasi_rates(jnp.zeros(()), y, args)
            w = y[n:] + SMALL_STEP * dynamics.acceleration(jnp.zeros(()), y, args)
            return jnp.concatenate([y[:n] + SMALL_STEP * w, w])

        return jax.lax.fori_loop(0, count, step, y)

    y0 = jnp.concatenate([jnp.asarray(scene.q0), jnp.asarray(w0)])
    program = jax.jit(run).lower(y0, held, EVALUATIONS).compile()
    few, many = (
        _shortest_ms(lambda count=count: program(y0, held, count))
        for count in (EVALUATIONS, 2 * EVALUATIONS)
    )
    program = system._program
    lines = program.lines(jnp.asarray(scene.q0), scene.params, {})
    a = np.asarray(system.acceleration(scene.q0, scene.v0, scene.params))
    return {
        "evaluation_ns": 1e6 * (many - few) / EVALUATIONS,
        "operations": lines,
        "acceleration": a.tolist(),
    }


def gradient(scene: Any) -> dict[str, Any]:
    """jaxlag: the gradient of a squared norm of the end in all params."""
    import jax
    import jax.flatten_util
    import jax.numpy as jnp
    import numpy as np

    import jaxlag as jl

    system, ts = scene.system(), _times(scene)[[0, -1]]

    def squared(params: Any) -> Any:
        motion = jl.simulate(
            system, scene.q0, scene.v0, ts, params, rtol=TOLERANCE, atol=TOLERANCE, throw=False
        )
        return jnp.sum(motion.q[-1] ** 2)

    params = jax.tree.map(jnp.asarray, dict(scene.params))
    program = jax.jit(jax.grad(squared))
    times, found = _first_and_run(lambda: program(params))
    flat, unflatten = jax.flatten_util.ravel_pytree(params)
    keeps = np.ones(flat.size, bool)  # the others would make the start inconsistent
    if scene.phi is not None:
        slopes = jax.jacfwd(lambda p: scene.phi(0.0, jnp.asarray(scene.q0), unflatten(p)))(flat)
        keeps = np.all(np.asarray(slopes).reshape(-1, flat.size) == 0.0, axis=0)
    direction = flat * jnp.linspace(-1.0, 1.0, flat.size) * keeps
    along, h = jax.flatten_util.ravel_pytree(found)[0] @ direction, 1e-4
    plain = jax.jit(squared)
    ahead, back = (plain(unflatten(flat + s * direction)) for s in (h, -h))
    slope = float(ahead - back) / (2.0 * h)
    solve_ms = _shortest_ms(lambda: plain(params))
    return {**times, "solve_ms": solve_ms, "along": float(along), "difference": slope}


def explain(scene: Any) -> dict[str, Any]:
    """jaxlag: the derivation, and its report."""
    system = scene.system()
    return {"first_s": _timed(lambda: len(system.explain(scene.params)))[0]}


def acceleration(scene: Any) -> dict[str, Any]:
    """jaxlag: accelerations at one state."""
    system = scene.system()
    times, _ = _first_and_run(lambda: system.acceleration(scene.q0, scene.v0, scene.params))
    return times


def assemble(scene: Any) -> dict[str, Any]:
    """jaxlag: the start made consistent, from a disturbed one."""
    import jaxlag as jl

    system, q0, v0 = scene.system(), scene.q0 + 0.01, scene.v0 + 0.01
    times, _ = _first_and_run(lambda: jl.assemble(system, q0, v0, scene.params).q)
    return times


def by_hand(scene: Any) -> dict[str, Any]:
    """Derivatives of L and a dense solve in JAX, diffrax."""
    import jax
    import jax.numpy as jnp

    from bench.mechanisms import _by_hand

    params = jax.tree.map(jnp.asarray, dict(scene.params))
    y0 = jnp.concatenate([jnp.asarray(scene.q0), jnp.asarray(scene.v0)])
    program = _by_hand.solve(scene, _times(scene), TOLERANCE)
    times, q = _first_and_run(lambda: program(y0, params))
    return {**times, "end": _listed(scene.seen(q[-1]))}


def by_sympy(scene: Any) -> dict[str, Any]:
    """Derivation and code by sympy, a motion by scipy; an evaluation in C."""
    from tempfile import TemporaryDirectory

    import numpy as np
    from scipy.integrate import solve_ivp

    from bench.mechanisms import _sympy

    y0, ts, params = np.concatenate([scene.q0, scene.v0]), _times(scene), _sympy.numbers(scene)
    begin = perf_counter()
    code = _sympy.derived(scene)
    field = _sympy.in_python(code, params)
    derive_s = perf_counter() - begin

    def call() -> Any:
        return solve_ivp(
            field, (0.0, scene.t1), y0, method="DOP853", rtol=TOLERANCE, atol=TOLERANCE, t_eval=ts
        ).y

    first_s, y = _timed(call)
    with TemporaryDirectory() as folder:
        in_c = _sympy.InC(code, params, folder)
        few, many = (
            _shortest_ms(lambda count=count: in_c.steps(y0, SMALL_STEP, count))
            for count in (EVALUATIONS, 2 * EVALUATIONS)
        )
        a = in_c.acceleration(y0)
    return {
        "first_s": derive_s + first_s,
        "run_ms": 1e3 * _timed(call)[0],
        "evaluation_ns": 1e6 * (many - few) / EVALUATIONS,
        "end": _listed(scene.seen(y[: y0.size // 2, -1])),
        "acceleration": a.tolist(),
    }


def by_mujoco(scene: Any) -> dict[str, Any]:
    """MuJoCo's accelerations, in its Runge-Kutta steps of four evaluations."""
    from bench.mechanisms import _mujoco

    step, a = _mujoco.arm(scene, SMALL_STEP)
    few, many = (
        _shortest_ms(lambda count=count: step(count)) for count in (EVALUATIONS, 2 * EVALUATIONS)
    )
    return {"evaluation_ns": 1e6 * (many - few) / EVALUATIONS / 4.0, "acceleration": a.tolist()}


if __name__ == "__main__":
    main(sys.argv[1:])
