"""Params: a pytree, split into traced leaves and the static part of the program's key."""

import math
from functools import lru_cache
from numbers import Number
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._tracing._closure_params import plain
from jaxlag._tracing._immutable import check_nodes, is_fixed, refusal
from jaxlag._tracing._strict_equality import types_in, types_of

_TRACED = {float: True, int: False, bool: False, str: False}  # of plain leaves


class _Frozen:
    """A concrete array of truth values, or a numpy scalar, hashable by value."""

    def __init__(self, array: Any) -> None:
        self.array = np.array(array)  # a copy: the caller may change the original
        self.key = (self.array.shape, str(self.array.dtype), self.array.tobytes())

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Frozen) and self.key == other.key

    def __repr__(self) -> str:
        return f"{self.array.dtype}{list(self.array.shape)}"


def is_array(leaf: Any) -> bool:
    """Whether a leaf is a numpy or JAX array, a tracer included."""
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray)


def known(x: Any) -> np.ndarray | None:
    """The value of a number or an array, also of a tracer that has one; else None."""
    look = getattr(x, "to_concrete_value", None) if isinstance(x, Tracer) else None
    x = look() if look is not None else x
    if x is None or isinstance(x, Tracer) or _is_key(x) or not eqx.is_array_like(x):
        return None
    return np.asarray(x)


def not_finite(params: Any) -> list[tuple[str, str, Any]]:
    """(path, path of the number, the number) for every leaf with a nonfinite number."""
    params = plain(params)
    if all(map(_is_finite, jax.tree.leaves(params))):  # the usual case, without paths
        return []
    found = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(params)[0]:
        if _is_finite(leaf):
            continue
        name, value = f"params{jax.tree_util.keystr(path)}", known(leaf)
        assert value is not None
        whole = name
        if value.ndim:
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
            name, value = f"{name}[{', '.join(map(str, index))}]", value[index]
        found.append((whole, name, value))
    return found


def paths(params: Any) -> list[str]:
    """Paths of the traced leaves."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(halves(plain(params))[0])
    return [f"params{jax.tree_util.keystr(path)}" for path, _ in leaves]


def check_keys(params: Any, name: str = "params") -> None:
    """Raise on mutable objects, which would be part of the key of compiled programs.

    Raises:
        ValueError: with the leaf, or the static field, by its path.
    """
    params = plain(params)
    try:
        leaves = jax.tree.leaves(params)
    except ValueError as error:  # JAX sorts the keys of a dict
        must, was = "have keys of one type in each dict", f"it was {params!r}"
        raise invalid(name, must, was, "Use strings.") from error
    check_nodes(params, name)
    if all(map(_is_fine, leaves)):
        return
    for path, leaf in jax.tree_util.tree_flatten_with_path(params)[0]:
        if _is_other_number(leaf):
            where, was = f"{name}{jax.tree_util.keystr(path)}", f"it was {leaf!r}"
            raise invalid(where, "be a float, an int or an array", was, f"Write {float(leaf)}.")
        if not _is_fine(leaf):
            raise refusal(leaf, f"{name}{jax.tree_util.keystr(path)}")


def are_keys(static: Any) -> bool:
    """Whether a static half can be part of a key."""
    return all(map(_is_fine, jax.tree.leaves(static)))


def _is_finite(leaf: Any) -> bool:
    if isinstance(leaf, float):
        return math.isfinite(leaf)
    value = known(leaf)
    if value is None or not np.issubdtype(value.dtype, np.inexact):
        return True
    return bool(np.all(np.isfinite(value)))


def _is_other_number(leaf: Any) -> bool:
    """Whether it is a number of a class that JAX does not know: a Decimal, a Fraction."""
    return isinstance(leaf, Number) and not eqx.is_array_like(leaf)


def _is_fine(leaf: Any) -> bool:
    if _is_other_number(leaf):
        return False
    # Numbers with a fraction are traced, for all classes.
    return is_array(leaf) or isinstance(leaf, float | complex | _Frozen) or is_fixed(leaf)


def _is_key(x: Any) -> bool:
    """Whether it is an array of typed random keys."""
    return eqx.is_array(x) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _is_traced(leaf: Any) -> bool:
    if type(leaf) in _TRACED:
        return _TRACED[type(leaf)]
    if isinstance(leaf, Tracer):
        return True
    if isinstance(leaf, jax.Array | np.ndarray):
        return _of_numbers(leaf.dtype)
    return eqx.is_array_like(leaf) and jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)


@lru_cache(maxsize=64)
def _of_numbers(dtype: Any) -> bool:
    """Whether it is of numbers other than truth values, or of typed random keys."""
    kinds = jnp.integer, jnp.inexact, jax.dtypes.prng_key
    return any(jnp.issubdtype(dtype, kind) for kind in kinds)


def split(params: Any) -> tuple[Any, Any]:
    """(traced, static) halves of params; `join` is the inverse.

    Arrays of numbers, Python floats, random keys and tracers are traced; Python ints, truth values,
    strings and functions are static: part of the key under which the compiled program is cached.

    Raises:
        ValueError: a static part is mutable, with its path.
    """
    check_keys(params)
    return halves(params)


def halves(tree: Any) -> tuple[Any, Any]:
    """The same for any pytree, without checks."""
    leaves, form = jax.tree.flatten(tree)
    are = [_is_traced(x) for x in leaves]
    traced = [_array(x) if is_it else None for x, is_it in zip(leaves, are, strict=True)]
    static = [
        None if is_it else _Frozen(x) if is_array(x) else x
        for x, is_it in zip(leaves, are, strict=True)
    ]
    return jax.tree.unflatten(form, traced), jax.tree.unflatten(form, static)


def _array(x: Any) -> Any:
    """`jnp.asarray`, which takes microseconds for arrays of JAX, too."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x)


def arrays_apart(tree: Any) -> tuple[Any, Any]:
    """(arrays, the rest) of any pytree; one without arrays is not rebuilt, unlike by equinox."""
    leaves, form = jax.tree.flatten(tree)
    if not any(map(is_array, leaves)):
        return jax.tree.unflatten(form, [None] * len(leaves)), tree
    return eqx.partition(tree, is_array)


def join(traced: Any, static: Any) -> Any:
    """Inverse of `split`; frozen arrays come back as numpy arrays."""
    thawed = jax.tree.map(lambda x: x.array if isinstance(x, _Frozen) else x, static)
    return eqx.combine(traced, thawed)


def shapes(traced: Any) -> Any:
    """Traced params without their values: shapes, dtypes and weak types."""
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(
            x.shape, x.dtype, weak_type=bool(getattr(x, "weak_type", False))
        ),
        traced,
    )


class Static:
    """A hashable pytree without traced leaves, for the keys of compiled programs."""

    def __init__(self, tree: Any) -> None:
        leaves, self.treedef = jax.tree.flatten(tree)
        self.leaves = tuple(leaves)
        self._types: Any = None

    @property
    def types(self) -> Any:
        """The types of all contents, where equal values may have different types."""
        if self._types is None:
            self._types = types_in(self.treedef), tuple(map(types_of, self.leaves))
        return self._types

    @property
    def tree(self) -> Any:
        return jax.tree.unflatten(self.treedef, self.leaves)

    def __hash__(self) -> int:
        return hash((self.treedef, self.leaves))

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Static)
            and self.treedef == other.treedef
            and self.leaves == other.leaves
            and self.types == other.types
        )


class Sample:
    """Values for the check of a program, which are not part of its key: all samples are equal.

    Attributes:
        leaves: the traced leaves of the params; None if their values are unknown.
    """

    def __init__(self, leaves: list[Any] | None) -> None:
        self.leaves = leaves

    def __hash__(self) -> int:
        return 0

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sample)


UNKNOWN = Sample(None)


def sample(params: Any, other: Sample = UNKNOWN) -> Sample:
    """The traced half of params as a sample if it has values, else the other sample."""
    leaves = jax.tree.leaves(params)
    return Sample(leaves) if concrete(*leaves) else other
