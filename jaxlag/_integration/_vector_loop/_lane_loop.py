"""A loop that `jax.vmap` runs as one vectorized loop over lanes.

    while cond(x): x = body(x)

The body is rewritten for numbers. A turn of the loop is a `lane_map` of it, with two exceptions
(`_turn`): operations without a form on numbers, such as looking up the next save time, come
before, and writes of entries into buffers come after it. Numbers of the state that nothing depends
on are left out.

The trajectories of a batch share a few lanes. A lane whose trajectory has ended takes the next one,
so that no lane waits for the longest trajectory.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching
from jaxtyping import Array, PyTree

from jaxlag._integration._vector_loop._flat_program import FlatProgram, Value, flat
from jaxlag._integration._vector_loop._lane_map import MULTIPLE, WIDTH, lane_map
from jaxlag._integration._vector_loop._turn import Turn, changing, split, turn_of

_loop_p = Primitive("lane_loop")
_loop_p.multiple_results = True


def lane_loop(cond: Callable, body: Callable, results: Callable, init: PyTree) -> PyTree:
    """results(x) of the last x, under `jax.vmap` only.

    Args:
        cond: whether there is a next turn.
        body: x -> x.
        results: of x.
        init: x at the start, a pytree of arrays.

    Raises:
        NotVectorizable: the body has no form on numbers.
    """
    leaves, tree = jax.tree.flatten(init)

    def of(function: Callable) -> Callable:
        return lambda *leaves: jax.tree.leaves(function(jax.tree.unflatten(tree, leaves)))

    programs, consts = zip(*(flat(of(f), *leaves) for f in (cond, body, results)), strict=True)
    given = [x for part in consts for x in part]
    found = _loop_p.bind(*given, *leaves, programs=programs)
    return jax.tree.unflatten(jax.tree.structure(jax.eval_shape(results, init)), found)


@_loop_p.def_abstract_eval
def _(*_: Any, programs: tuple[FlatProgram, ...]) -> list[Any]:
    results = programs[-1]
    kinds = map(results.aval, results.outputs)
    return [ShapedArray(x.shape, x.dtype) for x in kinds]


def _batched(args: Sequence[Any], axes: Sequence[Any], *, programs: Any) -> tuple[list, list]:
    count = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    given = [
        _Batch(jnp.asarray(x), None) if axis is None else _Batch(jnp.moveaxis(x, axis, 0), 0)
        for x, axis in zip(args, axes, strict=True)
    ]
    consts = []
    for program in programs:
        size = len(program.consts)
        consts.append(given[:size])
        given = given[size:]
    found = _Loop.of(programs, consts, given, count).run()
    return found, [0] * len(found)


batching.primitive_batchers[_loop_p] = _batched


class _Batch(NamedTuple):
    """A value for all trajectories.

    Attributes:
        array: the value, with a leading axis of trajectories if it differs.
        axis: 0, or None if it is the same for all.
    """

    array: Array
    axis: int | None

    def of(self, trajectory: Array) -> Array:
        """That of one trajectory."""
        return self.array if self.axis is None else _entry(self.array, trajectory)


class _Lanes(NamedTuple):
    """The trajectories in the lanes.

    Attributes:
        consts: constants of each program, (lanes, ...); those that all share are empty.
        state: the same of the state.
        trajectory: index of each; beyond the last one if a lane has none.
        following: index of the next one.
        results: (trajectories, ...) of all that have ended.
    """

    consts: list[list[Array]]
    state: list[Array]
    trajectory: Array
    following: Array
    results: list[Array]


_Carry = tuple[dict[int, Array], dict[int, Array]]  # rows of changing numbers, buffers


class _Loop(NamedTuple):
    """The loop over all lanes. Numbers are rows of lanes, by their number in the turn's program.

    Attributes:
        programs: condition, body, results.
        consts: constants of each.
        start: the state at the start.
        count: number of trajectories.
        turn: the body in parts.
        moving: next values of the numbers that change and are needed.
    """

    programs: Sequence[FlatProgram]
    consts: Sequence[list[_Batch]]
    start: list[_Batch]
    count: int
    turn: Turn
    moving: dict[int, Value]

    @classmethod
    def of(cls, programs: Any, consts: Any, start: list[_Batch], count: int) -> "_Loop":
        """The loop, prepared."""
        body, turn = programs[1], turn_of(programs[1])
        wanted = body.read_by(turn.before)
        for program in (programs[0], programs[2]):
            read = program.read_by(program.operations, program.outputs)
            pairs = zip(body.inputs, program.inputs, strict=True)
            wanted |= {x for x, same in pairs if same in read}
        return cls(programs, consts, start, count, turn, changing(turn, wanted))

    @property
    def size(self) -> int:
        """Number of lanes."""
        return min(WIDTH, -(-self.count // MULTIPLE) * MULTIPLE)

    # ---- Trajectories --------------------------------------------------------------------------

    def run(self) -> list[Array]:
        """The results of all trajectories."""
        first = jnp.arange(self.size)
        loaded = jax.vmap(self.loaded)(jnp.minimum(first, self.count - 1))
        kinds = [self.programs[2].aval(x) for x in self.programs[2].outputs]
        results = [jnp.zeros((self.count, *x.shape), x.dtype) for x in kinds]
        carry = _Lanes(*loaded, first, jnp.asarray(self.size), results)
        return lax.while_loop(
            lambda lanes: jnp.any(self.busy(lanes)), self.until_one_ends, carry
        ).results

    def busy(self, lanes: _Lanes) -> Array:
        """Lanes with a trajectory."""
        return lanes.trajectory < self.count

    def loaded(self, trajectory: Array) -> tuple[list[list[Array]], list[Array]]:
        """(constants, state) at the start of a trajectory."""
        consts = [
            [jnp.zeros(0) if x.axis is None else x.of(trajectory) for x in part]
            for part in self.consts
        ]
        return consts, [x.of(trajectory) for x in self.start]

    def until_one_ends(self, lanes: _Lanes) -> _Lanes:
        """Turns until a trajectory ends; its lane takes the next one."""
        lanes = lanes._replace(state=self.turns(lanes))
        goes_on = self.vmapped(0, self.programs[0], lanes.consts, lanes.state)[0]
        lane = jnp.argmax(self.busy(lanes) & ~goes_on)
        ended, state = jax.tree.map(lambda x: _entry(x, lane), (lanes.consts, lanes.state))
        found = map(jnp.asarray, self.programs[2](self.whole(2, ended[2]), state))
        index = _entry(lanes.trajectory, lane)
        results = [_put(x, index, y) for x, y in zip(lanes.results, found, strict=True)]
        new = self.loaded(jnp.minimum(lanes.following, self.count - 1))
        consts, state = jax.tree.map(
            lambda x, y: _put(x, lane, y), (lanes.consts, lanes.state), new
        )
        trajectory = _put(lanes.trajectory, lane, lanes.following)
        return _Lanes(consts, state, trajectory, lanes.following + 1, results)

    # ---- Turns ---------------------------------------------------------------------------------

    def turns(self, lanes: _Lanes) -> list[Array]:
        """The state after turns until a trajectory has ended."""
        body = self.turn.body
        consts = [
            x if batch.axis == 0 else jnp.broadcast_to(batch.array, (self.size, *batch.array.shape))
            for x, batch in zip(lanes.consts[1], self.consts[1], strict=True)
        ]
        values = *body.consts, *body.inputs
        known = dict(zip(values, (*consts, *lanes.state), strict=True))
        fixed: dict[int, Array] = {}
        for source in self.turn.elements.keys() & known.keys():
            fixed |= dict(zip(self.turn.elements[source], _rows(known[source]), strict=True))

        def state(carry: _Carry) -> list[Array]:
            rows, buffers = fixed | carry[0], carry[1]
            arrays = {
                x: _array([rows[number] for number in self.turn.elements[x]], known[x])
                for x in body.inputs
                if x not in buffers
            }
            return [(arrays | buffers)[x] for x in body.inputs]

        def all_go_on(carry: _Carry) -> Array:
            going = self.vmapped(0, self.programs[0], lanes.consts, state(carry))[0]
            return jnp.all(going | ~self.busy(lanes))

        def one(carry: _Carry) -> _Carry:
            rows, found = fixed | carry[0], []
            if self.turn.found:
                found = self.vmapped(1, self.before, lanes.consts, state(carry))
            for x, array in zip(self.turn.found, found, strict=True):
                rows |= dict(zip(self.turn.elements[x], _rows(array), strict=True))
            return self.next(rows, carry[1])

        carry = {x: fixed[x] for x in self.moving}, {x: known[x] for x in self.turn.writes}
        return state(lax.while_loop(all_go_on, one, carry))

    def next(self, rows: dict[int, Array], buffers: dict[int, Array]) -> _Carry:
        """One turn, after the operations that come before."""
        turn, buffers = self.turn, dict(buffers)
        kinds = [turn.body.aval(x) for x in turn.written]
        count = sum(x.size for x in kinds)
        new = self.on_rows([*self.moving.values(), *turn.numbers.last(count)], rows)
        entries = split(turn.body, turn.written, new[len(self.moving) :])
        shapes = [jax.ShapeDtypeStruct((self.size, *x.shape), x.dtype) for x in kinds]
        given = list(map(_array, entries, shapes))
        for buffer, operation in turn.writes.items():
            count = len(operation.operands) - 1
            (buffers[buffer],) = jax.vmap(operation)(buffers[buffer], *given[:count])
            given = given[count:]
        return dict(zip(self.moving, new, strict=False)), buffers

    def on_rows(self, wanted: list[Value], rows: dict[int, Array]) -> list[Array]:
        """Values of the program on numbers, for all lanes."""
        program = self.turn.numbers
        operations = program.needed(wanted)
        read = sorted(program.read_by(operations, wanted))

        def numbers(*entries: Any) -> list[Any]:
            known = dict(zip(read, entries, strict=True))
            return [jnp.asarray(x) for x in program.evaluate(operations, known, wanted)]

        kinds = [program.aval(x).dtype for x in wanted]
        return lane_map(numbers, [rows[x] for x in read], kinds)

    def before(self, consts: list, state: list) -> list:
        """Results of operations that come before a turn, of one lane."""
        body = self.turn.body
        known = dict(zip((*body.consts, *body.inputs), (*consts, *state), strict=True))
        return body.evaluate(self.turn.before, known, self.turn.found)

    def whole(self, k: int, consts: list[Array]) -> list[Array]:
        """Constants of a program, with those that all trajectories share."""
        pairs = zip(self.consts[k], consts, strict=True)
        return [x if batch.axis == 0 else batch.array for batch, x in pairs]

    def vmapped(
        self, k: int, function: Callable, consts: list[list[Array]], state: list[Array]
    ) -> list[Array]:
        """function(constants of a program, state) of all lanes."""
        axes = [x.axis for x in self.consts[k]]
        return jax.vmap(function, in_axes=(axes, 0))(self.whole(k, consts[k]), state)


def _rows(array: Array) -> list[Array]:
    """The elements of (lanes, ...), (lanes,) each."""
    flat = array.reshape(array.shape[0], -1)
    return [flat[:, k] for k in range(flat.shape[1])]


def _array(rows: Sequence[Array], like: Any) -> Array:
    """The inverse of `_rows`, for arrays like this one."""
    return jnp.stack(rows, 1).reshape(like.shape) if rows else jnp.zeros(like.shape, like.dtype)


def _entry(array: Array, index: Array) -> Array:
    return lax.dynamic_index_in_dim(array, index, keepdims=False)


def _put(array: Array, index: Array, entry: Array) -> Array:
    """The array with one entry replaced; no scatter, which is not native code in a loop."""
    return lax.dynamic_update_index_in_dim(array, entry, index, 0)
