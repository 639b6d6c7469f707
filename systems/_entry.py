"""One system of the book: its declaration and what is known about it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from jax.typing import ArrayLike

import jaxlag as jl

StateFunction = Callable[..., ArrayLike]
"""A quantity at one state: `f(t, q, v, a, params)`, a scalar or a vector."""


@dataclass(frozen=True, kw_only=True)
class Example:
    """A start and parameters worth looking at.

    Attributes:
        params: parameter name -> value, in the units of `Entry.parameter_units`.
        q0: coordinates at t = 0, in the order of the system's coordinates.
        v0: generalized velocities at t = 0.
        duration: length of the run [s].
    """

    params: Mapping[str, float]
    q0: Sequence[float]
    v0: Sequence[float]
    duration: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
    """A system of the book, compared and hashed by identity.

    Attributes:
        name: the name of its module.
        book: its place in the book.
        system: the declaration.
        coordinate_units: one unit per coordinate.
        parameter_units: parameter name -> unit; names every parameter.
        example: a start and parameters to run.
        extras: name -> function of the state, beyond the H, p and dp/dt of every system.
        invariants: name -> function of the state that the motion keeps constant.
    """

    name: str
    book: str
    system: jl.System
    coordinate_units: tuple[str, ...]
    parameter_units: Mapping[str, str]
    example: Example
    extras: Mapping[str, StateFunction] = field(default_factory=dict)
    invariants: Mapping[str, StateFunction] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the entry speaks of one system throughout."""
        count = len(self.coordinates)
        lengths: dict[str, Any] = {
            "coordinate_units": self.coordinate_units,
            "example.q0": self.example.q0,
            "example.v0": self.example.v0,
        }
        for argument, values in lengths.items():
            if len(values) != count:
                raise ValueError(
                    f"{self.name}: {argument} must have one value for each of "
                    f"{', '.join(self.coordinates)}, but it was {values!r}."
                )
        if set(self.example.params) != set(self.parameter_units):
            raise ValueError(
                f"{self.name}: example.params must name the parameters "
                f"{', '.join(self.parameter_units)}, but it named {', '.join(self.example.params)}."
            )

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates, in order."""
        return self.system.coordinates.labels
