"""`sweep`: many trajectories of one system, each a function of its case."""

import time
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from jaxlag._core._arguments import name_sequence
from jaxlag._core._errors import invalid
from jaxlag._simulation._options._option_checks import (
    check_options,
    check_quantities,
    check_times,
)
from jaxlag._simulation._options._simulate_options import NO_OPTIONS, plain_options
from jaxlag._simulation._quantities import QUANTITIES
from jaxlag._sweep._block import (
    Block,
    BlockKey,
    block_indices,
    block_size,
    cases_in,
    facts_of,
    kept,
    solve_block,
)
from jaxlag._sweep._cases import AbstractCases, cases_of
from jaxlag._sweep._sweep_result import SweepReport, SweepResult, counted
from jaxlag._system._system import System
from jaxlag._tracing._traced_function import warn_of_changes

TAKEN = ("q0", "v0", "u0", "x0", "ts", "params", "inputs", "save", "throw", "estimate_error")
"""Arguments of `simulate` that a sweep sets itself."""
IN_FLIGHT = 2
"""Blocks that are computed at a time."""


def sweep(
    system: Any,
    cases: Any,
    n: Any,
    ts: Any = None,
    *,
    seed: Any = 0,
    keep: Any = None,
    simulate_options: Any = NO_OPTIONS,
) -> SweepResult:
    """Simulate n trajectories, and keep what is named.

    Trajectory i has the same bits for any n, and whatever the other trajectories do. They are
    computed in blocks of a fixed number, which run one after the other: the memory of the solves is
    that of some blocks. As under `jax.vmap`, "auto" does not change the method or the formulation
    of a motion that fails: pass the method for stiff systems.

    Args:
        system: the mechanical system.
        cases: a function (key, index) -> `Case` of one trajectory, with a key of `jax.random` and
            its index; or a `Case` of arrays with a leading axis, one entry for each trajectory.
            Keys are `jax.random.fold_in(jax.random.key(seed), index)`. The function is traced once:
            values that it reads from outside are those of this moment.
        n: number of trajectories; None for that of the arrays.
        ts: (s,) times in s, strictly monotone; None if each case has its own.
        seed: of the keys, 0 <= seed < 2^32.
        keep: names of coordinates, "x'" for the velocity of "x", quasi-velocities, states, and of
            quantities as in `save=` of `simulate`; None for all but these quantities. One that is
            a dict is kept by its keys: "power" as `run["power drag"]`.
        simulate_options: options of `jl.simulate`, such as `{"method": "tsit5", "rtol": 1e-7}`.

    Returns:
        What they saved, and how each of them ended. Nothing is raised for a trajectory that fails:
        read `run.status`, or print `run.message()`.

    Raises:
        ValueError: an argument of wrong form or value, named; `cases` returns something else than a
            `Case`, is not traceable, or depends on more than key and index.

    Example:
        A thousand pendulums of random length, from the same angle:

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     return 0.5 * params["l"] ** 2 * v[0] ** 2 + 9.81 * params["l"] * jnp.cos(q[0])
        >>> def draw(key, index):
        ...     length = 1.0 + 0.1 * jax.random.normal(key)
        ...     return jl.Case(q0=[0.5], v0=[0.0], params={"l": length})
        >>> pendulum = jl.System(lagrangian, coordinates=("theta",))
        >>> run = jl.sweep(pendulum, draw, 1000, jnp.linspace(0.0, 2.0, 5))
        >>> print(run.message(), run["theta"].shape)
        1000 trajectories: 1000 ok (1000, 5)
    """
    begun = time.monotonic()
    check_options(system, "auto", None, "projection", False, (), 1)
    given, count = cases_of(system, cases, n, _checked_seed(seed))
    warn_of_changes(system, given.static.tree.inputs)
    options = plain_options(simulate_options, "jl.sweep", TAKEN)
    keeping = _keeping(system, keep)
    common, times = _times(given, ts)
    state = system.size + (0 if system.states is None else system.states.size)
    size = block_size(times * state * (1 + sum(map(len, keeping))))
    direction = None if common is None else 1 if common[-1] > common[0] else -1
    key = BlockKey(system, given.form, *keeping, tuple(options.items()), direction, size)
    values: dict[str, np.ndarray] = {}
    facts: dict[str, np.ndarray] = {}
    first_seconds = 0.0
    for first, block in _blocks(key, given, common, count):
        first_seconds = first_seconds or time.monotonic() - begun
        _fill(values, count, first, kept(key, block.motions))
        _fill(facts, count, first, facts_of(block))
    for name in key.save:
        if not any(x == name or x.startswith(f"{name} ") for x in values):
            raise invalid("keep", "name what the system has", f"it has no {name!r}")
    own_times = facts.pop("ts")
    report = SweepReport(
        count,
        counted(facts["status"]),
        int(facts["accepted"].sum()),
        int(facts["rejected"].sum()),
        time.monotonic() - begun,
        first_seconds,
        key.size,
    )
    when = own_times if common is None else common
    return SweepResult(system, when, values, **facts, report=report, _key=key, _cases=given)


def _checked_seed(seed: Any) -> int:
    is_integer = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not is_integer or not 0 <= seed < 2**32:
        raise invalid("seed", "be an integer from 0 to 2^32 - 1", f"it was {seed!r}")
    return int(seed)


def _keeping(system: System, keep: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the states and of the quantities that are kept."""
    states = [x for name in system.coordinates.names for x in (name, f"{name}'")]
    states += [] if system.quasi is None else system.quasi.names
    states += [] if system.states is None else system.states.names
    if keep is None:
        return tuple(states), ()
    names = tuple(dict.fromkeys(name_sequence("keep", keep)))
    if not names:
        raise invalid("keep", "name something", "it was empty", "Leave it out for all states.")
    known = [*states, *QUANTITIES, "work"]
    for name in names:
        if name not in known:
            raise invalid("keep", f"name some of {known}", f"one was {name!r}")
    quantities = tuple(name for name in names if name not in states)
    check_quantities(system, "keep", quantities)
    return tuple(name for name in names if name in states), quantities


def _times(cases: AbstractCases, ts: Any) -> tuple[np.ndarray | None, int]:
    """(common times, None if each case has its own; their number)."""
    shared, own = cases.arguments(np.zeros(1, int))
    one = jax.tree.map(lambda x: x[0], own)
    given = jax.eval_shape(lambda: cases.case(shared, one).ts)
    if (given is None) == (ts is None):
        was = "neither was given" if ts is None else "both were given"
        raise invalid("exactly one of `ts` and the `ts` of the cases", "be given", was)
    if ts is None:
        return None, given.shape[-1]
    ts = np.asarray(check_times(ts)[0])
    return ts, ts.shape[0]


def _blocks(
    key: BlockKey, cases: AbstractCases, common: np.ndarray | None, count: int
) -> Iterator[tuple[int, Block]]:
    """(index of its first trajectory, block) for each block; some are computed at a time."""
    ahead: deque[tuple[int, Block]] = deque()
    for first in range(0, count, key.size):
        shared, own = cases.arguments(block_indices(first, key.size, count))
        ts = cases_in(key, shared, own).ts if common is None else common
        ahead.append((first, solve_block(key, ts, shared, own, count - first)))
        if len(ahead) == IN_FLIGHT:
            yield ahead.popleft()
    yield from ahead


def _fill(
    whole: dict[str, np.ndarray], count: int, first: int, part: Mapping[str, np.ndarray]
) -> None:
    """Write the trajectories of a block, from the index `first` on, into those of the sweep."""
    for name, x in part.items():
        if name not in whole:
            whole[name] = np.empty((count, *x.shape[1:]), x.dtype)
        whole[name][first : first + len(x)] = x[: count - first]
