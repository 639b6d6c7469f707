"""One system of the book: its declaration and what is known about it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import jax.numpy as jnp
from jax.typing import ArrayLike

import jaxlag as jl

StateFunction = Callable[..., ArrayLike]
"""A quantity at one state: `f(t, q, v, a, params)`, a scalar or a vector."""


@dataclass(frozen=True, kw_only=True)
class Example:
    """A start and parameters worth looking at.

    Attributes:
        params: parameter name -> value, in the units of `parameter_units`.
        q0: coordinates at t = 0, in the order of the system's coordinates.
        v0: generalized velocities at t = 0.
        duration: length of the run [s].
    """

    params: Mapping[str, float]
    q0: Sequence[float]
    v0: Sequence[float]
    duration: float


@dataclass(frozen=True, kw_only=True)
class StaticExample:
    """Parameters of a state of rest: parameter name -> value."""

    params: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class PrescribedExample:
    """Parameters of a prescribed motion, and for how long to follow it [s]."""

    params: Mapping[str, float]
    duration: float


@dataclass(frozen=True, kw_only=True, eq=False)
class AbstractEntry:
    """What every system of the book has; compared and hashed by identity.

    Attributes:
        name: the name of its module.
        book: its place in the book.
        system: the declaration.
        coordinate_units: one unit per coordinate.
        parameter_units: parameter name -> unit; names every parameter.
        example: parameters, and a start where there is one, to run.
        kind: what is asked of it: "trajectory", "static" or "prescribed".
    """

    kind: ClassVar[str]

    name: str
    book: str
    system: jl.System
    coordinate_units: tuple[str, ...]
    parameter_units: Mapping[str, str]
    example: Example | StaticExample | PrescribedExample

    def __post_init__(self) -> None:
        """Check that the entry speaks of one system throughout."""
        self._check_length("coordinate_units", self.coordinate_units)
        if set(self.example.params) != set(self.parameter_units):
            raise ValueError(
                f"{self.name}: example.params must name the parameters "
                f"{', '.join(self.parameter_units)}, but it named {', '.join(self.example.params)}."
            )

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates, in order."""
        return self.system.coordinates.labels

    def _check_length(self, argument: str, values: Sequence) -> None:
        if len(values) != len(self.coordinates):
            raise ValueError(
                f"{self.name}: {argument} must have one value for each of "
                f"{', '.join(self.coordinates)}, but it was {values!r}."
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry(AbstractEntry):
    """A system that moves from a start.

    Attributes:
        extras: name -> function of the state, beyond the H, p and dp/dt of every system.
        invariants: name -> function of the state that the motion keeps constant.
    """

    kind: ClassVar[str] = "trajectory"

    example: Example
    extras: Mapping[str, StateFunction] = field(default_factory=dict)
    invariants: Mapping[str, StateFunction] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the start, too."""
        super().__post_init__()
        self._check_length("example.q0", self.example.q0)
        self._check_length("example.v0", self.example.v0)


@dataclass(frozen=True, kw_only=True, eq=False)
class StaticEntry(AbstractEntry):
    """A system whose state of rest is asked.

    Attributes:
        guess: `guess(params)`, coordinates from which the search for the state of rest starts.
        values: name -> function `f(q, params)` of the state of rest.
    """

    kind: ClassVar[str] = "static"

    example: StaticExample
    guess: Callable[[Mapping[str, ArrayLike]], Sequence[ArrayLike]]
    values: Mapping[str, Callable[..., ArrayLike]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the guess, too."""
        super().__post_init__()
        self._check_length("guess", self.guess(self.example.params))

    def rest(self, params: Mapping[str, ArrayLike]) -> jl.Equilibrium:
        """The state of rest, with its status."""
        guess = jnp.stack([jnp.asarray(x, float) for x in self.guess(params)])
        return jl.equilibrium(self.system, guess, params, throw=False)


@dataclass(frozen=True, kw_only=True, eq=False)
class PrescribedEntry(AbstractEntry):
    """A system led along a given motion, whose forces are asked.

    Attributes:
        motion: `motion(t, params)`, the coordinates, shape (n,), at a time t [s].
        extras: name -> function of the state.
    """

    kind: ClassVar[str] = "prescribed"

    example: PrescribedExample
    motion: Callable[..., ArrayLike]
    extras: Mapping[str, StateFunction] = field(default_factory=dict)
