"""AbstractSolution: the attributes of a `Solution` that views, advice and further solves use."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
from jaxtyping import Array

from jaxlag._core._result import AbstractResult
from jaxlag._simulation._failure import MotionKey
from jaxlag._system._system import System


class AbstractSolution(AbstractResult):
    """The attributes of a `Solution` that do not depend on how it was computed; see there."""

    system: eqx.AbstractVar[System]
    ts: eqx.AbstractVar[Array]
    q: eqx.AbstractVar[Array]
    v: eqx.AbstractVar[Array]
    x: eqx.AbstractVar[Array | None]
    last_time: eqx.AbstractVar[Array]
    last_state: eqx.AbstractVar[tuple[Array, Array]]
    last_x: eqx.AbstractVar[Array | None]
    stats: eqx.AbstractVar[dict[str, Any]]
    saved: eqx.AbstractVar[dict[str, Any]]
    formulation: eqx.AbstractVar[str]
    stabilization: eqx.AbstractVar[Any]
    tolerances: eqx.AbstractVar[tuple[Array, Array] | None]
    dt_max: eqx.AbstractVar[Array | None]
    change_points: eqx.AbstractVar[str]
    _solver: eqx.AbstractVar[str]
    _params_traced: eqx.AbstractVar[Any]
    _inputs_traced: eqx.AbstractVar[Any]

    @property
    @abstractmethod
    def status(self) -> Array:
        """How the motion ended."""

    @property
    @abstractmethod
    def raw_status(self) -> Array:
        """The same, before the states around its end are examined."""

    @property
    @abstractmethod
    def where(self) -> Array:
        """The index that a failure concerns."""

    @property
    @abstractmethod
    def scene(self) -> MotionKey:
        """The key of the compiled program."""

    @property
    @abstractmethod
    def method(self) -> str:
        """The name of the method."""

    @property
    @abstractmethod
    def params(self) -> Any:
        """Params as the user gave them."""

    @property
    @abstractmethod
    def inputs(self) -> dict[str, Any]:
        """Inputs by name."""

    @property
    @abstractmethod
    def _given(self) -> Any:
        """Params, and the values in closures of declared functions."""

    @property
    @abstractmethod
    def fallback(self) -> str:
        """Why the solve changed from quasi-velocities to multipliers."""

    @property
    @abstractmethod
    def energy(self) -> Array:
        """H at the save times."""

    @abstractmethod
    def __getitem__(self, name: Any) -> Any:
        """A coordinate, or some motions of a batch."""

    @abstractmethod
    def rate(self, name: str) -> Array:
        """The velocity of a coordinate."""

    @abstractmethod
    def message(self) -> str:
        """How it ended, in words."""

    @abstractmethod
    def _at_saves(self, indices: list[int]) -> "AbstractSolution":
        """The same, at these save times only."""
