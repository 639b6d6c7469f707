"""A block: a fixed number of trajectories that one compiled program computes.

Another number of trajectories, or another program, may change the order of operations, and with it
the last bits of results. So all blocks of a sweep are computed by the same program, whatever the
number of trajectories of the sweep. Those beyond the last one start from NaN, and end there.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxlag._core._batching import VECTORIZED, VECTORIZED_FROM
from jaxlag._simulation._options._option_checks import DirectedTimes
from jaxlag._simulation._simulate import simulate
from jaxlag._simulation._solution import Solution
from jaxlag._simulation._solution_views import flat_quantities
from jaxlag._sweep._case import Case
from jaxlag._sweep._cases import AbstractCases
from jaxlag._system._system import System
from jaxlag._tracing._params import arrays_apart

MEMORY = 2**28
"""Bound on the saved numbers of a block, bytes."""


class BlockKey(NamedTuple):
    """What the compiled program of a block depends on.

    Attributes:
        system: the mechanical system.
        cases: their form.
        keep: names of the states that are kept.
        save: names of the quantities that are kept.
        options: of `simulate`.
        time_direction: 1 or -1; None if it may differ between trajectories.
        size: number of trajectories.
    """

    system: System
    cases: AbstractCases
    keep: tuple[str, ...]
    save: tuple[str, ...]
    options: tuple[tuple[str, Any], ...]
    time_direction: int | None
    size: int

    @property
    def computed(self) -> tuple[str, ...]:
        """Names of the quantities that the program computes."""
        quasi = () if self.system.quasi is None else self.system.quasi.names
        needed = ("u",) if "u" not in self.save and set(quasi) & set(self.keep) else ()
        return *self.save, *needed


class Block(NamedTuple):
    """The trajectories of a block.

    Attributes:
        motions: without params and inputs, which would be copied for each of them.
        status: how each ended.
        where: index of the coordinate or row that a failure concerns; -1 if none.
    """

    motions: Solution
    status: Int[Array, " size"]
    where: Int[Array, " size"]


def block_size(numbers: int) -> int:
    """Number of trajectories of a block, by the numbers that each of them saves."""
    size = VECTORIZED
    while size > VECTORIZED_FROM and 8 * size * numbers > MEMORY:
        size //= 2
    return size


def block_indices(first: int, size: int, count: int) -> np.ndarray:
    """Indices of the trajectories of a block; the last one stands for those that do not exist."""
    return np.minimum(np.arange(first, first + size), count - 1)


def _case(key: BlockKey, shared: Any, own: Any) -> Case:
    """One case, computed apart from the trajectory, so that it has the same bits alone."""
    arrays, rest = arrays_apart(key.cases.case(shared, own))
    return eqx.combine(jax.lax.optimization_barrier(arrays), rest)


@eqx.filter_jit
def cases_in(key: BlockKey, shared: Any, own: Any) -> Case:
    """The cases of a block."""
    return eqx.filter_vmap(lambda own: _case(key, shared, own), out_axes=eqx.if_array(0))(own)


@partial(jax.jit, static_argnums=0)
def solve_block(key: BlockKey, ts: Any, shared: Any, own: Any, count: Any) -> Block:
    """The first `count` trajectories of a block; the others are NaN.

    Args:
        key: of the program.
        ts: common times, (s,), or those of each trajectory, (size, s).
        shared: arrays for all cases.
        own: entries for each.
        count: number of trajectories that exist.
    """

    def one(ts: Any, own: Any, i: Any) -> Block:
        case = _case(key, shared, own)

        def start(x: Any) -> Array:
            return jnp.where(i < count, x, jnp.nan)

        motion = simulate(
            key.system,
            jax.tree.map(start, case.q0),
            case.v0,
            DirectedTimes(ts, key.time_direction),
            case.params,
            u0=case.u0,
            x0=case.x0,
            inputs=case.inputs,
            save=key.computed,
            throw=False,
            **dict(key.options),
        )
        ending = motion._explained()
        return Block(
            replace(motion, _params_traced=None, _inputs_traced=None), ending.status, ending.where
        )

    return jax.vmap(one, (None if ts.ndim == 1 else 0, 0, 0))(ts, own, jnp.arange(key.size))


def values_of(key: BlockKey, motions: Solution) -> dict[str, Any]:
    """What is kept of the motions, by name, each (size, s, *its shape)."""
    system = key.system
    coordinates, quasi, states = system.coordinates, system.quasi, system.states

    def state(name: str) -> Any:
        if name in coordinates.names:
            return coordinates.unflatten(motions.q)[name]
        if states is not None and name in states.names:
            return states.layout.unflatten(motions.x)[name]
        if quasi is not None and name in quasi.names:
            return motions.saved["u"][..., quasi.names.index(name)]
        return coordinates.unflatten(motions.v)[name.removesuffix("'")]

    saved = {name: motions.saved[name] for name in key.save}
    return {name: state(name) for name in key.keep} | flat_quantities(saved)


def facts_of(key: BlockKey, block: Block) -> dict[str, Any]:
    """How each trajectory ended, its steps, and its times if they are its own."""
    motions = block.motions
    own = {"t": motions.ts} if key.time_direction is None else {}
    ended = {"status": block.status, "where": block.where, "last_time": motions.last_time}
    return ended | dict(motions.stats) | own
