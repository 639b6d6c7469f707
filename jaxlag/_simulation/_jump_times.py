"""Jumps at times that depend on params: derivatives along a motion do not contain them.

Example: a force is switched on at the time b and jumps there. Derivatives are taken at frozen
steps, so that the jump does not move with b. The check searches the program for operations whose
outcome jumps and which read both the time and a differentiated number. It then compares the
equations on both sides of every change of outcome. If they only have a kink there, as between the
entries of an interpolated table, derivatives are right.
"""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import source_info_util
from jaxtyping import Array

from jaxlag._core._arrays import concrete
from jaxlag._core._custom_jvp import CustomJVP
from jaxlag._core._jaxprs import called, equations, within
from jaxlag._model._input_signals import AbstractInput, AbstractTable
from jaxlag._model._inputs import evaluate
from jaxlag._model._states import named_states
from jaxlag._system._closure_tracers import declared
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._closure_params import ParamsWithClosure, plain
from jaxlag._tracing._dependence import Names, outputs_depend_on
from jaxlag._tracing._input_values import InputValues
from jaxlag._tracing._nonsmooth_points import outcomes

_TIME, _STATE = "t", "q, v"
_GUARDS = ("eq", "ne", "is_finite")  # true or false at single points only
_STEPS = ("sign", "floor", "ceil", "round", "rem")
_LOOPS = ("scan", "while", "cond")
_NOT_RUN = ("pure_callback", "io_callback", "debug_callback", "debug_print", "while")
_SIZES = (1.0, 0.1, 1e-3)  # of random states: terms may be nonfinite at the larger ones
_CLOSED_OVER = "a number that a declared function closes over"
_TOGETHER = 64  # times at which outcomes are computed in one batch
_SPANS = 32  # number of batches
_PLACES = 16  # changes of an operation that are examined from both sides
_HALVINGS = 60


class Jump(NamedTuple):
    """An operation whose outcome jumps when a number changes.

    Attributes:
        leaf: path of the number in params or inputs.
        line: source line of the operation.
    """

    leaf: str
    line: str


class _Found(NamedTuple):
    """An operation, the names of its inputs, and its source line."""

    eqn: Any
    names: Names
    line: str


class Jumps:
    """The operations of a declaration whose outcomes jump.

    Args:
        system: the mechanical system.
        params: as simulate takes them, with the values in closures.
        q: coordinates; only their number and dtype are used.
        inputs: by name. Tables, and functions with knots, jump at ends of steps.
    """

    def __init__(self, system: System, params: Any, q: Any, inputs: Mapping[str, Any]) -> None:
        self._system = system
        inside = {name: x for name, x in inputs.items() if not _has_knots(x)}
        outside = {name: x for name, x in inputs.items() if name not in inside}
        self._traced, self._static = _params.halves((params, inside))
        t = jax.ShapeDtypeStruct((), jnp.result_type(float))
        shape = jax.ShapeDtypeStruct(q.shape, q.dtype)

        def values_at(t: Array, q: Array, v: Array) -> dict[str, Any]:
            return dict(evaluate(outside, t, q, v, params))

        values = jax.eval_shape(values_at, t, shape, shape)
        timed = dict.fromkeys(values, _TIME)
        if system.states is not None:
            x = jax.ShapeDtypeStruct((system.states.size,), q.dtype)
            beside = jax.eval_shape(partial(named_states, system.states), x)
            values, timed = values | beside, timed | dict.fromkeys(beside, _STATE)
        self._known = not outside
        self._moving = t, shape, shape, values
        paths = jax.tree_util.tree_flatten_with_path(values)[0]
        moving = [_TIME, _STATE, _STATE, *[timed[path[0].key] for path, _ in paths]]
        names = [frozenset({name}) for name in (*moving, *names_of(*self._traced))]
        self._found: list[_Found] = []
        self._line = "an unknown line"
        self._program = jax.make_jaxpr(self._declared)(*self._moving, self._traced)
        outputs_depend_on(self._program.jaxpr, names, self._look, continuous=True)

    def _declared(self, t: Array, q: Array, v: Array, values: Any, traced: Any) -> Any:
        params, inside = _params.join(traced, self._static)
        found = InputValues(values | dict(evaluate(inside, t, q, v, params)))
        return declared(self._system, t, q, v, params, found, None)

    def _look(self, eqn: Any, operands: list[Names]) -> None:
        # Operations inside JAX's own functions have no line: the line of the call is used.
        self._line = source_info_util.summarize(eqn.source_info) or self._line
        names = frozenset().union(*operands)
        if names - {_TIME, _STATE} and _jumps(eqn):
            self._found.append(_Found(eqn, names, self._line))

    def of_leaves(self) -> tuple[Jump, ...]:
        """All operations, with the numbers that they compare."""
        return _by_number(self._found)

    def in_time(self, leaves: set[str], ts: Any) -> tuple[Jump, ...]:
        """The operations that compare one of the leaves with the time and make the equations jump.

        Unknown numbers are replaced by random ones. An undecided case counts as a jump.
        """
        among = [x._replace(names=x.names & {_TIME, *leaves}) for x in self._found if _timed(x)]
        among = [x for x in among if x.names - {_TIME}]
        if among and self._may_be_run():
            with jax.ensure_compile_time_eval(), jax.debug_nans(False), jax.debug_infs(False):
                jump = self._jump([x.eqn for x in among], ts)
            among = [x for x, does in zip(among, jump, strict=True) if does]
        return _by_number(among)

    def _may_be_run(self) -> bool:
        """Whether the program may be run with random numbers.

        It may not if this has visible effects, or if a loop might not end.
        """
        leaves = jax.tree.leaves(self._traced)
        numbers = [x for x in leaves if not concrete(x)]
        known = all(jnp.issubdtype(x.dtype, np.number) or x.dtype == bool for x in numbers)
        calls = {eqn.primitive.name for eqn in equations(self._program)} & set(_NOT_RUN)
        return known and not calls and concrete(self._program.consts)

    def _jump(self, eqns: Sequence[Any], ts: Any) -> list[bool]:
        """Whether the equations jump, or may jump, where the operations change their outcome."""
        leaves, known = self._numbers()
        times = _params.known(ts)
        known = known and times is not None
        grid = _grid(times if known else None, leaves[0].dtype)
        moves = [True] + [False] * (len(leaves) - 1)

        def outcome(t: Array) -> list[Array | None]:
            given = [t, *leaves[1:]]
            return [outcomes(self._program, given, moves, only=eqn) for eqn in eqns]

        along = jax.jit(jax.vmap(outcome))
        terms = [self._sides(leaves, size) for size in _SIZES]

        def jumps(i: int, eqn: Any) -> bool:
            if spans[0][i] is None or eqn.primitive.name in _LOOPS:  # comparisons in it are hidden
                return _jumps_anywhere(terms, grid)
            seen = np.concatenate([np.asarray(span[i]) for span in spans])
            if np.all(seen[1:] == seen[:-1]):
                return not known
            return _jumps_at_changes(lambda t: np.asarray(along(t)[i]), seen, terms, grid)

        try:
            spans = [along(jnp.asarray(span)) for span in grid]
            return [jumps(i, eqn) for i, eqn in enumerate(eqns)]
        except Exception:  # the user's functions may reject random numbers
            return [True] * len(eqns)

    def _sides(self, leaves: Sequence[Array], size: float) -> Callable:
        """Terms at many times, with states of this size."""
        t, q, v, *rest = leaves
        return jax.jit(jax.vmap(partial(self._terms, [t, size * q, size * v, *rest])))

    def _numbers(self) -> tuple[list[Array], bool]:
        """(arguments of the program, whether all are known); unknown ones are random."""
        draw = np.random.default_rng(0).uniform
        known, found = self._known, []
        for x in jax.tree.leaves(self._moving):
            found.append(jnp.asarray(draw(0.5, 1.5, x.shape), x.dtype))
        for x in jax.tree.leaves(self._traced):
            value = x if concrete(x) else _params.known(x)
            known = known and value is not None
            if value is None:  # sorted, as tables are
                value = np.sort(draw(0.5, 1.5, (1, *x.shape)), axis=-1)[0]
                value = value > 1.0 if x.dtype == bool else value
            found.append(jnp.asarray(value, x.dtype))
        return found, known

    def _terms(self, leaves: Sequence[Array], t: Array) -> Array:
        """The terms of the equations of motion, as one array of numbers."""
        tree = jax.tree.structure((*self._moving, self._traced))
        _, q, v, *rest = jax.tree.unflatten(tree, leaves)

        def momenta(t: Array) -> Any:
            by_v = jax.grad(lambda v: self._declared(t, q, v, *rest)[0])(v)
            return by_v, self._declared(t, q, v, *rest)[1:3]

        by_q = jax.grad(lambda q: self._declared(t, q, v, *rest)[0])(q)
        rates = jax.jvp(momenta, (t,), (jnp.ones_like(t),))
        terms = jax.tree.leaves((by_q, rates, self._declared(t, q, v, *rest)[3:]))
        return jnp.concatenate([jnp.ravel(x).astype(t.dtype) for x in terms])


def warned(jumps: Jumps, given: tuple[Any, Any], ts: Any) -> tuple[Any, Any]:
    """Params and inputs unchanged; a warning is issued if derivatives move the time of a jump.

    Args:
        jumps: of the declaration.
        given: traced halves of the params, with values in closures, and of the inputs.
        ts: times of the motion.
    """
    names = names_of(*given)

    @CustomJVP
    def same(*leaves: Any) -> list[Any]:
        return list(leaves)

    @partial(same.defjvp, symbolic_zeros=True)
    def same_jvp(primals: Any, tangents: Any) -> Any:
        moving = {name for name, dot in zip(names, tangents, strict=True) if dot is not None}
        warn(jumps.in_time(moving, ts))
        return list(primals), list(tangents)

    leaves, tree = jax.tree.flatten(given)
    return jax.tree.unflatten(tree, same(*leaves))


def warn(jumps: Iterable[Jump]) -> None:
    """Warn of numbers whose derivatives are wrong, with the remedy."""
    for leaf, line in jumps:
        warnings.warn(
            f"Derivatives with respect to {leaf} are incomplete. It is compared with t at {line}, "
            "so it sets a time at which the equations jump, and the derivative of this time is "
            "missing. Make that time a knot: pass inputs={name: jl.ZeroOrderHold(times, values)}, "
            "where the times depend on the params, or jl.TimeFunction(f, knots=times), and read "
            "this input in the force.",
            UserWarning,
            stacklevel=1,
        )


def names_of(params: Any, inputs: Any = None) -> list[str]:
    """Names of the leaves of params, with values in closures, and of inputs, by their paths."""
    own = jax.tree_util.tree_flatten_with_path(plain(params))[0]
    names = [f"params{jax.tree_util.keystr(path)}" for path, _ in own]
    if isinstance(params, ParamsWithClosure):
        names += [_CLOSED_OVER] * len(jax.tree.leaves(params.values))
    signals = jax.tree_util.tree_flatten_with_path(inputs)[0]
    return names + [f"inputs{jax.tree_util.keystr(path)}" for path, _ in signals]


def _has_knots(signal: Any) -> bool:
    if isinstance(signal, AbstractTable):
        return True
    return isinstance(signal, AbstractInput) and signal.knots() is not None


def _jumps(eqn: Any) -> bool:
    """Whether its outcome jumps when a number changes."""
    if eqn.primitive.name in _LOOPS:
        return any(map(_jumps, within(eqn)))
    if called(eqn) is not None:
        return False
    given, found = ([_is_inexact(x) for x in some] for some in (eqn.invars, eqn.outvars))
    name = eqn.primitive.name
    return any(given) and (name in _STEPS or (not all(found) and name not in _GUARDS))


def _is_inexact(atom: Any) -> bool:
    return jnp.issubdtype(atom.aval.dtype, jnp.inexact)


def _timed(found: _Found) -> bool:
    return _TIME in found.names and _STATE not in found.names


def _by_number(found: Iterable[_Found]) -> tuple[Jump, ...]:
    """Each operation once per number that it reads."""
    jumps = [Jump(name, x.line) for x in found for name in sorted(x.names - {_TIME, _STATE})]
    return tuple(dict.fromkeys(jumps))


def _grid(times: np.ndarray | None, dtype: Any) -> np.ndarray:
    """Times for the outcomes, in batches: of the motion, or of various sizes."""
    count = _TOGETHER * _SPANS
    if times is not None:
        return np.linspace(np.min(times), np.max(times), count, dtype=dtype).reshape(_SPANS, -1)
    largest = min(1e4, 1e-2 / np.sqrt(jnp.finfo(dtype).eps))  # up to here times are resolved
    sizes = np.geomspace(1e-3, largest, count // 4, dtype=dtype)
    near = np.linspace(-10.0, 10.0, count // 2, dtype=dtype)
    return np.sort(np.concatenate([-sizes, near, sizes])).reshape(_SPANS, -1)


def _jumps_at_changes(
    outcome: Callable, seen: np.ndarray, terms: Sequence[Callable], grid: np.ndarray
) -> bool:
    """Whether terms jump where an outcome changes along the grid."""
    changed = np.flatnonzero(np.any(seen[1:] != seen[:-1], axis=1))
    some = changed[np.linspace(0, len(changed) - 1, _PLACES).astype(int)]
    places = np.resize(some, _TOGETHER)
    low, high = near = grid.ravel()[places], grid.ravel()[places + 1]
    for _ in range(_HALVINGS):
        middle = (0.5 * (low + high)).astype(low.dtype)
        same = np.all(outcome(jnp.asarray(middle)) == seen[places], axis=1)
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    _, found = _finite(terms, [low, high, *near])
    return found is None or _jump_between(*found)


def _jumps_anywhere(terms: Sequence[Callable], grid: np.ndarray) -> bool:
    """Whether terms jump along the grid; tested where their slope changes most."""
    sides, found = _finite(terms, list(grid))
    if found is None:
        return True
    found = np.concatenate(found)
    size = np.max(np.abs(found), axis=0)
    size = np.where(size > 0, size, 1.0)
    bend = np.max(np.abs(np.diff(found, 2, axis=0)) / size, axis=1)
    worst = np.argsort(bend)[-_PLACES:]
    places = np.resize(np.concatenate([worst, worst + 1]), _TOGETHER)
    low, high = near = grid.ravel()[places], grid.ravel()[places + 1]
    for _ in range(_HALVINGS):
        middle = (0.5 * (low + high)).astype(low.dtype)
        a, b, c = (np.asarray(sides(jnp.asarray(x))) for x in (low, middle, high))
        left = np.max(np.abs(b - a) / size, axis=1) >= np.max(np.abs(c - b) / size, axis=1)
        low, high = np.where(left, low, middle), np.where(left, middle, high)
    return _jump_between(*(np.asarray(sides(jnp.asarray(x))) for x in (low, high, *near)))


def _finite(
    terms: Sequence[Callable], times: Sequence[np.ndarray]
) -> tuple[Callable, list[np.ndarray] | None]:
    """(terms with the first size of states that makes them finite at all times, their values)."""
    for sides in terms:
        found = [np.asarray(sides(jnp.asarray(x))) for x in times]
        if np.all(np.isfinite(found)):
            return sides, found
    return terms[-1], None


def _jump_between(before: np.ndarray, after: np.ndarray, *near: np.ndarray) -> bool:
    """Whether terms jump between two times, relative to their size nearby; True if undecided."""
    size = np.max(np.abs([before, after, *near]), axis=(0, 1))
    jump = np.abs(after - before) > np.sqrt(np.finfo(before.dtype).eps) * size
    return bool(np.any(jump) or not np.all(np.isfinite(before + after)))
