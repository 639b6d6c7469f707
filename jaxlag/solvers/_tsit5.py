"""Tsitouras' method of order 5."""

from collections.abc import Callable
from typing import ClassVar

import diffrax

from jaxlag.solvers._explicit import AbstractRungeKutta


class Tsit5(AbstractRungeKutta):
    """Order 5 with an embedded method of order 4, 7 stages of which two steps share one.

    Source: Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying
    assumption, Computers & Mathematics with Applications 62 (2011), with the coefficients of
    `diffrax.Tsit5`.
    """

    interpolation_cls: ClassVar[Callable] = diffrax.Tsit5.interpolation_cls

    @property
    def stock(self) -> diffrax.Tsit5:
        """`diffrax.Tsit5`."""
        return diffrax.Tsit5()
