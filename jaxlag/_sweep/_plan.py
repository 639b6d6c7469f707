"""The plan of a sweep: its checked arguments, and the program of its blocks."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
from jaxlag._simulation._options._simulate_options import plain_options
from jaxlag._simulation._quantities import QUANTITIES
from jaxlag._sweep._block import (
    Block,
    BlockKey,
    block_indices,
    block_size,
    cases_in,
    facts_of,
    solve_block,
    values_of,
)
from jaxlag._sweep._cases import AbstractCases, cases_of
from jaxlag._sweep._record import Layout
from jaxlag._system._system import System
from jaxlag._tracing._traced_function import warn_of_changes

TAKEN = ("q0", "v0", "u0", "x0", "ts", "params", "inputs", "save", "throw", "estimate_error")
"""Arguments of `simulate` that a sweep sets itself."""


@dataclass(frozen=True)
class Plan:
    """What a sweep computes.

    Attributes:
        key: of the program of a block.
        cases: the cases.
        layout: the arrays that are kept.
        traced: the program of a block.
    """

    key: BlockKey
    cases: AbstractCases
    layout: Layout
    traced: Any

    def arguments(self, block: int) -> tuple[Any, ...]:
        """Those of the program for a block."""
        return _arguments(self.key, self.cases, self.layout.ts, block, self.layout.count)

    def rows(self, block: int, arguments: tuple[Any, ...]) -> dict[str, np.ndarray]:
        """All arrays of a block, computed, for the trajectories that exist."""
        found = jax.device_get(solve_block(self.key, *arguments))
        within = self.layout.within(block)
        rows = values_of(self.key, found.motions) | facts_of(self.key, found)
        return {name: x[: within.stop - within.start] for name, x in rows.items()}


def planned(
    system: Any,
    cases: Any,
    n: Any,
    ts: Any,
    seed: Any,
    keep: Any,
    also: tuple[str, ...],
    simulate_options: Any,
) -> Plan:
    """The plan by the arguments of `jl.sweep`, which are checked; `also` is computed, not kept."""
    check_options(system, "auto", None, "projection", False, (), 1)
    given, count = cases_of(system, cases, n, _checked_seed(seed))
    warn_of_changes(system, given.static.tree.inputs)
    options = plain_options(simulate_options, "jl.sweep", TAKEN)
    kept = _kept(system, keep, bool(also))
    states, quantities = _sorted(system, [*kept, *also])
    common, times = _times(given, ts)
    state = system.size + (0 if system.states is None else system.states.size)
    size = block_size(times * state * (1 + len(states) + len(quantities)))
    direction = None if common is None else 1 if common[-1] > common[0] else -1
    items = tuple(options.items())
    key = BlockKey(system, given.form, states, quantities, items, direction, size)
    traced = solve_block.trace(key, *_arguments(key, given, common, 0, count))
    values = _of_one(lambda block: values_of(key, block.motions), traced.out_info)
    facts = _of_one(lambda block: facts_of(key, block), traced.out_info)
    for name in quantities:
        if not any(_belongs(x, name) for x in values):
            argument = "keep" if name in kept else "statistics"
            raise invalid(argument, "name what the system has", f"it has no {name!r}")
    for name in also:
        if name not in values:
            raise invalid("statistics", f"name some of {list(values)}", f"one was {name!r}")
    for name in set(values) & set(facts):
        must, was = f"leave out {list(facts)}, which are kept anyway", f"one was {name!r}"
        raise invalid("keep", must, was, "Give this coordinate or state another name.")
    values = {x: shape for x, shape in values.items() if any(_belongs(x, name) for name in kept)}
    return Plan(key, given, Layout(count, size, common, values, facts), traced)


def _arguments(
    key: BlockKey, cases: AbstractCases, common: np.ndarray | None, block: int, count: int
) -> tuple[Any, ...]:
    """Those of `solve_block` after the key."""
    first = block * key.size
    shared, own = cases.arguments(block_indices(first, key.size, count))
    ts = cases_in(key, shared, own).ts if common is None else common
    return ts, shared, own, count - first


def _of_one(function: Callable, block: Any) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes and dtypes of its arrays for one trajectory, in their order."""
    names: list[str] = []

    def found(block: Block) -> Mapping[str, Any]:
        arrays = function(block)
        names[:] = arrays
        return arrays

    shapes = jax.eval_shape(found, block)
    return {x: jax.ShapeDtypeStruct(shapes[x].shape[1:], shapes[x].dtype) for x in names}


def _checked_seed(seed: Any) -> int:
    is_integer = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not is_integer or not 0 <= seed < 2**32:
        raise invalid("seed", "be an integer from 0 to 2^32 - 1", f"it was {seed!r}")
    return int(seed)


def _states(system: System) -> list[str]:
    """Names of coordinates, velocities, quasi-velocities and states."""
    names = [x for name in system.coordinates.names for x in (name, f"{name}'")]
    names += [] if system.quasi is None else system.quasi.names
    return names + ([] if system.states is None else list(system.states.names))


def _kept(system: System, keep: Any, may_be_empty: bool) -> tuple[str, ...]:
    """Names of what is kept."""
    if keep is None:
        return tuple(_states(system))
    names = tuple(dict.fromkeys(name_sequence("keep", keep)))
    if not names and not may_be_empty:
        raise invalid("keep", "name something", "it was empty", "Leave it out for all states.")
    known = [*_states(system), *QUANTITIES, "work"]
    for name in names:
        if name not in known:
            raise invalid("keep", f"name some of {known}", f"one was {name!r}")
    check_quantities(system, "keep", [name for name in names if name not in _states(system)])
    return names


def _sorted(system: System, names: list[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names as those of states, and of quantities; "power drag" belongs to "power"."""
    all_states = _states(system)
    states = tuple(dict.fromkeys(name for name in names if name in all_states))
    rest = [name for name in names if name not in all_states]
    known = (*QUANTITIES, "work")
    quantities = [name if name in known else name.split(" ")[0] for name in rest]
    for name in quantities:
        if name not in known:
            must = f"name some of {[*all_states, *known]}"
            raise invalid("statistics", must, f"one was {name!r}")
    check_quantities(system, "statistics", quantities)
    return states, tuple(dict.fromkeys(quantities))


def _belongs(array: str, name: str) -> bool:
    """Whether an array is kept by a name, or by a key of the dict of this name."""
    return array == name or array.startswith(f"{name} ")


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
