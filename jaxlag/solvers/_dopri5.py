"""Dormand and Prince's method of order 5."""

from collections.abc import Callable
from typing import ClassVar

import diffrax

from jaxlag.solvers._explicit import AbstractRungeKutta


class Dopri5(AbstractRungeKutta):
    """Order 5 with an embedded method of order 4, 7 stages of which two steps share one.

    Source: Dormand, Prince, A family of embedded Runge-Kutta formulae, J. Comp. Appl. Math. 6
    (1980), with the coefficients of `diffrax.Dopri5`.
    """

    interpolation_cls: ClassVar[Callable] = diffrax.Dopri5.interpolation_cls

    @property
    def stock(self) -> diffrax.Dopri5:
        """`diffrax.Dopri5`."""
        return diffrax.Dopri5()
