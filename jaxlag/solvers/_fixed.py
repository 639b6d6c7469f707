"""Structure-preserving methods with steps of fixed length."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax


class AbstractFixedStep(diffrax.AbstractSolver):
    """A one-step method that keeps a structure of the equations as long as the step is constant.

    A step chosen by an error estimate depends on the state, and the map from state to state is
    then no longer symplectic. These methods have no estimate and take no step-size controller.

    The terms must contain the mechanical system, as those of `simulate` do. Each solver documents
    the methods of the terms that it needs.

    Source: Hairer, Lubich, Wanner, Geometric Numerical Integration, sec. VIII.1.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = diffrax.LocalLinearInterpolation

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        """Nothing is passed from step to step."""
        return

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """dy/dt."""
        return terms.vf(t0, y0, args)
