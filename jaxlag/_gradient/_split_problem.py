"""The problem of a solve, split into differentiated, traced and static parts."""

from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Bool, PyTree

from jaxlag._integration._record import Times
from jaxlag._integration._stepper import Stepper


class Setup(NamedTuple):
    """Inputs of a solve that are not differentiated."""

    first_step: Array | None
    allowed: Bool[Array, ""]
    stepper: Any  # traced half of the Stepper


class Problem(NamedTuple):
    """A start, the vector field's arguments, the times, and how to solve."""

    y0: PyTree
    args: Any
    times: Times
    setup: Setup
    stepper: Any  # static half of the Stepper
    max_steps: int
    capacity: int  # states that reverse derivatives keep; 0 for forward ones


class Static(NamedTuple):
    """The static key of compiled programs.

    Attributes:
        motion: static half of (y0, args, times).
        stepper: static half of the Stepper.
        max_steps: bound on the steps.
        capacity: states that reverse derivatives keep; 0 for forward ones.
    """

    motion: Any
    stepper: Any
    max_steps: int
    capacity: int


class SplitProblem(NamedTuple):
    """A `Problem` in four parts.

    Attributes:
        differentiable: inexact leaves of (y0, args, times).
        arrays: their other arrays.
        setup: arrays that are not differentiated.
        static: the rest.
    """

    differentiable: Any
    arrays: Any
    setup: Setup
    static: Static

    @property
    def motion(self) -> tuple[Array, Any, Times]:
        """(y0, args, times)."""
        return eqx.combine(self.differentiable, self.arrays, self.static.motion)

    @property
    def stepper(self) -> Stepper:
        """The stepper, from its two halves."""
        return eqx.combine(self.setup.stepper, self.static.stepper)

    @property
    def traced(self) -> tuple[Any, Any, Setup]:
        """All but the static part."""
        return self.differentiable, self.arrays, self.setup


def split(problem: Problem) -> SplitProblem:
    """Split a problem into its parts."""
    differentiable, rest = eqx.partition(problem[:3], eqx.is_inexact_array)
    arrays, motion = eqx.partition(rest, eqx.is_array)
    static = Static(motion, problem.stepper, problem.max_steps, problem.capacity)
    return SplitProblem(differentiable, arrays, problem.setup, static)
