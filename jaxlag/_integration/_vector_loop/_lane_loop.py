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

from jaxlag._core._buffer_entries import is_set_entry, set_entries
from jaxlag._integration._vector_loop._flat_program import Value, flat
from jaxlag._integration._vector_loop._lane_map import MULTIPLE, WIDTH, array_of, on_rows, rows_of
from jaxlag._integration._vector_loop._turn import Turn, changing, split, turn_of

_loop_p = Primitive("lane_loop")
_loop_p.multiple_results = True


class _Parts(NamedTuple):
    """What belongs to each program of a loop: the program itself, or its constants.

    Attributes:
        cond: condition.
        body: body.
        results: results.
        is_due: whether `between` is due; None if it never is.
        between: what comes between turns; None with `is_due`.
    """

    cond: Any
    body: Any
    results: Any
    is_due: Any = None
    between: Any = None


def lane_loop(
    cond: Callable,
    body: Callable,
    results: Callable,
    init: PyTree,
    is_due: Callable | None = None,
    between: Callable | None = None,
) -> PyTree:
    """results(x) of the last x, under `jax.vmap` only.

    Args:
        cond: whether there is a next turn.
        body: x -> x.
        results: of x.
        init: x at the start, a pytree of arrays.
        is_due: whether `between` comes before the next turn; None if it never does.
        between: x -> x, seldom and not vectorized.

    Raises:
        NotVectorizable: the body has no form on numbers.
    """
    leaves, tree = jax.tree.flatten(init)

    def of(function: Callable) -> Callable:
        return lambda *leaves: jax.tree.leaves(function(jax.tree.unflatten(tree, leaves)))

    functions = [x for x in (cond, body, results, is_due, between) if x is not None]
    programs, consts = zip(*(flat(of(f), *leaves) for f in functions), strict=True)
    given = [x for part in consts for x in part]
    found = _loop_p.bind(*given, *leaves, programs=_Parts(*programs))
    return jax.tree.unflatten(jax.tree.structure(jax.eval_shape(results, init)), found)


@_loop_p.def_abstract_eval
def _(*_: Any, programs: _Parts) -> list[Any]:
    results = programs.results
    kinds = map(results.aval, results.outputs)
    return [ShapedArray(x.shape, x.dtype) for x in kinds]


def _batched(args: Sequence[Any], axes: Sequence[Any], *, programs: _Parts) -> tuple[list, list]:
    count = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    given = [
        _Batch(jnp.asarray(x), None) if axis is None else _Batch(jnp.moveaxis(x, axis, 0), 0)
        for x, axis in zip(args, axes, strict=True)
    ]
    consts = []
    for program in filter(None, programs):
        size = len(program.consts)
        consts.append(given[:size])
        given = given[size:]
    found = _Loop.of(programs, _Parts(*consts), given, count).run()
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

    def of_all(self, count: int) -> Array:
        """Those of all trajectories."""
        shape = (count, *self.array.shape)
        return jnp.broadcast_to(self.array, shape) if self.axis is None else self.array


class _Lanes(NamedTuple):
    """The trajectories in the lanes.

    Attributes:
        consts: constants of each program, (lanes, ...); those that all share are empty.
        state: the same of the state.
        trajectory: index of each; beyond the last one if a lane has none.
        following: index of the next one.
        kept: buffers of all trajectories by their place in the state, (trajectories, ...). The
            state has empty arrays there.
        results: the other results of all that have ended, (trajectories, ...).
    """

    consts: _Parts
    state: list[Array]
    trajectory: Array
    following: Array
    kept: dict[int, Array]
    results: list[Array]


_Carry = tuple[dict[int, Array], dict[int, Array]]  # rows of changing numbers, buffers


class _Loop(NamedTuple):
    """The loop over all lanes. Numbers are rows of lanes, by their number in the turn's program.

    Attributes:
        programs: those of the loop; its results without the kept buffers.
        consts: constants of each.
        start: the state at the start.
        count: number of trajectories.
        turn: the body in parts.
        moving: next values of the numbers that change and are needed.
        kept: buffers that are results: place in the state -> place among the results. They are
            written where they stay, because copies of them take longer than turns.
    """

    programs: _Parts
    consts: _Parts
    start: list[_Batch]
    count: int
    turn: Turn
    moving: dict[int, Value]
    kept: dict[int, int]

    @classmethod
    def of(cls, programs: _Parts, consts: _Parts, start: list[_Batch], count: int) -> "_Loop":
        """The loop, prepared."""
        body, turn = programs.body, turn_of(programs.body)
        wanted = body.read_by(turn.before)
        for program in filter(None, programs._replace(body=None)):
            outputs: Sequence[Value] = program.outputs
            if program is programs.between:  # the rest of the state passes through unchanged
                both = zip(program.inputs, outputs, strict=True)
                outputs = [y for x, y in both if not isinstance(y, int) or y != x]
            read = program.read_by(program.operations, outputs)
            pairs = zip(body.inputs, program.inputs, strict=True)
            wanted |= {x for x, same in pairs if same in read}
        kept, results = _kept(programs, turn), programs.results
        outputs = [x for i, x in enumerate(results.outputs) if i not in kept.values()]
        others = results._replace(operations=results.needed(outputs), outputs=tuple(outputs))
        programs = programs._replace(results=others)
        return cls(programs, consts, start, count, turn, changing(turn, wanted), kept)

    @property
    def size(self) -> int:
        """Number of lanes."""
        return min(WIDTH, -(-self.count // MULTIPLE) * MULTIPLE)

    # ---- Trajectories --------------------------------------------------------------------------

    def run(self) -> list[Array]:
        """The results of all trajectories."""
        first = jnp.arange(self.size)
        loaded = jax.vmap(self.loaded)(jnp.minimum(first, self.count - 1))
        kept = {place: self.start[place].of_all(self.count) for place in self.kept}
        kinds = map(self.programs.results.aval, self.programs.results.outputs)
        results = [jnp.zeros((self.count, *x.shape), x.dtype) for x in kinds]
        lanes = _Lanes(*loaded, first, jnp.asarray(self.size), kept, results)
        lanes = lax.while_loop(lambda x: jnp.any(self.busy(x)), self.until_one_ends, lanes)
        found = list(lanes.results)
        for place, i in sorted(self.kept.items(), key=lambda item: item[1]):
            found.insert(i, lanes.kept[place])
        return found

    def busy(self, lanes: _Lanes) -> Array:
        """Lanes with a trajectory."""
        return lanes.trajectory < self.count

    def goes_on(self, lanes: _Lanes, state: list[Array]) -> Array:
        """Lanes with a next turn."""
        return _vmapped(self.programs.cond, self.consts.cond, lanes.consts.cond, state)[0]

    def is_due(self, lanes: _Lanes, state: list[Array]) -> Array:
        """Lanes in which `between` comes first."""
        is_due = self.programs.is_due
        if is_due is None:
            return jnp.zeros((self.size,), bool)
        return _vmapped(is_due, self.consts.is_due, lanes.consts.is_due, state)[0]

    def loaded(self, trajectory: Array) -> tuple[_Parts, list[Array]]:
        """(constants, state) at the start of a trajectory."""

        def own(batches: list[_Batch] | None) -> list[Array] | None:
            if batches is None:
                return None
            return [jnp.zeros(0) if x.axis is None else x.of(trajectory) for x in batches]

        starts = enumerate(self.start)
        state = [jnp.zeros(0) if i in self.kept else x.of(trajectory) for i, x in starts]
        return _Parts(*map(own, self.consts)), state

    def until_one_ends(self, lanes: _Lanes) -> _Lanes:
        """Turns until a trajectory ends, whose lane takes the next one, or `between` is due.

        What belongs to the other case is computed as well, and dropped.
        """
        lanes = self.turns(lanes)
        goes_on = self.goes_on(lanes, lanes.state)
        lane = jnp.argmax(self.busy(lanes) & ~(goes_on & ~self.is_due(lanes, lanes.state)))
        ended, index = ~_entry(goes_on, lane), _entry(lanes.trajectory, lane)
        consts, state = jax.tree.map(lambda x: _entry(x, lane), (lanes.consts, lanes.state))
        # If the trajectory has not ended, these are replaced later.
        given = _whole(self.consts.results, consts.results)
        found = map(jnp.asarray, self.programs.results(given, state))
        results = [_put(x, index, y) for x, y in zip(lanes.results, found, strict=True)]
        new, kept = self.loaded(jnp.minimum(lanes.following, self.count - 1)), lanes.kept
        trajectory = lanes.following
        if self.programs.between is not None:
            state, kept = self.between(kept, index, ended, consts, state)
            new = jax.tree.map(lambda x, y: jnp.where(ended, x, y), new, (consts, state))
            trajectory = jnp.where(ended, trajectory, index)
        consts, state = jax.tree.map(
            lambda x, y: _put(x, lane, y), (lanes.consts, lanes.state), new
        )
        trajectory = _put(lanes.trajectory, lane, trajectory)
        following = lanes.following + ended.astype(lanes.following.dtype)
        return _Lanes(consts, state, trajectory, following, kept, results)

    def between(
        self, kept: dict[int, Array], index: Array, ended: Array, consts: _Parts, state: list
    ) -> tuple[list[Array], dict[int, Array]]:
        """The state of a lane after `between`, and the kept buffers."""
        program = self.programs.between
        read = program.read_by(program.operations)
        pairs = enumerate(zip(program.inputs, program.outputs, strict=True))
        used = [i for i, (x, after) in pairs if i in self.kept and (x in read or x != after)]
        before = [_entry(kept[i], index) if i in used else x for i, x in enumerate(state)]
        after = program(_whole(self.consts.between, consts.between), before)
        new = {i: _put(kept[i], index, jnp.where(ended, before[i], after[i])) for i in used}
        pairs = enumerate(zip(state, after, strict=True))
        return [x if i in self.kept else y for i, (x, y) in pairs], kept | new

    # ---- Turns ---------------------------------------------------------------------------------

    def turns(self, lanes: _Lanes) -> _Lanes:
        """Turns until a trajectory has ended, or `between` is due."""
        body = self.turn.body
        consts = [
            x if batch.axis == 0 else jnp.broadcast_to(batch.array, (self.size, *batch.array.shape))
            for x, batch in zip(lanes.consts.body, self.consts.body, strict=True)
        ]
        values = *body.consts, *body.inputs
        known = dict(zip(values, (*consts, *lanes.state), strict=True))
        empty = {body.inputs[i]: lanes.state[i] for i in self.kept}
        fixed: dict[int, Array] = {}
        for source in self.turn.elements.keys() & known.keys():
            fixed |= dict(zip(self.turn.elements[source], rows_of(known[source]), strict=True))

        def state(carry: _Carry) -> list[Array]:
            rows, buffers = fixed | carry[0], carry[1]
            arrays = {
                x: array_of([rows[number] for number in self.turn.elements[x]], known[x])
                for x in body.inputs
                if x not in buffers
            }
            return [(arrays | buffers | empty)[x] for x in body.inputs]

        def all_go_on(carry: _Carry) -> Array:
            now = state(carry)
            going = self.goes_on(lanes, now) & ~self.is_due(lanes, now)
            return jnp.all(going | ~self.busy(lanes))

        def one(carry: _Carry) -> _Carry:
            rows, found = fixed | carry[0], []
            if self.turn.found:
                given = self.consts.body, lanes.consts.body, state(carry)
                found = _vmapped(self.before, *given)
            for x, array in zip(self.turn.found, found, strict=True):
                rows |= dict(zip(self.turn.elements[x], rows_of(array), strict=True))
            return self.next(rows, carry[1], lanes)

        kept = {body.inputs[i]: x for i, x in lanes.kept.items()}
        buffers = {x: known[x] for x in self.turn.writes} | kept
        carry = lax.while_loop(all_go_on, one, ({x: fixed[x] for x in self.moving}, buffers))
        kept = {i: carry[1][body.inputs[i]] for i in self.kept}
        return lanes._replace(state=state(carry), kept=kept)

    def next(self, rows: dict[int, Array], buffers: dict[int, Array], lanes: _Lanes) -> _Carry:
        """One turn, after the operations that come before."""
        turn, buffers = self.turn, dict(buffers)
        kinds = [turn.body.aval(x) for x in turn.written]
        count = sum(x.size for x in kinds)
        new = on_rows(turn.numbers, [*self.moving.values(), *turn.numbers.last(count)], rows)
        entries = split(turn.body, turn.written, new[len(self.moving) :])
        shapes = [jax.ShapeDtypeStruct((self.size, *x.shape), x.dtype) for x in kinds]
        given = list(map(array_of, entries, shapes))
        for buffer, operation in turn.writes.items():
            count = len(operation.operands) - 1
            if turn.body.inputs.index(buffer) in self.kept:
                entries, indices = given[:count]
                given_to = lanes.trajectory, indices, entries, self.busy(lanes)
                buffers[buffer] = set_entries(buffers[buffer], *given_to)
            else:
                (buffers[buffer],) = jax.vmap(operation)(buffers[buffer], *given[:count])
            given = given[count:]
        return dict(zip(self.moving, new, strict=False)), buffers

    def before(self, consts: list, state: list) -> list:
        """Results of operations that come before a turn, of one lane."""
        body = self.turn.body
        known = dict(zip((*body.consts, *body.inputs), (*consts, *state), strict=True))
        return body.evaluate(self.turn.before, known, self.turn.found)


def _vmapped(
    function: Callable, batches: list[_Batch], consts: list[Array], state: list[Array]
) -> list[Array]:
    """function(constants, state) of all lanes."""
    axes = [x.axis for x in batches]
    return jax.vmap(function, in_axes=(axes, 0))(_whole(batches, consts), state)


def _whole(batches: list[_Batch], consts: list[Array]) -> list[Array]:
    """Constants, with those that all trajectories share."""
    pairs = zip(batches, consts, strict=True)
    return [x if batch.axis == 0 else batch.array for batch, x in pairs]


def _entry(array: Array, index: Array) -> Array:
    return lax.dynamic_index_in_dim(array, index, keepdims=False)


def _put(array: Array, index: Array, entry: Array) -> Array:
    """The array with one entry replaced; no scatter, which is not native code in a loop."""
    return lax.dynamic_update_index_in_dim(array, entry, index, 0)


def _kept(programs: _Parts, turn: Turn) -> dict[int, int]:
    """Places in the state of buffers that are results, and their places among the results."""
    body, results = programs.body, programs.results
    found = {}
    for i, (x, same) in enumerate(zip(body.inputs, results.inputs, strict=True)):
        outputs = enumerate(results.outputs)
        given_back = [k for k, value in outputs if isinstance(value, int) and value == same]
        if x not in turn.writes or not is_set_entry(turn.writes[x].params) or len(given_back) != 1:
            continue
        read = same in results.read_by(results.operations)
        for program in filter(None, (programs.cond, programs.is_due)):
            read |= program.inputs[i] in program.read_by(program.operations, program.outputs)
        if not read:
            found[i] = given_back[0]
    return found
