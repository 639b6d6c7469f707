"""Names and shapes of the coordinates, and the flat vector that stores them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag._core._arrays import array_of, common, of_state
from jaxlag._core._errors import invalid

ORDER = "The order of the arguments is (q, v, params)."
"""Error text if another value is passed for q or v."""


class Coordinates:
    """Immutable, hashable table of coordinate names and shapes, in the order of flat q.

    Args:
        declared: names, or a mapping from name to shape, e.g. `{"x": (8, 3), "theta": ()}`; a
            number n of entries stands for (n,).
        argument: name of this argument in errors.

    Raises:
        ValueError: no names, duplicate or empty names, shapes that are not tuples of sizes.
    """

    def __init__(
        self,
        declared: Sequence[str] | Mapping[str, tuple[int, ...] | int],
        argument: str = "coordinates",
    ) -> None:
        fix = 'Write ("x", "theta") or {"x": (8, 3), "theta": ()}.'
        if isinstance(declared, str) or not isinstance(declared, Sequence | Mapping):
            raise invalid(argument, "be names, or names with shapes", f"it was {declared!r}", fix)
        items = (
            list(declared.items())
            if isinstance(declared, Mapping)
            else [(name, ()) for name in declared]
        )
        if not items:
            raise invalid(argument, "have at least one name", "it was empty", fix)
        items = [(name, (s,) if _is_count(s) else s) for name, s in items]
        for name, shape in items:
            if not isinstance(name, str) or not name:
                raise invalid(argument, "be non-empty strings", f"one was {name!r}", fix)
            if not isinstance(shape, tuple) or not all(map(_is_count, shape)):
                raise invalid(
                    f"{argument}[{name!r}]", "be a tuple of sizes", f"it was {shape!r}", fix
                )
        names = [name for name, _ in items]
        for name in names:
            if names.count(name) > 1:
                was = f"{name!r} occurs {names.count(name)} times"
                raise invalid(argument, "be distinct", was)
        shapes: dict[str, Any] = dict(items)
        self.shapes: dict[str, tuple[int, ...]] = shapes
        self.size = sum(math.prod(shape) for shape in self.shapes.values())

    @property
    def names(self) -> tuple[str, ...]:
        """Declared names, in order."""
        return tuple(self.shapes)

    @property
    def labels(self) -> tuple[str, ...]:
        """One label for every entry of flat q: `theta`, or `x[2,0]` for an array coordinate."""
        labels = []
        for name, shape in self.shapes.items():
            for index in np.ndindex(shape):
                labels.append(f"{name}[{','.join(map(str, index))}]" if shape else name)
        return tuple(labels)

    @property
    def places(self) -> dict[str, list[int]]:
        """The indices of every name in flat q."""
        indices = self.unflatten(np.arange(self.size))
        return {name: part.reshape(-1).tolist() for name, part in indices.items()}

    def unflatten(self, q: Any) -> dict[str, Any]:
        """Split the last axis of q, shape (..., n), into a dict of named arrays."""
        parts, start = {}, 0
        for name, shape in self.shapes.items():
            stop = start + math.prod(shape)
            parts[name] = q[..., start:stop].reshape(q.shape[:-1] + shape)
            start = stop
        return parts

    def part(self, x: Array, name: str) -> Array:
        """The part of x, shape (..., n), that belongs to one coordinate."""
        if name not in self.shapes:
            raise invalid("name", f"be one of {list(self.names)}", f"it was {name!r}")
        return self.unflatten(x)[name]

    def flatten(self, parts: Mapping[str, Any], argument: str = "q") -> Array:
        """Inverse of `unflatten` for a single state: dict of named values to shape (n,)."""
        if set(parts) != set(self.shapes):
            must, was = f"name exactly {list(self.shapes)}", f"it named {list(parts)}"
            fix = ORDER if set(parts).isdisjoint(self.shapes) else ""
            raise invalid(argument, must, was, fix)
        rows = []
        for name, shape in self.shapes.items():
            try:
                part = jnp.asarray(parts[name])
            except (TypeError, ValueError) as error:
                was = f"it was {parts[name]!r}"
                raise invalid(f"{argument}[{name!r}]", "be numeric", was) from error
            if part.shape != shape:
                raise invalid(
                    f"{argument}[{name!r}]", f"have shape {shape}", f"it was {part.shape}"
                )
            rows.append(part.reshape(-1))
        return jnp.concatenate(common(*rows))

    def label(self, index: int) -> str:
        """Label of entry `index` of flat q."""
        return self.labels[index]

    def _key(self) -> tuple:
        return tuple(self.shapes.items())

    def __hash__(self) -> int:
        return hash(self._key())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Coordinates) and self._key() == other._key()

    def __repr__(self) -> str:
        return f"Coordinates({self.shapes})"


def _is_count(x: Any) -> bool:
    return isinstance(x, int) and not isinstance(x, bool) and x > 0


def vector(coordinates: Coordinates, argument: str, x: Any) -> Array:
    """`x` as an inexact array of shape (n,); raises naming `argument` if it cannot be one.

    A scalar is accepted for a single coordinate.
    """
    return jnp.asarray(vector_argument(coordinates, argument, x))


def vector_argument(coordinates: Coordinates, argument: str, x: Any) -> Any:
    """The same for a compiled program: of a list a numpy array, which costs no dispatch."""
    n = coordinates.size
    if isinstance(x, Mapping):
        x = coordinates.flatten(x, argument)
    try:
        x = array_of(x)
    except (TypeError, ValueError, OverflowError) as error:
        fix = _in_order(coordinates) if isinstance(x, str | Sequence) else ORDER
        raise invalid(argument, f"be {n} numbers", f"it was {x!r}", fix) from error
    if n == 1 and x.shape == ():
        x = x[None]
    if x.shape != (n,):
        fix = _in_order(coordinates)
        raise invalid(argument, f"have shape ({n},)", f"its shape was {x.shape}", fix)
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise invalid(argument, "be real", f"its dtype was {x.dtype}")
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def _in_order(coordinates: Coordinates) -> str:
    return f"Give one entry for each, in the order {list(coordinates.labels)}."


def state_vectors(coordinates: Coordinates, q: Any, v: Any) -> tuple[Array, Any]:
    """(q, v) as flat vectors of one dtype, the result type of both; v may be None."""
    q = vector(coordinates, "q", q)
    if v is None:
        return of_state("q", q)[0], None
    q, v = of_state("q and v", q, vector(coordinates, "v", v))
    return q, v
