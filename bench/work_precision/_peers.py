"""The motions solved by libraries other than JAX, each used as its manual recommends.

All have the same explicit equations with parameters as constants, except MuJoCo, which has its own
models. heyoka: a Taylor series of the order required by the tolerance, compiled for every
tolerance. numba: `_numba_dop853`. CasADi: CVODES, with the equations on its scalars. SUNDIALS:
CVODE, with the equations compiled by numba if installed, and called through Python. Both use Adams
methods and, if a motion is stiff, backward differences. scipy: equations in plain Python, which is
the fastest form for so few numbers.
"""

from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from time import perf_counter
from typing import Any

import numpy as np

from bench._problems.explicit_equations import of_expressions
from bench._problems.motions import Motion
from bench.work_precision import _numba_dop853
from bench.work_precision._mujoco_models import MODELS
from bench.work_precision._straight_line import source
from bench.work_precision._sweep import Line, Solved, steps, tolerances

MODULES = {
    "heyoka": "heyoka",
    "numba": "numba",
    "SUNDIALS": "sksundae",
    "CasADi": "casadi",
    "MuJoCo": "mujoco",
    "scipy": "scipy",
}
MOST_STEPS = 1_000_000
PACKAGES = {"sksundae": "scikit-sundae"}  # module: package, if the names differ


def missing() -> dict[str, str]:
    """The error text of every library that cannot be imported."""
    found = {}
    for name, module in MODULES.items():
        try:
            import_module(module)
        except Exception as error:  # a broken library is reported like a missing one
            found[name] = f"{type(error).__name__}: {error}"
    return found


def versions() -> dict[str, str]:
    """Versions of the installed libraries."""
    found = {}
    for name, module in MODULES.items():
        with suppress(PackageNotFoundError):
            found[name] = version(PACKAGES.get(module, module))
    return found


def heyoka(motion: Motion) -> Line:
    hy = import_module("heyoka")
    system, start = _expressions(motion, hy), motion.start()
    n = len(motion.q0)

    def make(tolerance: float) -> Callable[[], Any]:
        tool = hy.taylor_adaptive(system, start, tol=tolerance, compact_mode=start.size > 12)

        def call() -> Any:
            tool.time = 0.0
            tool.state[:] = start
            return tool.propagate_until(motion.t1), tool

        return call

    def read(result: Any) -> Solved:
        outcome, tool = result
        ok = outcome[0] == hy.taylor_outcome.time_limit
        return Solved(tool.state[:n].copy() if ok else np.nan, outcome[3])

    return Line("tolerance", tolerances(motion.loosest - 0.5, 17.0, 1.0), make, read, 0.0)


def heyoka_batch(motion: Motion) -> Line:
    """heyoka's SIMD mode, in as many batches as needed."""
    hy = import_module("heyoka")
    width = hy.recommended_simd_size()
    starts = motion.start().T  # (size, lanes)
    batches = [
        np.ascontiguousarray(starts[:, i : i + width]) for i in range(0, motion.lanes, width)
    ]
    system = _expressions(motion, hy)

    def make(tolerance: float) -> Callable[[], Any]:
        tool = hy.taylor_adaptive_batch(system, batches[0], tol=tolerance)
        ends = np.empty_like(starts)
        limit = [motion.t1] * width

        def call() -> Any:
            for i, batch in enumerate(batches):
                tool.set_time(0.0)
                tool.state[:] = batch
                tool.propagate_until(limit)
                ends[:, i * width : (i + 1) * width] = tool.state
            return ends

        return call

    n = motion.q0.shape[1]
    return Line(
        "tolerance",
        tolerances(motion.loosest - 0.5, 17.0, 1.0),
        make,
        lambda ends: Solved(ends[:n].T.copy()),
        0.0,
    )


def _expressions(motion: Motion, hy: Any) -> list[tuple[Any, Any]]:
    names = hy.make_vars(*(f"y{i}" for i in range(motion.start().shape[-1])))
    rates = motion.rates(of_expressions(hy), motion.params, names)
    return [(name, hy.expression(0.0) + rate) for name, rate in zip(names, rates, strict=True)]


def numba_dop853(motion: Motion) -> Line:
    run, starts = _numba_dop853.build(motion).run, motion.start()
    begun = perf_counter()
    run(starts.reshape(-1, starts.shape[-1])[0], 1e-3 * motion.t1, 1e-3, 1e-3)  # compiles
    build_s = perf_counter() - begun

    def make(tolerance: float) -> Callable[[], Any]:
        if motion.lanes > 1:
            return lambda: [run(y0, motion.t1, tolerance, tolerance) for y0 in starts]
        return lambda: run(starts, motion.t1, tolerance, tolerance)

    def read(result: Any) -> Solved:
        if motion.lanes > 1:
            return Solved(np.stack([y for y, *_ in result])[:, : motion.q0.shape[1]])
        return Solved(result[0][: len(motion.q0)], result[1])

    return Line("tolerance", tolerances(motion.loosest, 16.0), make, read, build_s)


def _casadi(method: str) -> Callable[[Motion], Line]:
    def line(motion: Motion) -> Line:
        ca = import_module("casadi")
        y, start, n = ca.SX.sym("y", motion.start().size), motion.start(), len(motion.q0)
        rates = motion.rates(of_expressions(ca), motion.params, ca.vertsplit(y))
        problem = {"x": y, "ode": ca.vertcat(*rates)}
        messages: list[str] = []

        def make(tolerance: float) -> Callable[[], Any]:
            options = {
                "abstol": tolerance,
                "reltol": tolerance,
                "max_num_steps": MOST_STEPS,
                "linear_multistep_method": method,
            }
            solve = ca.integrator("solve", "cvodes", problem, 0.0, motion.t1, options)

            def call() -> Any:
                try:
                    return solve(x0=start)["xf"]
                except RuntimeError as error:  # CVODES failed
                    messages.append(str(error).strip().splitlines()[-1])
                    return np.full(start.size, np.nan)

            return call

        def read(end: Any) -> Solved:
            return Solved(np.asarray(end).ravel()[:n])

        return Line("tolerance", tolerances(motion.loosest, 14.0), make, read, 0.0, messages)

    return line


def _sundials(method: str) -> Callable[[Motion], Line]:
    def line(motion: Motion) -> Line:
        cvode = import_module("sksundae.cvode")
        rates, start, n = compiled(motion), motion.start(), len(motion.q0)
        span = np.array([0.0, motion.t1])

        def make(tolerance: float) -> Callable[[], Any]:
            solver = cvode.CVODE(
                rates, method=method, rtol=tolerance, atol=tolerance, max_num_steps=MOST_STEPS
            )
            return lambda: solver.solve(span, start)

        def read(result: Any) -> Solved:
            return Solved(result.y[-1][:n] if result.success else np.nan)

        return Line("tolerance", tolerances(motion.loosest, 14.0), make, read, 0.0)

    return line


def compiled(motion: Motion) -> Callable[..., Any]:
    """`rates(t, y, out)` by numba; plain Python if numba cannot be imported."""
    function = plain(motion)
    try:
        njit = import_module("numba").njit
    except ImportError:
        return function
    fast = njit(function)
    start = motion.start()
    fast(0.0, start, np.empty_like(start))

    def rates(t: float, y: np.ndarray, out: np.ndarray) -> None:
        fast(t, y, out)

    return rates


def plain(motion: Motion) -> Callable[..., Any]:
    """`rates(t, y, out)` on Python numbers."""
    import math

    space: dict[str, Any] = {"sin": math.sin, "cos": math.cos, "sqrt": math.sqrt}
    exec(source(motion.rates, motion.params, motion.start().shape[-1]), space)
    return space["rates"]


def _scipy(method: str) -> Callable[[Motion], Line]:
    def line(motion: Motion) -> Line:
        integrate = import_module("scipy.integrate")
        rates, start, n = plain(motion), motion.start(), len(motion.q0)
        out = [0.0] * start.size

        def field(t: float, y: np.ndarray) -> list[float]:
            return rates(t, y.tolist(), out).copy()

        def make(tolerance: float) -> Callable[[], Any]:
            tolerance = max(tolerance, 2.3e-14)  # smallest tolerance of scipy
            return lambda: integrate.solve_ivp(
                field, (0.0, motion.t1), start, method, rtol=tolerance, atol=tolerance
            )

        def read(result: Any) -> Solved:
            return Solved(result.y[:n, -1] if result.success else np.nan, len(result.t) - 1)

        return Line("tolerance", tolerances(motion.loosest, 14.0), make, read, 0.0)

    return line


def mujoco(motion: Motion) -> Line:
    """RK4 with its loop in C."""
    library: Any = import_module("mujoco")
    model_of = MODELS[motion.rates.__name__]
    model, put, read = model_of(library, motion)
    data = library.MjData(model)
    library.set_mju_user_warning(lambda text: None)  # about long steps, to a file

    def make(step: float) -> Callable[[], Any]:
        count = round(motion.t1 / step)

        def call() -> Any:
            library.mj_resetData(model, data)
            put(data)
            model.opt.timestep = step
            library.mj_step(model, data, nstep=count)
            return data

        return call

    return Line(
        "step", steps(motion.t1, motion.fewest, 1 << 20), make, lambda data: Solved(read(data)), 0.0
    )


def lines(motion: Motion) -> dict[str, tuple[str, Callable[[Motion], Line]]]:
    """(library, function that makes the line), by the names of the lines."""
    if motion.lanes > 1:
        return {
            "heyoka, SIMD": ("heyoka", heyoka_batch),
            "numba DOP853, one by one": ("numba", numba_dop853),
        }
    found: dict[str, tuple[str, Callable[[Motion], Line]]] = {
        "heyoka": ("heyoka", heyoka),
        "numba DOP853": ("numba", numba_dop853),
        "CasADi Adams": ("CasADi", _casadi("adams")),
        "SUNDIALS Adams": ("SUNDIALS", _sundials("Adams")),
        "scipy DOP853": ("scipy", _scipy("DOP853")),
        "scipy LSODA": ("scipy", _scipy("LSODA")),
    }
    if motion.stiff:
        found["CasADi BDF"] = ("CasADi", _casadi("bdf"))
        found["SUNDIALS BDF"] = ("SUNDIALS", _sundials("BDF"))
        found["scipy Radau"] = ("scipy", _scipy("Radau"))
    if motion.rates.__name__ in MODELS:
        found["MuJoCo RK4"] = ("MuJoCo", mujoco)
    return found


NO_LINE = {
    "kepler": "MuJoCo has no attraction to a centre without a callback at every step",
    "rigid_aircraft": "MuJoCo has no force that turns with the body without a callback",
    "rolling_disk": "MuJoCo's contacts slip and give",
    "cartesian_pendulum": "MuJoCo has no point masses held by rods alone: see the one in angles",
}
