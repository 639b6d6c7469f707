"""Row layout: constraint rows A v + b and their contents, from the jaxpr and not from values."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import ClosedJaxpr

from jaxlag._core._errors import invalid
from jaxlag._lowering._graph._expression import Graph, Node, order
from jaxlag._lowering._graph._straight_line import ANALYTIC
from jaxlag._lowering._graph._traversal import substitute
from jaxlag._lowering._jaxpr._differentiate import gradient
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported, read
from jaxlag._lowering._jaxpr._node_arrays import nodes
from jaxlag._model._constraints import NO_ROWS, AbstractConstraint, ConstraintRows
from jaxlag._model._quasi_velocities import QuasiVelocities
from jaxlag._tracing import _params
from jaxlag._tracing._dependence import outputs_depend_on
from jaxlag._tracing._index_check import check_indices

LIMIT = 20_000  # scalar operations: beyond, the analysis takes too long for its benefit


class Contents(NamedTuple):
    """Properties of a row that hold in every state and for all params.

    Attributes:
        affine: whether the row is affine in v according to its program.
        empty: whether A is zero.
        driven: whether b may differ from zero: False only if it certainly is zero.
        sure: whether A certainly does not vanish wherever the row holds, as rounding would.
        zero: whether the residual is 0, and phi as well.
    """

    affine: bool
    empty: bool
    driven: bool
    sure: bool = False
    zero: bool = False


def layout(
    constraints: tuple[AbstractConstraint, ...], params: Any, n: int, dtype: Any
) -> ConstraintRows:
    """The rows of all constraints, for such params; checked to be affine in v."""
    if not constraints:
        return NO_ROWS
    traced, static = _params.split(params)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), traced)
    keys = _params.Static(like), _params.Static(static)
    return layout_of(constraints, *keys, n, jnp.dtype(dtype))


@lru_cache(maxsize=256)
def layout_of(
    constraints: tuple[AbstractConstraint, ...],
    like: _params.Static,
    static: _params.Static,
    n: int,
    dtype: Any,
) -> ConstraintRows:
    """The same, from shapes and dtypes of the traced params and the values of the static ones."""
    shapes: list[tuple[str, tuple[int, ...]]] = []
    labels: list[str] = []
    holonomic: list[bool] = []
    driven: list[bool] = []
    sure: list[bool] = []
    for constraint in constraints:

        def of_v(t: Array, q: Array, v: Array, traced: Any, c: Any = constraint) -> Array:
            return c.velocity(t, q, v, _params.join(traced, static.tree))

        def residual(t: Array, q: Array, v: Array, traced: Any, c: Any = constraint) -> Array:
            params = _params.join(traced, static.tree)
            return c.position(t, q, params) if c.holonomic else c.velocity(t, q, v, params)

        def raw(t: Array, q: Array, v: Array, traced: Any, c: Any = constraint) -> Any:
            params = _params.join(traced, static.tree)
            return c.phi(t, q, params) if c.holonomic else c.residual(t, q, v, params)

        t = jax.ShapeDtypeStruct((), jnp.result_type(float))
        q = jax.ShapeDtypeStruct((n,), dtype)
        argument = f"constraint {constraint.names!r}"
        (count,) = jax.eval_shape(of_v, t, q, q, like.tree).shape
        written = jax.make_jaxpr(raw)(t, q, q, like.tree)
        check_indices(written, _watched(like, "v"), argument)
        if isinstance(constraint.names, str):
            (shape,) = (x.shape for x in written.out_avals)
            shapes.append((constraint.names, shape))
            labels += [
                f"{constraint.names}[{i}]" if shape else constraint.names for i in range(count)
            ]
        else:
            shapes += [(name, ()) for name in constraint.names]
            labels += constraint.names
        holonomic += [constraint.holonomic] * count
        contents = _examine(constraint, labels[-count:], like, static, n, dtype)
        driven += [row.driven for row in contents]
        sure += [row.sure for row in contents]
    return ConstraintRows(
        tuple(shapes), tuple(labels), tuple(holonomic), tuple(driven), tuple(sure)
    )


def _watched(like: _params.Static, speeds: str) -> list[str | None]:
    """Names of the vectors among (t, q, speeds, params)."""
    return [None, "q", speeds, *(None for _ in jax.tree.leaves(like.tree))]


def _examine(
    constraint: AbstractConstraint,
    labels: list[str],
    like: _params.Static,
    static: _params.Static,
    n: int,
    dtype: Any,
) -> list[Contents]:
    """Contents of each row; raises for rows that are not affine in v, or nonzero without v."""
    position = constraint.position if constraint.holonomic else None
    rows = examine(constraint.velocity, position, like, static, n, dtype)
    not_affine = [label for label, row in zip(labels, rows, strict=True) if not row.affine]
    if not_affine:
        raise invalid(
            f"constraint {_listed(not_affine)}: residual",
            "be affine in v",
            "its derivative with respect to v contains v in the traced program",
            f"Write A(t, q) v + b(t, q): {_AFFINE.format('v')}",
        )
    empty = [label for label, row in zip(labels, rows, strict=True) if row.empty and not row.zero]
    if empty:
        raise invalid(
            f"constraint {_listed(empty)}",
            "contain a coordinate",
            "it contains none: its row of A is zero",
            "Drop the row, or check which entry of q it reads.",
        )
    return rows


_AFFINE = (
    "drop powers and products of velocities, and branches and loops that read {}, even if they "
    "cancel."
)


def check_kinematics(quasi: QuasiVelocities, params: Any, n: int, dtype: Any) -> None:
    """Raise unless U, or the kinematics, are affine and fit the names, for such params."""
    traced, static = _params.split(params)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), traced)
    _checked(quasi, _params.Static(like), _params.Static(static), n, jnp.dtype(dtype))


@lru_cache(maxsize=256)
def _checked(
    quasi: QuasiVelocities, like: _params.Static, static: _params.Static, n: int, dtype: Any
) -> None:
    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    q, u = (jax.ShapeDtypeStruct((k,), dtype) for k in (n, quasi.size))
    function, at, speeds = (quasi.velocities, u, "u") if quasi.U is None else (quasi.of, q, "v")

    def written(t: Array, q: Array, x: Array, traced: Any) -> Array:
        return function(t, q, x, _params.join(traced, static.tree))

    closed = jax.make_jaxpr(written)(t, q, at, like.tree)
    check_indices(closed, _watched(like, speeds), "QuasiVelocities")
    if quasi.U is None:
        rows = examine(quasi.velocities, None, like, static, n, dtype, quasi.size)
        not_affine = [str(i) for i, row in enumerate(rows) if not row.affine]
        if not_affine:
            raise invalid(
                "QuasiVelocities: kinematics",
                "be affine in u",
                f"the derivative of v[{not_affine[0]}] with respect to u contains u in the traced "
                "program",
                f"Write B(t, q) u + c(t, q): {_AFFINE.format('u')}",
            )
        return
    rows = examine(quasi.of, None, like, static, n, dtype)
    not_affine = [name for name, row in zip(quasi.names, rows, strict=True) if not row.affine]
    if not_affine:
        raise invalid(
            f"quasi-velocity {_listed(not_affine)}: U",
            "be affine in v",
            "its derivative with respect to v contains v in the traced program",
            f"Write Theta^T v + theta_0: {_AFFINE.format('v')}",
        )
    empty = [name for name, row in zip(quasi.names, rows, strict=True) if row.empty]
    if empty:
        raise invalid(f"quasi-velocity {_listed(empty)}: U", "contain a velocity", "it has none")


def _listed(labels: list[str]) -> str:
    return ", ".join(map(repr, labels))


def examine(
    rows: Callable,
    positions: Callable | None,
    like: _params.Static,
    static: _params.Static,
    n: int,
    dtype: Any,
    speeds: int | None = None,
) -> list[Contents]:
    """Contents of every row, separately if the rows have a scalar form.

    Args:
        rows: function (t, q, v, params) -> A v + b.
        positions: function (t, q, params) -> phi, the integral of the rows, if there is one.
        like: shapes and dtypes of the traced params.
        static: values of the other params.
        n: number of coordinates.
        dtype: of the coordinates.
        speeds: number of velocities; n if left out.
    """

    def velocity(t: Any, q: Any, v: Any, traced: Any) -> Any:
        return rows(t, q, v, _params.join(traced, static.tree))

    def along(t: Any, q: Any, v: Any, w: Any, traced: Any) -> Any:
        return jax.jvp(lambda v: velocity(t, q, v, traced), (v,), (w,))[1]

    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    q = jax.ShapeDtypeStruct((n,), dtype)
    v = jax.ShapeDtypeStruct((n if speeds is None else speeds,), dtype)

    def phi(t: Any, q: Any, v: Any, traced: Any) -> Any:
        assert positions is not None
        return positions(t, q, _params.join(traced, static.tree))

    closed = jax.make_jaxpr(velocity)(t, q, v, like.tree)
    try:
        found = _as_scalars(closed)
        if positions is not None and any(row.zero for row in found):
            graph, residuals, given = _scalars(jax.make_jaxpr(phi)(t, q, v, like.tree))
            somewhere = dict.fromkeys((*given[0].flat, *given[1]), graph.zero)
            residuals = substitute(graph, residuals, somewhere)
            pairs = zip(found, residuals, strict=True)
            found = [row._replace(zero=row.zero and x is graph.zero) for row, x in pairs]
        return found
    except Unsupported:
        slope = _reached(jax.make_jaxpr(along)(t, q, v, v, like.tree), "tqvw")
        driven = True
        if positions is not None:
            driven = "t" in _reached(jax.make_jaxpr(phi)(t, q, v, like.tree), "tqv")
        # As one array all rows have the dependences of any of them.
        shared = Contents("v" not in slope, "w" not in slope, driven)
        return [shared] * closed.out_avals[0].shape[0]


def _reached(closed: ClosedJaxpr, names: str) -> frozenset[str]:
    """Arguments on which the result depends; their names are one letter each, params last."""
    rest = len(closed.jaxpr.invars) - len(names)
    given = [frozenset({name}) for name in names] + [frozenset({"params"})] * rest
    return frozenset().union(*outputs_depend_on(closed.jaxpr, given))


def _as_scalars(closed: ClosedJaxpr) -> list[Contents]:
    """The same from the scalars of a program (t, q, v, *params) -> A v + b."""
    graph, rows, given = _scalars(closed)
    v = list(given[2])
    at_rest = substitute(graph, rows, dict.fromkeys(v, graph.zero))
    q = set(given[1])
    return [_contents(graph, row, b, q, set(v)) for row, b in zip(rows, at_rest, strict=True)]


def _scalars(closed: ClosedJaxpr) -> tuple[Graph, list[Node], list[np.ndarray]]:
    """(graph, rows, arguments) of a program of one array.

    Raises:
        Unsupported: it has no scalar form, or a long one.
    """
    if any(jnp.issubdtype(aval.dtype, jnp.integer) for aval in closed.in_avals):
        raise Unsupported("integers among the params, whose division differs from that of floats")
    if sum(map(_effort, closed.jaxpr.eqns)) > LIMIT:
        raise Unsupported(f"more than {LIMIT} scalar operations")
    graph = Graph()
    given = [_inputs(graph, str(i), aval.shape) for i, aval in enumerate(closed.in_avals)]
    return graph, list(nodes(graph, read(graph, closed, *given)[0])), given


def _effort(eqn: Any) -> int:
    """Approximate number of scalar operations of an equation."""
    avals = [x.aval for x in (*eqn.invars, *eqn.outvars)]
    if eqn.primitive.name == "dot_general":
        ((contracted, _), _) = eqn.params["dimension_numbers"]
        return avals[-1].size * prod(avals[0].shape[axis] for axis in contracted)
    return max((getattr(aval, "size", 0) for aval in avals), default=0)


def _inputs(graph: Graph, name: str, shape: tuple[int, ...]) -> np.ndarray:
    array = np.empty(prod(shape), object)
    array[:] = [graph.input(name, i) for i in range(array.size)]
    return array.reshape(shape)


def _contents(graph: Graph, row: Node, at_rest: Node, q: set[Node], v: set[Node]) -> Contents:
    present = order([row])
    slopes = gradient(graph, row, [node for node in present if node in v])
    moving, empty = _moving(slopes, q), all(slope is graph.zero for slope in slopes)
    return Contents(
        affine=v.isdisjoint(order(slopes)) and not _bends(present, v),
        empty=empty,
        driven=at_rest is not graph.zero,
        sure=any(_counts(slope.constant) or moving[slope] for slope in slopes),
        zero=empty and at_rest is graph.zero,
    )


SMALL = 1e-3
"""Smaller numbers may be rounding of larger ones."""


def _moving(slopes: Sequence[Node], q: set[Node]) -> dict[Node, frozenset[Node]]:
    """For every node the coordinates on which it certainly depends, at almost every state.

    If only one term of a sum contains a coordinate and depends on it, then so does the sum: terms
    without common coordinates do not cancel. The same holds for one factor of a product whose
    other factors are not 0.
    """
    none: frozenset[Node] = frozenset()
    held: dict[Node, frozenset[Node]] = {}
    moving: dict[Node, frozenset[Node]] = {}
    for node in order(slopes):
        held[node] = none.union(*(held[arg] for arg in node.args), {node} & q)
        moving[node] = frozenset({node} & q)
        once = [x for x in held[node] if sum(x in held[arg] for arg in node.args) == 1]
        telling = list(node.args)
        if node.op == "sum":
            telling = [arg for arg, factor in node.data[1] if _counts(factor)]
        whole = all(_counts(arg.constant) or moving[arg] for arg in node.args)
        analytic = node.op == "call" and node.data.name in ANALYTIC
        if node.op in ("sum", "let") or (node.op == "product" and whole) or analytic:
            moving[node] = frozenset(x for x in once if any(x in moving[arg] for arg in telling))
    return moving


def _counts(number: float | None) -> bool:
    return number is not None and abs(number) >= SMALL


def _bends(present: Sequence[Node], v: set[Node]) -> bool:
    """Whether anything but sums, products and functions with custom rules reads v.

    A jump, as in floor(v) or a choice by v, does not appear in the slope.
    """
    reading = set(v)
    for node in present:
        if any(arg in reading for arg in node.args):
            reading.add(node)
            if node.op in ("call", "stop") or (node.op == "select" and node.args[0] in reading):
                return True
    return False
