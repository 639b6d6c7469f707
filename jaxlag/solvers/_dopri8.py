"""Dormand and Prince's method of order 8."""

from collections.abc import Callable
from typing import ClassVar

import diffrax

from jaxlag.solvers._unrolled import AbstractUnrolled


class Dopri8(AbstractUnrolled):
    """Order 8 with an embedded method of order 7, 14 stages of which two steps share one.

    Source: Prince, Dormand, High order embedded Runge-Kutta formulae, J. Comp. Appl. Math. 7
    (1981), with the coefficients of `diffrax.Dopri8`.
    """

    interpolation_cls: ClassVar[Callable] = diffrax.Dopri8.interpolation_cls

    @property
    def stock(self) -> diffrax.Dopri8:
        """`diffrax.Dopri8`."""
        return diffrax.Dopri8()
