"""One program from the start of a process to its result: `python _one_process.py SIDE SCENE CASE`.

The process prints one line of JSON. Libraries are imported inside functions, where this is timed.
"""

import json
import sys
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

SIDES = ("jaxlag", "diffrax", "heyoka")
CASES = ("2 rows", "101 rows", "grad", "vmap of 256", "vmap of grad")
LANES = 256
TOLERANCE = 1e-9
ENOUGH_S, ENOUGH_RUNS = 1.0, 200
EVENTS = {
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower_s",
    "/jax/core/compile/backend_compile_duration": "compile_s",
}


def main(arguments: Sequence[str]) -> None:
    """Time one program on one side."""
    side, scene, case = arguments
    answer = of_heyoka(scene) if side == "heyoka" else of_jax(side, scene, case)
    print(json.dumps(answer))


def of_jax(side: str, scene: str, case: str) -> dict[str, Any]:
    """Seconds from a declared motion to its first result, with their parts, and the result."""
    begin = perf_counter()
    import jaxlag  # noqa: F401

    import_s = perf_counter() - begin
    import jax

    jax.config.update("jax_enable_x64", True)
    from bench._problems.declared_scenes import BEGINNINGS
    from jaxlag._lowering import _scalar_program

    motion = BEGINNINGS[scene]()
    jax.block_until_ready(jax.numpy.zeros(3) + 1.0)  # initializes the backend
    spent = {"derive_s": 0.0, "lower_s": 0.0, "compile_s": 0.0}

    def listen(event: str, seconds: float, **_: Any) -> None:
        if event in EVENTS:
            spent[EVENTS[event]] += seconds

    jax.monitoring.register_event_duration_secs_listener(listen)
    lower = _scalar_program.lower

    def timed(*args: Any) -> Any:
        begin = perf_counter()
        try:
            return lower(*args)
        finally:
            spent["derive_s"] += perf_counter() - begin

    _scalar_program.lower = timed
    solve, y0 = (_jaxlag if side == "jaxlag" else _diffrax)(motion, case)
    call = _program(solve, y0, _numbers(motion), case)
    begin = perf_counter()
    end = jax.block_until_ready(call())
    first_s = perf_counter() - begin
    return {"import_s": import_s, "first_s": first_s, **spent, **_ran(call, jax), "end": _flat(end)}


def _ran(call: Callable[[], Any], jax: Any) -> dict[str, float]:
    runs: list[float] = []
    while len(runs) < 3 or (sum(runs) < ENOUGH_S and len(runs) < ENOUGH_RUNS):
        begin = perf_counter()
        jax.block_until_ready(call())
        runs.append(perf_counter() - begin)
    return {"run_ms": 1e3 * min(runs)}


def _flat(end: Any) -> list[float]:
    import numpy as np

    return np.ravel(np.asarray(end, float)).tolist()


def _numbers(motion: Any) -> dict[str, Any]:
    import jax.numpy as jnp

    return {name: jnp.asarray(value, float) for name, value in motion.params.items()}


def _program(solve: Callable, y0: Any, params: Any, case: str) -> Callable[[], Any]:
    """Final coordinates, or the gradient of their squared norm, from solve(y0, params)."""
    import jax
    import jax.numpy as jnp

    def gradient(y0: Any) -> Any:
        squared = lambda inputs: jnp.sum(solve(*inputs)[-1] ** 2)  # noqa: E731
        return jax.grad(squared)((y0, params))[0]

    starts = y0 * (1.0 + 1e-3 * jnp.linspace(-1.0, 1.0, LANES)[:, None])
    if case.endswith("rows"):
        coordinates = jax.jit(lambda y0, params: solve(y0, params))
        return lambda: coordinates(y0, params)[-1]
    program = jax.jit(
        {
            "grad": gradient,
            "vmap of 256": jax.vmap(lambda y0: solve(y0, params)[-1]),
            "vmap of grad": jax.vmap(gradient),
        }[case]
    )
    return lambda: program(y0 if case == "grad" else starts)


def _times(motion: Any, case: str) -> Any:
    import numpy as np

    return np.linspace(0.0, motion.t1, 101 if case == "101 rows" else 2)


def _jaxlag(motion: Any, case: str) -> tuple[Callable, Any]:
    import jax.numpy as jnp

    import jaxlag as jl

    ts, n = _times(motion, case), motion.q0.size

    def solve(y0: Any, params: Any) -> Any:
        q0, v0 = y0[:n], y0[n:]
        return jl.simulate(
            motion.system, q0, v0, ts, params, rtol=TOLERANCE, atol=TOLERANCE, throw=False
        ).q

    return solve, jnp.concatenate([jnp.asarray(motion.q0), jnp.asarray(motion.v0)])


def _diffrax(motion: Any, case: str) -> tuple[Callable, Any]:
    import diffrax
    import jax.numpy as jnp

    ts, n, field = _times(motion, case), motion.q0.size, motion.by_hand()

    def solve(y0: Any, params: Any) -> Any:
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            ts[0],
            ts[-1],
            None,
            y0,
            params,
            saveat=diffrax.SaveAt(t1=True) if len(ts) == 2 else diffrax.SaveAt(ts=jnp.asarray(ts)),
            stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        )
        assert found.ys is not None
        return found.ys[:, :n]

    return solve, jnp.asarray(motion.start())


def of_heyoka(scene: str) -> dict[str, Any]:
    """Build and run heyoka's Taylor integrator; None if there are no equations on scalars."""
    from importlib import import_module

    from bench._problems.declared_scenes import BEGINNINGS
    from bench._problems.explicit_equations import of_expressions

    hy, motion = import_module("heyoka"), BEGINNINGS[scene]()
    if motion.rates is None:
        return {"first_s": None, "run_ms": None, "end": None}
    start = motion.start()
    begin = perf_counter()
    names = hy.make_vars(*(f"y{i}" for i in range(start.size)))
    numbers = {
        name: value if isinstance(value, float | int) else [float(x) for x in value]
        for name, value in motion.params.items()
    }
    rates = motion.rates(of_expressions(hy), numbers, hy.time, names)
    system = [(x, hy.expression(0.0) + rate) for x, rate in zip(names, rates, strict=True)]
    tool = hy.taylor_adaptive(system, start, tol=TOLERANCE, compact_mode=start.size > 12)

    def call() -> Any:
        tool.time = 0.0
        tool.state[:] = start
        return tool.propagate_until(motion.t1)

    call()
    first_s = perf_counter() - begin
    end = tool.state[: motion.q0.size].tolist()
    runs = []
    for _ in range(20):
        begin = perf_counter()
        call()
        runs.append(perf_counter() - begin)
    return {"first_s": first_s, "run_ms": 1e3 * min(runs), "end": end}


if __name__ == "__main__":
    main(sys.argv[1:])
