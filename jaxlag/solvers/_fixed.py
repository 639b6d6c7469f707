"""Methods that keep a structure of the equations, with steps of fixed length."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax


class AbstractFixedStep(diffrax.AbstractSolver):
    """A one-step method that keeps a structure of the equations as long as the step is constant.

    A step chosen by an error estimate depends on the state, and the map from state to state is
    then no longer symplectic: these methods have no estimate and take no step-size controller.

    The terms must know the mechanical system, as those of `simulate` do; the methods that solvers
    ask them for stand with each solver.

    Source: Hairer, Lubich, Wanner, Geometric Numerical Integration, sec. VIII.1.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = diffrax.LocalLinearInterpolation

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        """Nothing is carried from step to step."""
        return

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """dy/dt."""
        return terms.vf(t0, y0, args)
