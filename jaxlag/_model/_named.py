"""Functions that take coordinates by name instead of one flat vector."""

from collections.abc import Callable, Mapping, Sequence
from functools import update_wrapper
from inspect import signature
from typing import Any

import jax.numpy as jnp

from jaxlag._model._coordinates import Coordinates


def named(
    coordinates: Sequence[str] | Mapping[str, tuple[int, ...] | int],
) -> Callable[[Callable], Callable]:
    """Decorator for functions of (t, q, v, params, ...): they receive q and v as dicts by name.

    It applies to all declared functions of flat q and v: Lagrangians, energies, forces,
    constraints, quasi-velocities. Quasi-velocities, called u, are passed unchanged. A force or
    velocities may also be returned as a dict by name; coordinates not in it are 0.

    Args:
        coordinates: names, or names with shapes, as for the `System`.

    Raises:
        ValueError: invalid names or shapes. While tracing: a dict of other names or shapes.

    Example:
        A bead on a rotating rod, with its coordinates by name:

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> names = {"r": (), "spin": 3}
        >>> @jl.named(names)
        ... def lagrangian(t, q, v, params):
        ...     return 0.5 * (v["r"] ** 2 + q["r"] ** 2 * v["spin"] @ v["spin"]) + v["spin"][0]
        >>> bead = jl.System(lagrangian, names)
        >>> print(bead.mass_matrix([2.0, 0.0, 0.0, 0.0]).diagonal())
        [1. 4. 4. 4.]
    """
    table = Coordinates(coordinates)
    return lambda function: _Named(table, function)


class _Named:
    """A function of dicts as a function of flat vectors; it hashes by both."""

    def __init__(self, coordinates: Coordinates, function: Callable) -> None:
        self.coordinates, self.function = coordinates, function
        update_wrapper(self, function)

    def __hash__(self) -> int:
        return hash((self.coordinates, self.function))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Named):
            return False
        return self.coordinates == other.coordinates and self.function == other.function

    def __call__(self, t: Any, q: Any, *rest: Any) -> Any:
        parts = self.coordinates.unflatten
        if len(rest) > 1 and "u" not in signature(self.function).parameters:
            rest = (parts(rest[0]), *rest[1:])
        value = self.function(t, parts(q), *rest)
        if not isinstance(value, Mapping):
            return value
        zeros = parts(jnp.zeros_like(q))
        whole = {name: value.get(name, zero) for name, zero in zeros.items()}
        unknown = {name: x for name, x in value.items() if name not in zeros}
        return self.coordinates.flatten(whole | unknown, "the returned dict")
