"""Linear maps y = A(r) x with separate programs for A(r) x and A(r)^T y.

JAX transposes a program operation by operation. It cannot transpose a loop with a termination
condition. For a loop of fixed length it stores all intermediate values. If both A(r) x and
A(r)^T y are given as programs, neither problem occurs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from jaxlag._core._batching import LANES, at_most, in_batches

Leaves = Sequence[Any]
COLUMNS = 4  # smallest number of lanes of x for which `of_columns` is used

_TWICE = (
    "Reverse derivatives of reverse derivatives must use an explicit method or a method of "
    "jaxlag.solvers: JAX cannot transpose the loops in which other methods solve their equations. "
    "Take second derivatives forward over reverse, by jax.hessian(f) or jax.jacfwd(jax.grad(f)): "
    "all methods support these."
)


@dataclass(frozen=True, eq=False)
class LinearMap:
    """x -> A(r) x as four programs of (r, x) or (r, y), without traced values in closures.

    Attributes:
        forward: A(r) x. May contain loops of any kind.
        backward: A(r)^T y. The same.
        plain: A(r) x by a program that JAX differentiates in any mode and to any order.
        plain_backward: A(r)^T y in the same way; None for the transpose of `plain`.
        in_lanes: the same map in the form to be vmapped over r; None for this one.
        of_columns: the same map in the form to be vmapped over several x alone; None for this one.
        many: the same map in the form to be vmapped over many r; None for `in_lanes`. It is not
            used if x has been vmapped before.
        differentiated: the same map for derivatives of A(r); None for this one. It and `shapes`
            are found, not given.
        at_once: lanes of a vmap in one batch; None for all.
        shapes: of the leaves of A(r) x; None if they are found by tracing `forward`.
    """

    forward: Callable[[PyTree, PyTree], PyTree]
    backward: Callable[[PyTree, PyTree], PyTree]
    plain: Callable[[PyTree, PyTree], PyTree]
    plain_backward: Callable[[PyTree, PyTree], PyTree] | None = None
    in_lanes: "LinearMap | None" = None
    of_columns: "LinearMap | None" = None
    many: "Many | None" = None
    differentiated: "LinearMap | None" = None
    at_once: int | None = LANES
    shapes: "list[ShapedArray] | None" = None


class Many(NamedTuple):
    """A linear map in the form to be vmapped over many r.

    Attributes:
        form: the map. Nobody takes derivatives of A(r) in this form.
        suits: number of lanes -> whether they are so many.
        work: r -> time that it takes. Lanes of similar times run together.
    """

    form: LinearMap
    suits: Callable[[Any], bool]
    work: Callable[[PyTree], Any]


def linear(form: LinearMap, r: PyTree, x: PyTree) -> PyTree:
    """A(r) x, differentiable in both to any order.

    Forward derivatives in r use `forward` and `backward`, reverse ones use `plain`.
    """
    r_leaves, r_tree = jax.tree.flatten(r)
    x_leaves, x_tree = jax.tree.flatten(x)
    y_tree = jax.tree.structure(jax.eval_shape(form.forward, r, x))
    flat = _flat(form, r_tree, x_tree, y_tree)
    return jax.tree.unflatten(y_tree, _bind(flat, r_leaves, x_leaves))


def _flat(form: LinearMap, r_tree: Any, x_tree: Any, y_tree: Any) -> LinearMap:
    """The map between lists of leaves."""

    def between(function: Callable | None, tree: Any) -> Any:
        if function is None:
            return None

        def of(r: Leaves, x: Leaves) -> list:
            results = function(jax.tree.unflatten(r_tree, r), jax.tree.unflatten(tree, x))
            return jax.tree.leaves(results)

        return of

    return LinearMap(
        between(form.forward, x_tree),
        between(form.backward, y_tree),
        between(form.plain, x_tree),
        between(form.plain_backward, y_tree),
        None if form.in_lanes is None else _flat(form.in_lanes, r_tree, x_tree, y_tree),
        None if form.of_columns is None else _flat(form.of_columns, r_tree, x_tree, y_tree),
        None if form.many is None else _flat_many(form.many, r_tree, x_tree, y_tree),
        at_once=form.at_once,
    )


def _flat_many(many: Many, r_tree: Any, *trees: Any) -> Many:
    def work(r: Leaves) -> Any:
        return many.work(jax.tree.unflatten(r_tree, r))

    return many._replace(form=_flat(many.form, r_tree, *trees), work=work)


def _transposed(form: LinearMap, like: Leaves) -> LinearMap:
    """The transposed map; `like` are the shapes of x."""

    def plain(r: Leaves, y: Leaves) -> list:
        zeros = [jnp.zeros(x.shape, x.dtype) for x in like]
        return list(jax.vjp(lambda *x: form.plain(r, x), *zeros)[1](y))

    return LinearMap(
        form.backward,
        form.forward,
        form.plain_backward or plain,
        form.plain,
        None if form.in_lanes is None else _transposed(form.in_lanes, like),
        None if form.of_columns is None else _transposed(form.of_columns, like),
        None if (many := form.many) is None else many._replace(form=_transposed(many.form, like)),
        None if form.differentiated is None else _transposed(form.differentiated, like),
        form.at_once,
        [ShapedArray(x.shape, x.dtype) for x in like],
    )


def _derived(form: LinearMap, count: int, moving: tuple[int, ...], both: bool) -> LinearMap:
    """The derivative of A(r) x as a linear map with (r, x) in place of r.

    It maps the tangents of the leaves `moving` of r, and with `both` those of x.
    """

    def at(function: Callable, residual: Leaves) -> tuple[Callable, list]:
        r, x = list(residual[:count]), list(residual[count:])

        def of(*moved: Any) -> list:
            for i, leaf in zip(moving, moved, strict=False):
                r[i] = leaf
            return list(function(r, list(moved[len(moving) :]) if both else x))

        return of, [r[i] for i in moving] + (x if both else [])

    def forward(function: Callable, residual: Leaves, dots: Leaves) -> list:
        of, start = at(function, residual)
        return jax.jvp(of, start, list(dots))[1]

    def plain_backward(residual: Leaves, y: Leaves) -> list:
        of, start = at(form.plain, residual)
        return list(jax.vjp(of, *start)[1](list(y)))

    def backward(residual: Leaves, y: Leaves) -> list:
        of, start = at(form.plain, residual)
        moved, x = start[: len(moving)], start[len(moving) :]
        try:
            bars = list(jax.vjp(lambda *moved: of(*moved, *x), *moved)[1](list(y)))
        except ValueError as error:
            if "Reverse-mode differentiation does not work" in str(error):
                raise ValueError(_TWICE) from error
            raise
        return bars + (list(form.backward(list(residual[:count]), y)) if both else [])

    return LinearMap(
        partial(forward, form.forward),
        backward,
        partial(forward, form.plain),
        plain_backward,
        None if form.in_lanes is None else _derived(form.in_lanes, count, moving, both),
        at_once=form.at_once,
    )


def _batched(
    form: LinearMap, size: Any, mapped: tuple[bool, ...], work: Callable | None = None
) -> LinearMap:
    """The map for `size` lanes of x, y and the mapped leaves of r."""
    if any(mapped) and form.many is not None and form.many.suits(size):
        other = _batched(replace(form, many=None), size, mapped)
        many = _batched(form.many.form, size, mapped, form.many.work)
        return replace(many, differentiated=other)
    in_lanes = form.in_lanes
    if any(mapped) and in_lanes is not None:
        form, in_lanes = in_lanes, None
    if not any(mapped) and form.of_columns is not None and not at_most(size, COLUMNS - 1):
        form, in_lanes = form.of_columns, None

    def lanes(function: Callable | None, at_once: Any) -> Any:
        if function is None:
            return None

        def of(r: Leaves, x: Leaves) -> list:
            own = [leaf for leaf, is_mapped in zip(r, mapped, strict=True) if is_mapped]

            def merged(own: Leaves) -> list:
                mine, pairs = iter(own), zip(r, mapped, strict=True)
                return [next(mine) if is_mapped else leaf for leaf, is_mapped in pairs]

            def one(lane: tuple) -> list:
                return list(function(merged(lane[0]), lane[1]))

            def order_by(work: Callable) -> Any:
                return jnp.argsort(jax.vmap(lambda own: work(merged(own)))(own))

            order = None if work is None else order_by(work)
            even = not any(mapped)
            return in_batches(one, (own, list(x)), size, at_once, even, order)

        return of

    at_once, other, shapes = form.at_once or size, form.differentiated, form.shapes
    return LinearMap(
        lanes(form.forward, at_once),
        lanes(form.backward, at_once),
        lanes(form.plain, size),
        lanes(form.plain_backward, size),
        None if in_lanes is None else _batched(in_lanes, size, mapped),
        differentiated=None if other is None else _batched(other, size, mapped),
        at_once=form.at_once,
        shapes=None if shapes is None else [ShapedArray((size, *x.shape), x.dtype) for x in shapes],
    )


_linear_map = Primitive("linear_map")
_linear_map.multiple_results = True


def _bind(form: LinearMap, r: Leaves, x: Leaves) -> list:
    return _linear_map.bind(*r, *x, form=form, count=len(r))


@_linear_map.def_impl
def _evaluate(*args: Any, form: LinearMap, count: int) -> list:
    return jax.jit(form.forward)(args[:count], args[count:])


@_linear_map.def_abstract_eval
def _shapes(*args: Any, form: LinearMap, count: int) -> list:
    if form.shapes is not None:
        return form.shapes
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args]
    results = jax.eval_shape(form.forward, like[:count], like[count:])
    return [ShapedArray(x.shape, x.dtype) for x in results]


def program_of(eqn: Any) -> ClosedJaxpr | None:
    """The program A(r) x of an equation; None if it is no application of a linear map."""
    if eqn.primitive is not _linear_map:
        return None
    kinds = (x.aval for x in eqn.invars)
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type) for x in kinds]
    return jax.make_jaxpr(partial(_lowered, **eqn.params))(*like)


def _lowered(*args: Any, form: LinearMap, count: int) -> list:
    return form.forward(args[:count], args[count:])


mlir.register_lowering(_linear_map, mlir.lower_fun(_lowered, multiple_results=True))


def _jvp(primals: Leaves, tangents: Leaves, *, form: LinearMap, count: int) -> tuple:
    r, x = list(primals[:count]), list(primals[count:])
    results = _bind(form, r, x)
    moving = tuple(i for i in range(count) if type(tangents[i]) is not ad.Zero)
    both = any(type(dot) is not ad.Zero for dot in tangents[count:])
    dots = [ad.instantiate_zeros(dot) for dot in tangents[count:]] if both else []
    if not moving:
        return results, _bind(form, r, dots)
    derived = _derived(form.differentiated or form, count, moving, both)
    return results, _bind(derived, [*r, *x], [*(tangents[i] for i in moving), *dots])


ad.primitive_jvps[_linear_map] = _jvp


def _transpose(cotangents: Leaves, *args: Any, form: LinearMap, count: int) -> list:
    r, x = args[:count], args[count:]
    like = [leaf.aval for leaf in x]
    y = [ad.instantiate_zeros(ct) for ct in cotangents]
    return [None] * count + _bind(_transposed(form, like), r, y)


ad.primitive_transposes[_linear_map] = _transpose


def _repeated(x: Any, count: Any) -> Any:
    """x for every lane; a number of an interpreted program is no array."""
    x = jnp.asarray(x, getattr(x, "dtype", None))
    return jnp.broadcast_to(x, (count, *x.shape))


def _lanes(args: Leaves, axes: Leaves, *, form: LinearMap, count: int) -> tuple:
    sizes = [x.shape[i] for x, i in zip(args, axes, strict=True) if i is not None]
    pairs = zip(args, axes, strict=True)
    args = [x if i is None else jnp.moveaxis(x, i, 0) for x, i in pairs]
    mapped = [i is not None for i in axes]
    # x gets lanes in all cases: JAX then sums the cotangents of a shared x over them.
    x = [
        leaf if is_mapped else _repeated(leaf, sizes[0])
        for leaf, is_mapped in zip(args[count:], mapped[count:], strict=True)
    ]
    results = _bind(_batched(form, sizes[0], tuple(mapped[:count])), args[:count], x)
    return results, [0] * len(results)


batching.primitive_batchers[_linear_map] = _lanes
