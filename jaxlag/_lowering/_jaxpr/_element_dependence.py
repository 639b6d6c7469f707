"""Dependence of every element of a program's results on every element of its arguments.

The patterns of Jacobians follow from it. Every element carries the set of arguments that reach it,
as a row of a sparse matrix of truth values. Operations that only move elements run once on an array
of positions.

Source: Griewank, Walther, Evaluating Derivatives, 2nd ed., sec. 7.1 (index domains).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal
from scipy.sparse import csr_array, vstack

from jaxlag._core._arrays import concrete
from jaxlag._core._jaxprs import called
from jaxlag._lowering._jaxpr._array_primitives import MOVES, moved_positions
from jaxlag._lowering._jaxpr._elementwise_primitives import ELEMENTWISE
from jaxlag._lowering._jaxpr._from_jaxpr import known_results
from jaxlag._tracing._interpret import held

LARGEST = 4_000_000  # pairs of elements in one operation; beyond, all results depend on all


class Elements(NamedTuple):
    """An array, by what reaches its elements.

    Attributes:
        pattern: one row of truth values for each element, in C order; None if nothing does.
        known: its values, if they are known while tracing.
    """

    pattern: csr_array | None
    known: np.ndarray | None = None


def element_dependence(
    closed: ClosedJaxpr, given: Sequence[csr_array | None], columns: int
) -> list[csr_array]:
    """For every result the pattern of its elements.

    A dependence that cancels only algebraically is still listed, one that is not listed is
    certainly absent.

    Args:
        closed: the program.
        given: for each of its arguments the pattern of its elements; None if nothing is asked of
            it.
        columns: number of columns of the patterns.
    """
    found = _Followed(columns).run(closed, [Elements(x) for x in given])
    sizes = [v.aval.size for v in closed.jaxpr.outvars]
    return [
        csr_array((size, columns), dtype=bool) if x.pattern is None else x.pattern
        for size, x in zip(sizes, found, strict=True)
    ]


class _Followed:
    """The operations of a program on `Elements`."""

    def __init__(self, columns: int) -> None:
        self.columns = columns

    def run(self, closed: ClosedJaxpr, args: Sequence[Elements]) -> list[Elements]:
        """The results of a program."""
        known: dict[Any, Elements] = dict(zip(closed.jaxpr.invars, args, strict=True))
        for var, value in zip(closed.jaxpr.constvars, closed.consts, strict=True):
            known[var] = Elements(None, held(value) if concrete(value) else None)

        def value(atom: Any) -> Elements:
            return Elements(None, held(atom.val)) if isinstance(atom, Literal) else known[atom]

        for eqn in closed.jaxpr.eqns:
            known |= zip(
                eqn.outvars, self._equation(eqn, list(map(value, eqn.invars))), strict=True
            )
        return [value(atom) for atom in closed.jaxpr.outvars]

    def _equation(self, eqn: Any, operands: list[Elements]) -> list[Elements]:
        inner, name = called(eqn), eqn.primitive.name
        if inner is not None:
            return self.run(inner, operands)
        if name == "cond":
            return self._cond(eqn, operands)
        if all(x.pattern is None for x in operands):
            if any(x.known is None for x in operands) or name in _LOOPS:
                return [Elements(None)] * len(eqn.outvars)
            found = known_results(eqn, [x.known for x in operands])
            return [Elements(None, x) for x in found]
        if name in MOVES:
            return self._moved(eqn, operands)
        if name in ELEMENTWISE:
            shape = eqn.outvars[0].aval.shape
            parts = [
                _at(x.pattern, np.broadcast_to(_places(v.aval.shape), shape))
                for x, v in zip(operands, eqn.invars, strict=True)
            ]
            return [Elements(_union(parts))]
        if name.startswith("reduce_") and "axes" in eqn.params:
            return [Elements(_grouped(operands[0].pattern, _groups(eqn)))]
        if name in _SCATTERS and operands[1].known is not None:
            return [self._scattered(eqn, operands)]
        if name == "dot_general":
            return [self._dot(eqn, operands)]
        return self._all(eqn, operands)

    def _all(self, eqn: Any, operands: list[Elements]) -> list[Elements]:
        """All results depend on all that reaches an operand."""
        reach = np.zeros((1, self.columns), bool)
        for x in operands:
            if x.pattern is not None:
                reach[:, x.pattern.indices] = True
        row = csr_array(reach)
        return [Elements(_at(row, np.zeros(v.aval.size, int))) for v in eqn.outvars]

    def _cond(self, eqn: Any, operands: list[Elements]) -> list[Elements]:
        """The union of all branches, and of what reaches the index."""
        index, *rest = operands
        branches = [self.run(branch, rest) for branch in eqn.params["branches"]]
        (chosen, *_) = self._all(eqn, [index]) if index.pattern is not None else (index,)
        results = []
        for var, *found in zip(eqn.outvars, *branches, strict=True):
            parts = [x.pattern for x in found]
            if chosen.pattern is not None:
                parts.append(_at(chosen.pattern[[0]], np.zeros(var.aval.size, int)))
            results.append(Elements(_union(parts)))
        return results

    def _moved(self, eqn: Any, operands: list[Elements]) -> list[Elements]:
        count = MOVES[eqn.primitive.name]
        count = len(operands) if count is None else count
        if any(x.known is None for x in operands[count:]):
            return self._all(eqn, operands)
        shapes = [v.aval.shape for v in eqn.invars[:count]]
        index = moved_positions(eqn, shapes, [x.known for x in operands[count:]])
        sizes = [int(np.prod(shape)) for shape in shapes]
        none = csr_array((1, self.columns), dtype=bool)  # of a filling outside of an array
        parts = [
            csr_array((size, self.columns), dtype=bool) if x.pattern is None else x.pattern
            for size, x in zip(sizes, operands, strict=False)
        ]
        pool = csr_array(vstack([*parts, none], format="csr"))
        return [Elements(_at(pool, x)) for x in index]

    def _scattered(self, eqn: Any, operands: list[Elements]) -> Elements:
        """The union of an element and of the updates that meet it."""
        into, where, updates = operands
        shape, given = eqn.invars[0].aval.shape, eqn.invars[2].aval.shape
        p = eqn.params

        def landed(x: Any) -> Any:
            zero, at = jnp.zeros(shape), jnp.asarray(where.known)
            numbers, mode = p["dimension_numbers"], p["mode"]
            return jax.lax.scatter_add(zero, at, x, numbers, mode=mode)

        with jax.ensure_compile_time_eval():  # the transpose reads the place of every update
            (places,) = jax.linear_transpose(landed, jnp.zeros(given))(
                1.0 + jnp.arange(np.prod(shape, dtype=int), dtype=float).reshape(shape)
            )
        target = np.rint(np.asarray(places).ravel()).astype(int) - 1
        arrived = target >= 0
        pick = csr_array(
            (np.ones(arrived.sum(), bool), (target[arrived], np.flatnonzero(arrived))),
            shape=(int(np.prod(shape)), target.size),
        )
        return Elements(_union([into.pattern, _grouped(updates.pattern, pick)]))

    def _dot(self, eqn: Any, operands: list[Elements]) -> Elements:
        """The union over the summed pairs; pairs with a known zero are left out."""
        ((left, right), (left_batch, right_batch)) = eqn.params["dimension_numbers"]
        shapes = [v.aval.shape for v in eqn.invars]
        summed = [shapes[0][i] for i in left]
        size, out = int(np.prod(summed)), eqn.outvars[0].aval.shape
        if size * int(np.prod(out)) > LARGEST:
            return self._all(eqn, operands)[0]
        sides = []
        for k, (contracted, batch) in enumerate(((left, left_batch), (right, right_batch))):
            free = [i for i in range(len(shapes[k])) if i not in (*contracted, *batch)]
            at = _places(shapes[k]).transpose(*batch, *free, *contracted)
            batches = [shapes[k][i] for i in batch]
            here = [shapes[k][i] for i in free]
            others = len(out) - len(batches) - len(here)
            wide = (*here, *[1] * others) if k == 0 else (*[1] * others, *here)
            sides.append(np.broadcast_to(at.reshape(*batches, *wide, size), (*out, size)))
        counts = np.ones(sides[0].size, bool)
        for x, at in zip(operands, sides, strict=True):
            if x.known is not None:
                counts &= x.known.ravel()[at.ravel()] != 0
        result = np.repeat(np.arange(int(np.prod(out))), size)[counts]
        parts = []
        for x, v, at in zip(operands, eqn.invars, sides, strict=True):
            pick = csr_array(
                (np.ones(result.size, bool), (result, at.ravel()[counts])),
                shape=(int(np.prod(out)), v.aval.size),
            )
            parts.append(_grouped(x.pattern, pick))
        return Elements(_union(parts))


_LOOPS = ("while", "scan")
_SCATTERS = ("scatter", "scatter-add", "scatter-mul", "scatter-min", "scatter-max")


def _places(shape: tuple[int, ...]) -> np.ndarray:
    return np.arange(int(np.prod(shape))).reshape(shape)


def _at(pattern: csr_array | None, index: np.ndarray) -> csr_array | None:
    """The rows at these places."""
    return None if pattern is None else csr_array(pattern[np.ravel(index)])


def _union(parts: Sequence[csr_array | None]) -> csr_array | None:
    found = None
    for part in parts:
        if part is not None:
            found = part if found is None else csr_array(found + part)
    return found


def _groups(eqn: Any) -> csr_array:
    """Which elements every result of a reduction reads."""
    shape, axes = eqn.invars[0].aval.shape, eqn.params["axes"]
    kept = tuple(1 if i in axes else n for i, n in enumerate(shape))
    result = np.broadcast_to(_places(kept), shape).ravel()
    ones = np.ones(result.size, bool)
    return csr_array(
        (ones, (result, np.arange(result.size))),
        shape=(max(1, np.prod(kept, dtype=int)), result.size),
    )


def _grouped(pattern: csr_array | None, pick: csr_array) -> csr_array | None:
    """The union of the rows that `pick` lists."""
    return None if pattern is None else csr_array(pick @ pattern)
