"""`replay`: one trajectory of a sweep again, at other times."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlag._core._errors import invalid
from jaxlag._model._inputs import check_inputs
from jaxlag._simulation._options._option_checks import check_times
from jaxlag._simulation._solution import Solution
from jaxlag._sweep._block import solve_block
from jaxlag._sweep._sweep_result import SweepResult
from jaxlag._tracing._params import Static
from jaxlag._tracing._traced_function import warn_of_changes


def replay(run: Any, index: Any, ts: Any = None) -> Solution:
    """One trajectory of a sweep as a `Solution`, with the same bits at the times of the sweep.

    The program of the sweep computes it again, in a block without other trajectories. Each run of
    it returns as many times as the sweep has: for more times it runs several times. A motion by
    `jl.simulate` with the same case may differ in the last bits.

    Args:
        run: the sweep.
        index: of the trajectory; negative ones count from the last.
        ts: (k,) times in s, which begin and end as those of the sweep; None for the same.

    Raises:
        IndexError: there is no such trajectory.
        ValueError: times that begin or end otherwise.

    Example:
        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     return 0.5 * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2
        >>> def draw(key, index):
        ...     return jl.Case(q0=[1.0], v0=[0.0], params={"k": jnp.exp(jax.random.normal(key))})
        >>> spring = jl.System(lagrangian, coordinates=("x",))
        >>> run = jl.sweep(spring, draw, 100, jnp.linspace(0.0, 2.0, 9))
        >>> motion = jl.replay(run, 17, jnp.linspace(0.0, 2.0, 65))
        >>> bool((motion["x"][::8] == run["x"][17]).all())
        True
    """
    if not isinstance(run, SweepResult):
        raise invalid("run", "be a result of jl.sweep", f"it was {run!r}")
    index = run.index(index)
    case = run.case(index)
    warn_of_changes(run.system, case.inputs)
    own = run.ts if run.ts.ndim == 1 else run.ts[index]
    motion = _solved(run, index, own) if ts is None else _at_times(run, index, own, ts)
    params = _traced(motion._params_static, case.params)
    inputs = _traced(motion._inputs_static, check_inputs(case.inputs))
    return replace(motion, _params_traced=params, _inputs_traced=inputs)


def _traced(static: Static, given: Any) -> Any:
    """What is traced, which is what the static half leaves out."""

    def part(fixed: Any, x: Any) -> Any:
        return None if fixed is not None or x is None else jnp.asarray(x)

    return jax.tree.map(part, static.tree, given, is_leaf=lambda x: x is None)


def _at_times(run: SweepResult, index: int, own: np.ndarray, ts: Any) -> Solution:
    """The trajectory at other times."""
    asked = np.asarray(check_times(ts)[0])
    own = np.asarray(check_times(own)[0])
    if asked[0] != own[0] or asked[-1] != own[-1]:
        must = f"begin at {own[0]} and end at {own[-1]}, as the sweep"
        raise invalid("ts", must, f"it was from {asked[0]} to {asked[-1]}")
    backwards = own[-1] < own[0]
    every = np.union1d(own, asked)[:: -1 if backwards else 1]
    pieces = [_solved(run, index, times) for times in _pieces(every, len(own))]
    at = np.concatenate([piece.ts for piece in pieces])
    order = np.argsort(at, stable=True)
    place = order[np.searchsorted(at, asked, sorter=order)]

    def joined(*parts: Any) -> Any:
        return jnp.concatenate(parts)[place]

    found = {
        name: jax.tree.map(joined, *(getattr(piece, name) for piece in pieces))
        for name in ("ts", "q", "v", "x", "saved")
    }
    return replace(pieces[-1], **found)


def _pieces(every: np.ndarray, size: int) -> list[np.ndarray]:
    """Times in groups of `size`, all from the first one; to the last one if size > 2."""
    start, inner, end = every[:1], every[1:-1], every[-1:]
    if size == 2:
        return [np.concatenate([start, [t]]) for t in every[1:]]
    firsts = range(0, max(len(inner), 1), size - 2)
    groups = [inner[max(0, min(k, len(inner) - size + 2)) :][: size - 2] for k in firsts]
    return [np.concatenate([start, group, end]) for group in groups]


def _solved(run: SweepResult, index: int, ts: np.ndarray) -> Solution:
    """The trajectory at these times, as the first one of a block."""
    size = run._key.size
    shared, own = run._cases.arguments(np.full(size, index))
    times = ts if run.ts.ndim == 1 else np.broadcast_to(ts, (size, *ts.shape))
    return jax.tree.map(lambda x: x[0], solve_block(run._key, times, shared, own, 1).motions)
