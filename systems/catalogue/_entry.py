"""One system of the book: its declaration and known results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

import jaxlag as jl

StateFunction = Callable[..., ArrayLike]
"""A quantity at one state: `f(t, q, v, a, params)`, a scalar or a vector."""


@dataclass(frozen=True, kw_only=True)
class Example:
    """Parameters and a start for an example run.

    Attributes:
        params: parameter name -> value, a number or an array, in the units of `parameter_units`.
        q0: coordinates at t = 0, in the order of the system's coordinates.
        v0: generalized velocities at t = 0.
        duration: length of the run [s].
        hold: given if q0 and v0 are a guess that must be assembled with the constraints: names of
            the coordinates and, with a prime, of the velocities to be held. None if q0 and v0
            satisfy the constraints.
    """

    params: Mapping[str, Any]
    q0: Sequence[float]
    v0: Sequence[float]
    duration: float
    hold: tuple[str, ...] | None = None


@dataclass(frozen=True, kw_only=True)
class StaticExample:
    """Parameters of a state of rest: parameter name -> value."""

    params: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class PrescribedExample:
    """Parameters of a prescribed motion, and its duration [s]."""

    params: Mapping[str, float]
    duration: float


@dataclass(frozen=True, kw_only=True)
class Chart:
    """Independent coordinates that determine all coordinates of a constrained system.

    Attributes:
        coordinates: their names, among those of the system and in its order.
        configuration: `configuration(t, q, params)`, all coordinates of the system, shape (n,),
            from q, the values of these.
    """

    coordinates: tuple[str, ...]
    configuration: Callable[..., Array]

    def state(self, t: ArrayLike, q: ArrayLike, v: ArrayLike, params: Mapping) -> tuple:
        """(q, v) of the system, each (n,), from the values and the rates of these coordinates."""
        t, q, v = (jnp.asarray(x, float) for x in (t, q, v))

        def along(t: Array, q: Array) -> Array:
            return self.configuration(t, q, params)

        return jax.jvp(along, (t, q), (jnp.ones_like(t), v))


@dataclass(frozen=True, kw_only=True, eq=False)
class AbstractEntry:
    """Data of every system of the book; entries are compared and hashed by identity.

    Attributes:
        name: the name of its module.
        book: its place in the book.
        system: the declaration.
        coordinate_units: one unit per coordinate.
        quasi_units: one unit per quasi-velocity.
        multiplier_units: name of a constraint -> unit of its multiplier, in the order of the
            constraints; every row has its own name.
        parameter_units: parameter name -> unit; names every parameter.
        example: parameters and, if there is one, a start.
        chart: the independent coordinates of reference files, which then do not contain
            constraints; None if reference files have all coordinates.
        kind: the kind of problem: "trajectory", "static" or "prescribed".
    """

    kind: ClassVar[str]

    name: str
    book: str
    system: jl.System
    coordinate_units: tuple[str, ...]
    parameter_units: Mapping[str, str]
    quasi_units: tuple[str, ...] = ()
    multiplier_units: Mapping[str, str] = field(default_factory=dict)
    example: Example | StaticExample | PrescribedExample
    chart: Chart | None = None

    def __post_init__(self) -> None:
        """Check that all data of the entry belong to its system."""
        self._check_length("coordinate_units", self.coordinate_units)
        if len(self.quasi_units) != len(self.quasi_velocities):
            names = ", ".join(self.quasi_velocities) or "no quasi-velocities"
            raise ValueError(
                f"{self.name}: quasi_units must have one value for each of {names}, but it was "
                f"{self.quasi_units!r}."
            )
        if set(self.example.params) != set(self.parameter_units):
            raise ValueError(
                f"{self.name}: example.params must name the parameters "
                f"{', '.join(self.parameter_units)}, but it named {', '.join(self.example.params)}."
            )
        declared = tuple(name for c in self.system.constraints for name in c.all_names)
        if self.constraints != declared:
            raise ValueError(
                f"{self.name}: multiplier_units must name the constraints {declared}, in this "
                f"order, but it named {self.constraints}."
            )
        ordered = tuple(name for name in self.coordinates if name in self.file_coordinates)
        if self.file_coordinates != ordered:
            raise ValueError(
                f"{self.name}: chart.coordinates must be among {', '.join(self.coordinates)}, in "
                f"this order, but they were {', '.join(self.file_coordinates)}."
            )

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates, in order."""
        return self.system.coordinates.labels

    @property
    def quasi_velocities(self) -> tuple[str, ...]:
        """Names of the quasi-velocities, in order, those that vanish included."""
        quasi = self.system.quasi
        return () if quasi is None else quasi.names

    @property
    def free_quasi_velocities(self) -> tuple[str, ...]:
        """Names of those that do not vanish."""
        return tuple(name for name in self.quasi_velocities if name not in self.constraints)

    @property
    def constraints(self) -> tuple[str, ...]:
        """Names of the constraint rows, in order."""
        return tuple(self.multiplier_units)

    @property
    def file_coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates in reference files."""
        return self.coordinates if self.chart is None else self.chart.coordinates

    @property
    def file_constraints(self) -> tuple[str, ...]:
        """Names of the constraint rows in reference files."""
        return self.constraints if self.chart is None else ()

    @property
    def file_columns(self) -> np.ndarray:
        """Indices of the coordinates of reference files among all coordinates."""
        return np.array([self.coordinates.index(name) for name in self.file_coordinates])

    def _check_length(self, argument: str, values: Sequence | Array) -> None:
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
        invariants: name -> function of the state that is constant along the motion, as long as no
            force is applied.
        exact: `exact(t, q0, v0, params)`, (q, v) at t of the motion from (q0, v0) at t = 0, each
            (n,), in closed form; None if none is known. Its derivatives by JAX are also exact.
    """

    kind: ClassVar[str] = "trajectory"

    example: Example
    extras: Mapping[str, StateFunction] = field(default_factory=dict)
    invariants: Mapping[str, StateFunction] = field(default_factory=dict)
    exact: Callable[..., tuple[Array, Array]] | None = None

    def __post_init__(self) -> None:
        """Check also the start."""
        super().__post_init__()
        self._check_length("example.q0", self.example.q0)
        self._check_length("example.v0", self.example.v0)

    def start(self) -> tuple[Array, Array]:
        """(q, v) of the example at t = 0, each (n,), assembled if it is a guess."""
        q0, v0 = jnp.asarray(self.example.q0), jnp.asarray(self.example.v0)
        if self.example.hold is None:
            return q0, v0
        state = jl.assemble(self.system, q0, v0, self.example.params, hold=self.example.hold)
        return state.q, state.v


@dataclass(frozen=True, kw_only=True, eq=False)
class StaticEntry(AbstractEntry):
    """A system with a state of rest to be found.

    Attributes:
        guess: `guess(params)`, coordinates from which the search for the state of rest starts.
        values: name -> function `f(rest, params)` of the state of rest, a `jl.Equilibrium`.
    """

    kind: ClassVar[str] = "static"

    example: StaticExample
    guess: Callable[[Mapping[str, ArrayLike]], Sequence[ArrayLike] | Array]
    values: Mapping[str, Callable[..., ArrayLike]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check also the guess."""
        super().__post_init__()
        self._check_length("guess", self.guess(self.example.params))

    def rest(self, params: Mapping[str, ArrayLike]) -> jl.Equilibrium:
        """The state of rest, with its status."""
        guess = jnp.stack([jnp.asarray(x, float) for x in self.guess(params)])
        return jl.equilibrium(self.system, guess, params, throw=False)


@dataclass(frozen=True, kw_only=True, eq=False)
class PrescribedEntry(AbstractEntry):
    """A system with a prescribed motion and forces to be found.

    Attributes:
        motion: `motion(t, params)`, the coordinates, shape (n,), at a time t [s].
        extras: name -> function of the state.
    """

    kind: ClassVar[str] = "prescribed"

    example: PrescribedExample
    motion: Callable[..., ArrayLike]
    extras: Mapping[str, StateFunction] = field(default_factory=dict)
